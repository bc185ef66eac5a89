"""What the runner feels: frames of both cameras, tracked from an attempt's reference on, each with its depth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.observation import FlowMap, TactileFrame, flow_map
from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
from gelflow.perception.tracker import MarkerTracker, TrackingResult
from gelflow.protocols import Camera, CameraImage
from gelflow.task import InsertionTask

_FEWEST = 0.6  # of a pad's markers must be seen: below this a frame says nothing


class MarkersUnreadable(PeerError):
    """Frames came, but no markers could be read from them: the attempt may be tried again."""


@dataclass(frozen=True)
class TactileReading:
    """One moment as both pads felt it."""

    frame: TactileFrame
    images: tuple[CameraImage, ...]  # one per sensor
    depth: float  # below the attempt's start [m]
    shear: float  # mean shear along the finger since the reference, of the pad that feels more [mm]

    @property
    def sequences(self) -> tuple[int, ...]:
        return tuple(image.sequence for image in self.images)


class TactileObserver:
    """Reads the pads during one attempt: fresh trackers, the first readable pair of images is the reference."""

    def __init__(self, cameras: Sequence[Camera], mounts: Sequence[CameraMount], *, stale: float) -> None:
        self._cameras, self._mounts, self._stale = cameras, mounts, stale
        self._trackers = [MarkerTracker(mount.tracker_config()) for mount in mounts]
        self._last = [-1] * len(cameras)
        self.tracked: list[list[int]] = [[] for _ in cameras]  # sequence numbers given to each tracker, in order
        self.reference: TactileReading | None = None
        self.readings: list[TactileReading] = []
        self.unreadable = 0

    def start(self, since: float) -> TactileReading:
        """The reference, from the first frames that came after the robot time `since` [s].

        Raises MarkersUnreadable when they show no markers, PeerTimeout when no frames come.
        """
        images = self.images(since)
        self._last = [image.sequence for image in images]
        try:
            trackeds = self._track(images)
        except (PeerError, UsageError) as error:  # UsageError: another grid than the lab file's
            raise MarkersUnreadable(f"no reference frame: {error}") from None
        frame = self._frame(trackeds, images)
        if frame is None:
            raise MarkersUnreadable(
                f"no reference frame: fewer than {_FEWEST:.0%} of the markers are seen; look at the gels"
            )
        self.reference = TactileReading(frame, images, 0.0, 0.0)
        return self.reference

    def next(self) -> TactileReading | None:
        """The newest pair of frames that was not read yet, with depth 0; None where the pair was unreadable.

        Raises PeerTimeout when no new frames come.
        """
        return self.read(self.images())

    def images(self, since: float = -math.inf) -> tuple[CameraImage, ...]:
        """The newest pair of frames that was not read yet, both from after the robot time `since` [s].

        Raises PeerTimeout when none comes.
        """
        images = []
        for camera, last in zip(self._cameras, self._last, strict=True):
            image = camera.next(last, self._stale)
            while image.stamp < since:
                image = camera.next(image.sequence, self._stale)
            images.append(image)
        return tuple(images)

    def read(self, images: tuple[CameraImage, ...]) -> TactileReading | None:
        """What a pair of frames shows, with depth 0; None where it is unreadable."""
        assert self.reference is not None, "start comes first"
        self._last = [image.sequence for image in images]
        try:
            frame = self._frame(self._track(images), images)
        except PeerError:
            frame = None
        if frame is None:
            self.unreadable += 1
            return None
        return TactileReading(frame, images, 0.0, mean_shear(frame, self.reference.frame))

    def keep(self, reading: TactileReading) -> None:
        """Add a reading, with its depth, to those that the observation is chosen from."""
        self.readings.append(reading)

    def chosen(self, depths: Sequence[float]) -> list[TactileReading]:
        """For each depth [m] the reading nearest to it; where the descent was stopped before, the last one."""
        if not self.readings:
            raise MarkersUnreadable("no frame of the descent could be read; look at the gels")
        found = np.array([reading.depth for reading in reversed(self.readings)])  # of equal depths the newest counts
        return [self.readings[-1 - int(np.abs(found - min(depth, found[0])).argmin())] for depth in depths]

    def observe(self, frames: Sequence[TactileReading], task: InsertionTask) -> FlowMap:
        """The flow map of chosen readings against the reference."""
        assert self.reference is not None
        return flow_map([reading.frame for reading in frames], self.reference.frame, grid=task.grid)

    def _track(self, images: Sequence[CameraImage]) -> list[TrackingResult]:
        trackeds = []
        for sensor, image in enumerate(images):
            pixels = decode_image(image.data)
            # Listed as soon as the tracker saw it, readable or not: a replay must show it the same images.
            self.tracked[sensor].append(image.sequence)
            trackeds.append(self._trackers[sensor].track(pixels))
        return trackeds

    def _frame(self, trackeds: Sequence[TrackingResult], images: Sequence[CameraImage]) -> TactileFrame | None:
        frame = tactile_frame(trackeds, self._mounts, max(image.stamp for image in images))
        return frame if (frame.valid.mean(axis=1) >= _FEWEST).all() else None


def mean_shear(frame: TactileFrame, reference: TactileFrame) -> float:
    """Mean change of shear along the finger [unit of the frames], of the pad where it is larger.

    Over the markers that are valid in both frames.
    """
    change = frame.shear[..., 0].astype(float) - reference.shear[..., 0]
    both = frame.valid & reference.valid
    sums = np.where(both, change, 0.0).sum(axis=1)
    means: NDArray[np.float64] = np.abs(sums) / np.maximum(both.sum(axis=1), 1)
    return float(means.max())
