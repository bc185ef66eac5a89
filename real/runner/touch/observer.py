"""Tactile observation: tracks the images of both cameras relative to a reference, each as soon as it arrives."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, UsageError
from gelflow.observation import FlowMap, TactileFrame, flow_map
from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
from gelflow.perception.tracker import MarkerTracker, TrackingResult
from gelflow.protocols import Camera, CameraImage
from gelflow.real.runner.touch.pad_forces import RestingPad
from gelflow.task import InsertionTask
from gelflow.time_sync import MAX_LEAD, RUNNER

_VISIBLE_FRACTION = 0.6  # of a pad's markers; an image with fewer visible markers is not readable
_LEAST_NOISE = 1e-4  # largest change of a marker between two images, below which the camera repeats one image [px]
_LONGEST_WAIT = 0.01  # for an image, before a caller can react to a pad that is not readable [s]
_POLL = 1e-3  # period of the check for new images [s, wall]
_READINGS_AT_REST = 5  # averaged to compare the pads before and after an event
_PERIODS = 20  # intervals between images from which the period is taken

Array = NDArray[np.float64]


class MarkersUnreadable(PeerError):
    """Images arrived, but their markers could not be tracked: the attempt may be repeated."""


@dataclass(frozen=True)
class TactileReading:
    """The newest tracked image of each pad, as one tactile frame."""

    frame: TactileFrame
    images: tuple[CameraImage, ...]  # one per sensor
    depth: float  # below the start of the attempt [m]
    change: Array  # mean change of each pad's markers since the reference [mm], shape (sensors, 2): x, y on the pad

    @property
    def sequences(self) -> tuple[int, ...]:
        """Sequence numbers of the images."""
        return tuple(image.sequence for image in self.images)

    @property
    def shear(self) -> float:
        """Mean shear along the finger since the reference, the larger of both pads [mm]."""
        return float(np.abs(self.change[:, 0]).max())


class TactileObserver:
    """Observes both pads relative to a reference, with new trackers; a pair of images is the reference.

    `stale` is the largest age of an image [s, robot time]. `on_result` receives the newest readable result of each
    sensor, with its image, after the decision that it leads to: see `publish_results`.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        mounts: Sequence[CameraMount],
        *,
        clock: ScaledClock,
        stale: float,
        on_result: Callable[[int, CameraImage, TrackingResult], None] | None = None,
    ) -> None:
        self._cameras, self._mounts, self._clock, self._stale = cameras, mounts, clock, stale
        self._trackers = [MarkerTracker(mount.tracker_config()) for mount in mounts]
        self._last = [-1] * len(cameras)
        self._images: list[CameraImage] = []
        self._results: list[TrackingResult] = []
        self._readable: list[bool] = []
        self._on_result = on_result
        self._unpublished: list[int] = []  # sensors whose newest result is readable and was not published
        self._readable_stamps: list[float] = []  # of the newest readable image of each sensor [s]
        self._intervals: deque[float] = deque(maxlen=_PERIODS)
        self.tracked: list[list[int]] = [[] for _ in cameras]  # sequence numbers given to each tracker, in order
        self.reference: TactileReading | None = None
        self.readings: list[TactileReading] = []

    def start(self, since: float) -> TactileReading:
        """Set the reference to the first pair of images received after the robot time `since` [s].

        Raises MarkersUnreadable when they show too few markers, PeerTimeout when no images arrive.
        """
        images = self._pair(since)
        try:
            with self._clock.bounded(RUNNER):
                self._results = [self._track(sensor, image) for sensor, image in enumerate(images)]
        except (PeerError, UsageError) as error:  # UsageError: the grid differs from that of the lab file
            raise MarkersUnreadable(f"no reference frame: {error}") from None
        self._images = list(images)
        self._last = [image.sequence for image in images]
        self._readable = [self._is_readable(result) for result in self._results]
        if not all(self._readable):
            raise MarkersUnreadable(
                f"no reference frame: fewer than {_VISIBLE_FRACTION:.0%} of the markers are visible; inspect the gels"
            )
        self._readable_stamps = [image.stamp for image in images]
        frame = self._frame()
        self.reference = TactileReading(frame, images, 0.0, np.zeros((len(images), 2)))
        return self.reference

    def update(self) -> TactileReading | None:
        """Wait for the next image of any camera, for at most 10 ms, and track all new ones.

        Returns the reading of the newest images, with depth 0; None without a new image, and when the newest image of a
        pad is not readable. Call it inside `clock.bounded(RUNNER)`, which ends after the decision that depends on the
        reading. Raises PeerTimeout when a camera has sent no new image within the time limit, and UsageError before
        `start`.
        """
        if self.reference is None:
            raise UsageError("the observer has no reference yet: call start first")
        self.publish_results()
        new = self._wait_for_images()
        for sensor, image in new:
            last = self._images[sensor]
            self._intervals.append((image.stamp - last.stamp) / (image.sequence - last.sequence))
            self._images[sensor], self._last[sensor] = image, image.sequence
            before = self._results[sensor]
            try:
                self._results[sensor] = result = self._track(sensor, image)
                self._readable[sensor] = self._is_readable(result) and _differs(result, before)
            except PeerError:
                self._readable[sensor] = False
            if self._readable[sensor]:
                self._readable_stamps[sensor] = image.stamp
                self._unpublished.append(sensor)
        if not new or not all(self._readable):
            return None
        frame = self._frame()
        return TactileReading(frame, tuple(self._images), 0.0, mean_change(frame, self.reference.frame))

    def publish_results(self) -> None:
        """Call `on_result` for the results of the last update.

        `update` does so before it waits for the next image; a caller that ends its observation calls this itself.
        """
        if self._on_result is not None:
            for sensor in self._unpublished:
                self._on_result(sensor, self._images[sensor], self._results[sensor])
        self._unpublished = []

    def update_pair(self, since: float) -> TactileReading | None:
        """Track until the newest image of each pad was received after the robot time `since` [s]; see `update`."""
        with self._clock.bounded(RUNNER):
            while True:
                reading = self.update()
                if min(image.stamp for image in self._images) > since:
                    return reading

    def at_rest(self, since: float) -> list[TactileReading]:
        """Several readings of images received after the robot time `since` [s], while nothing moves.

        Raises MarkersUnreadable when a pad is not readable for the time limit of images.
        """
        readings: list[TactileReading] = []
        with self._clock.bounded(RUNNER):
            while len(readings) < _READINGS_AT_REST:
                reading = self.update_pair(since)
                if reading is not None:
                    readings.append(reading)
                    since = min(image.stamp for image in reading.images)
                elif self.unreadable_time() > self._stale:
                    raise MarkersUnreadable("the markers are not readable at rest; inspect the gels and their light")
        return readings

    def mean_at_rest(self, since: float) -> Array:
        """Mean change of each pad at rest [mm], shape (sensors, 2); see `at_rest`."""
        return np.asarray(np.mean([reading.change for reading in self.at_rest(since)], axis=0))

    def unreadable_time(self) -> float:
        """Time since the older of the newest readable images of both pads [s, robot time]."""
        return self._clock.now() - min(self._readable_stamps)

    @property
    def unreadable_camera(self) -> str:
        """Name of the camera whose newest readable image is the older one."""
        return self._cameras[int(np.argmin(self._readable_stamps))].name

    @property
    def image_period(self) -> float:
        """Largest recent interval between two images of a camera [s]; `stale` before any is known."""
        return max(self._intervals, default=self._stale)

    @property
    def newest_images(self) -> tuple[CameraImage, ...]:
        """The newest image of each sensor, readable or not."""
        return tuple(self._images)

    @property
    def resting_pads(self) -> list[RestingPad]:
        """The markers of each pad in the reference, where they are measured now too."""
        pairs = zip(self._trackers, self._results, strict=True)
        return [RestingPad(tracker.rest, result.valid) for tracker, result in pairs]

    def reference_change(self, earlier: "TactileObserver") -> Array:
        """Mean change of each pad from the reference of `earlier` to this one [mm], shape (sensors, 2).

        Positions in the images are compared, so the two references need no images between them.
        """
        still, moved = [], []
        for tracker, before, result in zip(self._trackers, earlier._trackers, self._results, strict=True):
            displacement = tracker.rest - before.rest
            still.append(replace(result, position=before.rest, displacement=np.zeros_like(displacement)))
            moved.append(replace(result, position=before.rest, displacement=displacement))
        frames = [tactile_frame(results, self._mounts, 0.0) for results in (moved, still)]
        return mean_change(*frames)

    def add_reading(self, reading: TactileReading) -> None:
        """Add a reading, with its depth, to those that `readings_at_depths` selects from."""
        self.readings.append(reading)

    def readings_at_depths(self, depths: Sequence[float]) -> list[TactileReading]:
        """For each depth [m] the nearest reading; the last one for depths below the end of the descent.

        Raises MarkersUnreadable without a reading.
        """
        if not self.readings:
            raise MarkersUnreadable("no image of the descent could be tracked; inspect the gels")
        measured = np.array([reading.depth for reading in reversed(self.readings)])  # newest first for equal depths
        return [self.readings[-1 - int(np.abs(measured - min(depth, measured[0])).argmin())] for depth in depths]

    def observe(self, frames: Sequence[TactileReading], task: InsertionTask) -> FlowMap:
        """The flow map of readings relative to the reference. Raises UsageError before `start`."""
        if self.reference is None:
            raise UsageError("the observer has no reference yet: call start first")
        return flow_map([reading.frame for reading in frames], self.reference.frame, grid=task.grid)

    def _pair(self, since: float) -> tuple[CameraImage, ...]:
        """The newest image of each camera that was received after the robot time `since` [s]."""
        images = []
        for camera, last in zip(self._cameras, self._last, strict=True):
            image = camera.next(last, self._stale)
            while image.stamp < since:
                image = camera.next(image.sequence, self._stale)
            images.append(image)
        return tuple(images)

    def _wait_for_images(self) -> list[tuple[int, CameraImage]]:
        """The new images, of one camera, of both or of none; robot time does not run ahead of this wait."""
        end = self._clock.now() + _LONGEST_WAIT
        while True:
            self._clock.grant(RUNNER, self._clock.now() + MAX_LEAD)
            newest = [camera.latest() for camera in self._cameras]
            new = [(s, image) for s, image in enumerate(newest) if image.sequence > self._last[s]]
            if new or self._clock.now() > end:
                return new
            time.sleep(_POLL)

    def _track(self, sensor: int, image: CameraImage) -> TrackingResult:
        pixels = decode_image(image.data)
        # Listed before tracking, readable or not: a replay must give the tracker the same images.
        self.tracked[sensor].append(image.sequence)
        return self._trackers[sensor].track(pixels)

    @staticmethod
    def _is_readable(result: TrackingResult) -> bool:
        return bool(result.valid.mean() >= _VISIBLE_FRACTION)

    def _frame(self) -> TactileFrame:
        return tactile_frame(self._results, self._mounts, max(image.stamp for image in self._images))


def _differs(result: TrackingResult, before: TrackingResult) -> bool:
    """Whether two images differ as images of a live camera do: the noise of its sensor moves every marker a little."""
    both = result.valid & before.valid
    return bool(np.abs(result.position[both] - before.position[both]).max(initial=0.0) > _LEAST_NOISE)


def mean_change(frame: TactileFrame, reference: TactileFrame) -> Array:
    """Mean change of the markers of each pad [unit of the frames], shape (sensors, 2): x, y on the pad.

    The mean is over the markers that are valid in both frames.
    """
    change = frame.shear.astype(float) - reference.shear
    both = (frame.valid & reference.valid)[..., None]
    sums = np.where(both, change, 0.0).sum(axis=1)
    return np.asarray(sums / np.maximum(both.sum(axis=1), 1))
