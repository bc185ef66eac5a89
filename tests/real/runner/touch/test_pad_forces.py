"""Forces of the pads: estimated in a helper process, newest image first, recorded as `gelflow track` records them."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force.image_forces import GridScale, ImageForces, force_record
from gelflow.perception.frames import CameraMount
from gelflow.perception.synthetic.pressed_layer import Press, PressedLayer
from gelflow.perception.tracker import TrackingResult
from gelflow.protocols import CameraImage
from gelflow.real.runner.touch.pad_forces import PadForces, RestingPad
from gelflow.session.records import to_plain

GEL = ElasticGel(1.5e5, 0.48, 3e-3, friction=0.8)
ROWS, COLS, PITCH, SCALE = 10, 9, 1.5, 15.0
MOUNT = CameraMount(ROWS, COLS, PITCH, pixels_per_mm=SCALE)
REST = SCALE * Grid(ROWS, COLS, PITCH).positions()[:, ::-1] + 200.0  # right, down [px]
ALL = np.ones(ROWS * COLS, dtype=bool)
WAIT = 30.0  # [s]


class Recorder:
    """Records in memory; `blocked` delays every force."""

    def __init__(self) -> None:
        self.forces: list[tuple[int, float, dict[str, Any]]] = []
        self.events: list[str] = []
        self.go_on = threading.Event()
        self.go_on.set()

    def force(self, sensor: int, stamp: float, values: dict[str, Any]) -> None:
        self.go_on.wait(WAIT)
        self.forces.append((sensor, stamp, values))

    def event(self, name: str, values: dict[str, Any]) -> None:
        self.events.append(name)


@pytest.fixture(scope="module")
def moved() -> NDArray[np.float64]:
    """Displacements (right, down) [mm] under 2 N and 0.6 N of shear, down in the image."""
    press = Press("disc", (0.5, -0.5), 3.0, 0.0, normal=2.0, ratio=0.3, direction=0.0)
    return PressedLayer(GEL, Grid(ROWS, COLS, PITCH)).press(press).displacement_mm[:, ::-1]


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def forces(recorder: Recorder) -> Iterator[PadForces]:
    with PadForces([GEL, None], [MOUNT, MOUNT], recorder) as running:  # type: ignore[arg-type]
        yield running


def image(sequence: int) -> CameraImage:
    return CameraImage(b"", 10.0 + 0.03 * sequence, sequence)


def result(displacement_mm: NDArray[np.float64]) -> TrackingResult:
    """A result of a tracker that started under load: its own displacements are not those of the unloaded pad."""
    zero = np.zeros_like(REST)
    return TrackingResult(REST + SCALE * displacement_mm, zero, ALL, ~ALL, ALL * 1.0, ROWS, COLS, SCALE * PITCH)


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def wait_until_recorded(recorder: Recorder, count: int) -> None:
    wait_until(lambda: len(recorder.forces) >= count)


def test_records_are_those_of_track(forces: PadForces, recorder: Recorder, moved: NDArray[np.float64]) -> None:
    forces.set_rest([RestingPad(REST, ALL)] * 2)
    direct = ImageForces(GEL, ROWS, COLS, GridScale(PITCH, SCALE))
    expected = []
    for number, share in enumerate((0.0, 0.5, 1.0), start=1):
        forces.add(0, image(number), result(share * moved))
        forces.add(1, image(number), result(share * moved))  # a pad without a gel
        wait_until_recorded(recorder, number)
        estimate = direct.estimate(share * moved, ALL, image(number).stamp)
        assert estimate is not None
        expected.append(to_plain(force_record(estimate, direct.slip)))
    assert [(sensor, stamp) for sensor, stamp, _ in recorder.forces] == [(0, image(n).stamp) for n in (1, 2, 3)]
    for (_, _, found), wanted in zip(recorder.forces, expected, strict=True):
        assert found.keys() == wanted.keys()
        assert found["normal"] == pytest.approx(wanted["normal"], rel=1e-6, abs=1e-9)
        assert found["stick_share"] == pytest.approx(wanted["stick_share"])
    last = recorder.forces[-1][2]
    assert last["normal"] == pytest.approx(2.0, rel=0.1) and last["shear"] == pytest.approx([0.0, 0.6], abs=0.05)
    assert forces.of([image(3), image(3)]) == (last, None)


def test_without_an_unloaded_pad_nothing_is_estimated(
    forces: PadForces, recorder: Recorder, moved: NDArray[np.float64]
) -> None:
    forces.add(0, image(1), result(moved))
    forces.set_rest([RestingPad(REST, ALL)] * 2)
    forces.add(0, image(2), result(moved))
    wait_until_recorded(recorder, 1)
    assert [stamp for _, stamp, _ in recorder.forces] == [image(2).stamp]


def test_images_that_wait_are_replaced_by_newer_ones(
    forces: PadForces, recorder: Recorder, moved: NDArray[np.float64]
) -> None:
    forces.set_rest([RestingPad(REST, ALL)] * 2)
    recorder.go_on.clear()
    for number in range(1, 50):
        begin = time.perf_counter()
        forces.add(0, image(number), result(moved))
        assert time.perf_counter() - begin < 0.1  # it does not wait for the estimate
        time.sleep(0.001)
    recorder.go_on.set()
    wait_until(lambda: image(49).stamp in [stamp for _, stamp, _ in recorder.forces])
    stamps = [stamp for _, stamp, _ in recorder.forces]
    assert len(stamps) < 5


def test_too_few_markers_give_no_record(forces: PadForces, recorder: Recorder, moved: NDArray[np.float64]) -> None:
    forces.set_rest([RestingPad(REST, np.arange(len(ALL)) % 3 == 0)] * 2)
    forces.add(0, image(1), dataclasses.replace(result(moved), valid=np.arange(len(ALL)) % 2 == 0))
    wait_until(lambda: bool(forces._known))
    assert not recorder.forces and not forces.problem


def test_the_run_goes_on_when_the_helper_ends(
    forces: PadForces, recorder: Recorder, moved: NDArray[np.float64]
) -> None:
    forces.set_rest([RestingPad(REST, ALL)] * 2)
    forces.add(0, image(1), result(moved))
    wait_until_recorded(recorder, 1)
    forces._helper.kill()
    forces.add(0, image(2), result(moved))
    wait_until(lambda: bool(forces.problem))
    assert "not estimated any more" in forces.problem and recorder.events == ["forces ended"]
    begin = time.monotonic()
    forces.add(0, image(3), result(moved))
    assert forces.of([image(3)]) == (None,) and time.monotonic() - begin < 0.2
