"""Latency of the cameras during a run, from the signals of its grasps."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError
from gelflow.perception.frames import decode_image
from gelflow.perception.tracker import MarkerTracker, TrackerConfig
from gelflow.protocols import CameraImage, GripperState
from gelflow.real.camera.latency import LatencyEstimate, combine_latencies, estimate_latency
from gelflow.time_sync import RUNNER

_TRACKED_SPAN = 0.4  # before and after the rise of the force, in which images are tracked [s]
_ONSET_SHARE = 0.1  # of the largest force, above which the force counts as risen
# Latency beyond that of the lab file that is ignored [s, wall]: rounding in the file, the gripper's own delay, and the
# jitter of this computer.
_TOLERANCE = 5e-3


@dataclass
class GraspSignals:
    """The measurements of gripper and cameras during one grasp."""

    force: list[tuple[float, float]] = field(default_factory=list)  # stamp [s], measured force [N]
    images: dict[int, list[CameraImage]] = field(default_factory=dict)  # by sensor

    def latencies(self, trackers: Sequence[TrackerConfig]) -> list[LatencyEstimate | None]:
        """The latency of each camera beyond that already subtracted from its stamps; None where it is not visible.

        `trackers` are the tracker settings of each sensor. Images that cannot be tracked are omitted.
        """
        return [self._latency(sensor, config) for sensor, config in enumerate(trackers)]

    def _latency(self, sensor: int, config: TrackerConfig) -> LatencyEstimate | None:
        values = np.array([value for _, value in self.force])
        if not values.size or not np.isfinite(values).any():
            return None
        risen = self.force[int(np.argmax(values > _ONSET_SHARE * np.nanmax(values)))][0]
        change: list[tuple[float, float]] = []
        tracker: MarkerTracker | None = None
        for image in self.images.get(sensor, []):
            if abs(image.stamp - risen) > _TRACKED_SPAN:
                continue
            try:
                pixels = decode_image(image.data)
                if tracker is None:
                    tracker = MarkerTracker(config)
                    tracker.start(pixels)
                result = tracker.track(pixels)
            except GelflowError:
                continue
            lengths = np.hypot(*result.displacement[result.valid].T)
            if lengths.size:
                change.append((image.stamp, float(lengths.mean())))
        if not change:
            return None
        return estimate_latency(*zip(*self.force, strict=True), *zip(*change, strict=True))


class LatencyMonitor:
    """Collects the signals of grasps and keeps the resulting latencies of each camera.

    `image` and `gripper_state` are called in the threads of the devices, for every image and every state.
    `clock_factor` is robot time over wall time; it converts the tolerance, a wall time, to robot time.
    """

    def __init__(self, names: Sequence[str], trackers: Sequence[TrackerConfig], *, clock_factor: float) -> None:
        self._names, self._trackers = names, trackers
        self._tolerance = _TOLERANCE * clock_factor  # [s]
        self._signals: GraspSignals | None = None
        self.estimates: list[list[LatencyEstimate]] = [[] for _ in names]

    def image(self, sensor: int, image: CameraImage) -> None:
        """Store an image while a grasp is in progress."""
        if (signals := self._signals) is not None:
            signals.images.setdefault(sensor, []).append(image)

    def gripper_state(self, state: GripperState) -> None:
        """Store the measured force while a grasp is in progress."""
        if (signals := self._signals) is not None:
            signals.force.append((state.stamp, state.force))

    @contextmanager
    def grasp(self, clock: ScaledClock) -> Iterator[None]:
        """Collect the signals of a grasp: the context starts before the fingers close and ends with the part held.

        Then estimate the latencies from some fifty images, for which the time of a mock robot waits.
        """
        self._signals = signals = GraspSignals()
        try:
            yield
        finally:
            self._signals = None
        with clock.bounded(RUNNER):
            latencies = signals.latencies(self._trackers)
        for known, estimate in zip(self.estimates, latencies, strict=True):
            known += [] if estimate is None else [estimate]

    @property
    def excess(self) -> float:
        """Lower bound of the delay of images after their stamps, the largest of all grasps and cameras [s]."""
        return max((self._excess(known) for known in self.estimates), default=0.0)

    def _excess(self, known: Sequence[LatencyEstimate]) -> float:
        return max((estimate.low for estimate in known if estimate.low > self._tolerance), default=0.0)

    def warnings(self) -> list[str]:
        """One line for each camera whose images are certainly later than the lab file states."""
        lines = []
        for name, known in zip(self._names, self.estimates, strict=True):
            if self._excess(known):
                together = combine_latencies(known)
                value = "changes from grasp to grasp" if together is None else f"is {together} longer than stated"
                lines.append(
                    f"{name} camera: its latency {value}; the arm moves more slowly to allow for it. Add it to "
                    f"cameras.{name}.latency in the lab file, or shorten the camera's buffers"
                )
        return lines
