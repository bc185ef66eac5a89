"""Tactile observation of an attempt: tracks the images of both cameras relative to a reference, each with its depth."""

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

_VISIBLE_FRACTION = 0.6  # of a pad's markers; a frame with fewer visible markers is rejected


class MarkersUnreadable(PeerError):
    """Images arrived, but their markers could not be tracked: the attempt may be repeated."""


@dataclass(frozen=True)
class TactileReading:
    """The tactile frame of one moment, of both pads."""

    frame: TactileFrame
    images: tuple[CameraImage, ...]  # one per sensor
    depth: float  # below the start of the attempt [m]
    shear: float  # mean shear along the finger since the reference, the larger of both pads [mm]

    @property
    def sequences(self) -> tuple[int, ...]:
        """Sequence numbers of the images."""
        return tuple(image.sequence for image in self.images)


class TactileObserver:
    """Observes both pads during one attempt, with new trackers; the first pair of images is the reference."""

    def __init__(self, cameras: Sequence[Camera], mounts: Sequence[CameraMount], *, stale: float) -> None:
        self._cameras, self._mounts, self._stale = cameras, mounts, stale
        self._trackers = [MarkerTracker(mount.tracker_config()) for mount in mounts]
        self._last = [-1] * len(cameras)
        self.tracked: list[list[int]] = [[] for _ in cameras]  # sequence numbers given to each tracker, in order
        self.reference: TactileReading | None = None
        self.readings: list[TactileReading] = []
        self.unreadable = 0

    def start(self, since: float) -> TactileReading:
        """Set the reference to the first pair of images received after the robot time `since` [s].

        Raises MarkersUnreadable when they show too few markers, PeerTimeout when no images arrive.
        """
        images = self.images(since)
        self._last = [image.sequence for image in images]
        try:
            trackeds = self._track(images)
        except (PeerError, UsageError) as error:  # UsageError: the grid differs from that of the lab file
            raise MarkersUnreadable(f"no reference frame: {error}") from None
        frame = self._frame(trackeds, images)
        if frame is None:
            raise MarkersUnreadable(
                f"no reference frame: fewer than {_VISIBLE_FRACTION:.0%} of the markers are visible; inspect the gels"
            )
        self.reference = TactileReading(frame, images, 0.0, 0.0)
        return self.reference

    def next(self) -> TactileReading | None:
        """The tactile reading of the newest pair of images, with depth 0; None when its markers are unreadable.

        Raises PeerTimeout when no new images arrive.
        """
        return self.read(self.images())

    def images(self, since: float = -math.inf) -> tuple[CameraImage, ...]:
        """The newest pair of images that was not tracked yet, both received after the robot time `since` [s].

        Raises PeerTimeout when none arrives.
        """
        images = []
        for camera, last in zip(self._cameras, self._last, strict=True):
            image = camera.next(last, self._stale)
            while image.stamp < since:
                image = camera.next(image.sequence, self._stale)
            images.append(image)
        return tuple(images)

    def read(self, images: tuple[CameraImage, ...]) -> TactileReading | None:
        """Track a pair of images; returns the reading with depth 0, or None when the markers are unreadable."""
        assert self.reference is not None, "call start() first"
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
        """Add a reading, with its depth, to those that `chosen` selects from."""
        self.readings.append(reading)

    def chosen(self, depths: Sequence[float]) -> list[TactileReading]:
        """For each depth [m] the nearest reading; the last one for depths below the end of the descent."""
        if not self.readings:
            raise MarkersUnreadable("no image of the descent could be tracked; inspect the gels")
        measured = np.array([reading.depth for reading in reversed(self.readings)])  # newest first for equal depths
        return [self.readings[-1 - int(np.abs(measured - min(depth, measured[0])).argmin())] for depth in depths]

    def observe(self, frames: Sequence[TactileReading], task: InsertionTask) -> FlowMap:
        """The flow map of readings relative to the reference."""
        assert self.reference is not None
        return flow_map([reading.frame for reading in frames], self.reference.frame, grid=task.grid)

    def _track(self, images: Sequence[CameraImage]) -> list[TrackingResult]:
        trackeds = []
        for sensor, image in enumerate(images):
            pixels = decode_image(image.data)
            # Listed before tracking, readable or not: a replay must give the tracker the same images.
            self.tracked[sensor].append(image.sequence)
            trackeds.append(self._trackers[sensor].track(pixels))
        return trackeds

    def _frame(self, trackeds: Sequence[TrackingResult], images: Sequence[CameraImage]) -> TactileFrame | None:
        frame = tactile_frame(trackeds, self._mounts, max(image.stamp for image in images))
        return frame if (frame.valid.mean(axis=1) >= _VISIBLE_FRACTION).all() else None


def mean_shear(frame: TactileFrame, reference: TactileFrame) -> float:
    """Mean change of shear along the finger [unit of the frames], the larger of both pads.

    The mean is over the markers that are valid in both frames.
    """
    change = frame.shear[..., 0].astype(float) - reference.shear[..., 0]
    both = frame.valid & reference.valid
    sums = np.where(both, change, 0.0).sum(axis=1)
    means: NDArray[np.float64] = np.abs(sums) / np.maximum(both.sum(axis=1), 1)
    return float(means.max())
