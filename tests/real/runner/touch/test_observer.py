"""Results of the tactile observer are passed on after the decision that they lead to."""

from dataclasses import dataclass, field

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.perception.frames import CameraMount
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import TrackingResult
from gelflow.protocols import CameraImage
from gelflow.real.runner.touch.observer import TactileObserver

LOOK = GelAppearance()
MOUNT = CameraMount(pixels_per_mm=LOOK.pixels_per_mm)
CLOCK = ScaledClock()


@dataclass
class StillCamera:
    """A camera whose images the test makes."""

    name: str
    images: list[CameraImage] = field(default_factory=list)
    renderer: FastGelRenderer = field(default_factory=lambda: FastGelRenderer(LOOK))

    def show(self, shear_mm: float) -> None:
        sequence = len(self.images)
        moved = np.zeros_like(LOOK.positions_mm()) + np.array([shear_mm, 0.0])
        data = self.renderer.encode(self.renderer.render(moved, sequence=sequence))
        self.images.append(CameraImage(data, CLOCK.now(), sequence))

    def latest(self) -> CameraImage:
        return self.images[-1]

    def next(self, last: int, timeout: float) -> CameraImage:
        return self.images[-1]


def test_results_are_passed_on_after_the_decision() -> None:
    cameras = [StillCamera("left"), StillCamera("right")]
    passed: list[tuple[int, int]] = []

    def on_result(sensor: int, image: CameraImage, result: TrackingResult) -> None:
        assert result.valid.mean() > 0.9
        passed.append((sensor, image.sequence))

    observer = TactileObserver(cameras, [MOUNT] * 2, clock=CLOCK, stale=10.0, on_result=on_result)  # type: ignore[arg-type]
    for camera in cameras:
        camera.show(0.0)
    observer.start(0.0)
    rest = observer.resting_pads
    for camera in cameras:
        camera.show(0.2)
    reading = observer.update()
    assert reading is not None and reading.shear > 0.15
    assert not passed  # the caller decides first
    cameras[0].show(0.2)
    assert observer.update() is not None
    assert passed == [(0, 1), (1, 1)]
    observer.publish_results()  # at the end of an observation
    observer.publish_results()
    assert passed == [(0, 1), (1, 1), (0, 2)]
    assert [image.sequence for image in observer.newest_images] == [2, 1]
    for pad in rest:
        assert pad.valid.all()
        assert np.abs(pad.position - observer._trackers[0].rest).max() < 0.5
