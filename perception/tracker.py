"""Markers followed through images: where each is, how far it moved from the first image, and whether it is seen.

The first image is the reference: the grid is found in it, and what a dot looks like; images in which nothing has moved
yet make it finer. In every further image all dots
are found anew, so nothing drifts; each is given to the marker that it belongs to, and fitted with the learned shape.
The work on an image is native, see csrc: contrast.hpp finds, follow.hpp says whose, fit.hpp measures.
No random numbers, no clock: the same images in the same order give the same numbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.perception._tracker import Tracker
from gelflow.perception.detect import smaller
from gelflow.perception.dot_model import learn
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.grid import Polarity, find_grid

__all__ = ["MarkerTracker", "TrackerConfig", "TrackerInitError", "TrackingResult"]

_LARGEST = 10.0  # radius of a dot [px]; in a larger image nothing is gained by more pixels, it is made smaller


@dataclass(frozen=True)
class TrackerConfig:
    """What is known of the markers before the first image."""

    rows: int | None = None  # lines of markers in the image; None: found
    cols: int | None = None  # markers in a line; None: found
    either_way: bool = True  # rows and cols may also be the other way round in the image
    polarity: Polarity = "auto"  # dots darker or brighter than the gel


@dataclass(frozen=True)
class TrackingResult:
    """The markers in one image, line by line from the top, each line from the left."""

    position: NDArray[np.float64]  # (right, down) [px], shape (markers, 2); where not valid, where it is expected
    displacement: NDArray[np.float64]  # from rest [px], shape (markers, 2); NaN where neither valid nor inferred
    valid: NDArray[np.bool_]  # measured in this image, shape (markers,)
    inferred: NDArray[np.bool_]  # not measured, guessed from its neighbours, shape (markers,)
    quality: NDArray[np.float64]  # 0 to 1: how far the measurement can be believed; 0 where not valid, (markers,)
    rows: int  # lines in the image
    cols: int  # markers in a line
    spacing: float  # of the markers in the first image [px]


@dataclass(frozen=True)
class _Started:
    """What the first image gave."""

    tracker: Tracker
    size: tuple[int, int]  # height and width of the images [px]
    shrink: int  # the native part sees images made smaller by this
    rows: int
    cols: int
    spacing: float  # [px]


class MarkerTracker:
    """Follows the markers of one camera. The first image is the reference of all displacements."""

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = TrackerConfig() if config is None else config
        self._started: _Started | None = None

    @property
    def rest(self) -> NDArray[np.float64]:
        """Where the markers are at rest (right, down) [px], shape (markers, 2), line by line.

        As long as nothing moves after the start, up to eight images, it is the mean of them, and so gets finer.
        Raises UsageError before `start`.
        """
        if self._started is None:
            raise UsageError("the tracker has no rest positions yet: start it with an image at rest")
        return _larger(self._started.tracker.rest(), self._started.shrink)

    def start(self, image: NDArray[np.uint8], rows: int | None = None, cols: int | None = None) -> TrackingResult:
        """Finds the grid in `image` (B G R, or grey) and takes it as the reference; displacements in it are zero.

        `rows` and `cols` are lines and markers in a line; left out, the configuration's, and if it has none, found.
        Raises TrackerInitError when the image shows no such grid, or not clearly; UsageError when it is no image.
        """
        c = self.config
        image = _colours(image)
        rows, cols = (c.rows, c.cols) if rows is None and cols is None else (rows, cols)
        found = find_grid(image, rows=rows, cols=cols, either_way=c.either_way, polarity=c.polarity)
        shrink = max(1, int(np.ceil(found.radius / _LARGEST)))
        tracker, learned = learn(smaller(image, shrink), found.scaled(1 / shrink))
        rest = _larger(learned.rest, shrink)
        size = (image.shape[0], image.shape[1])
        rows, cols = found.shape
        self._started = _Started(tracker, size, shrink, rows, cols, found.spacing)
        none, seen = np.zeros_like(rest), learned.seen
        return TrackingResult(rest, none, seen, ~seen, learned.quality, rows, cols, found.spacing)

    def track(self, image: NDArray[np.uint8]) -> TrackingResult:
        """The markers in the next image (B G R, or grey). The first call is `start`.

        A marker that is not seen, or not for certain, is not valid. Raises PeerError when the image's size changes,
        UsageError when it is no image.
        """
        started = self._started
        if started is None:
            return self.start(image)
        image = _colours(image)
        if image.shape[:2] != started.size:
            got, expected = (f"{width} × {height} px" for height, width in (image.shape[:2], started.size))
            raise PeerError(f"the image's size changed from {expected} to {got}: start the tracker anew for it")
        shrink = started.shrink
        position, displacement, valid, inferred, quality = started.tracker.track(smaller(image, shrink))
        if shrink > 1:
            position, displacement = _larger(position, shrink), shrink * displacement
        grid = started.rows, started.cols, started.spacing
        return TrackingResult(position, displacement, valid, inferred, quality, *grid)


def _colours(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`image` as B G R without gaps in memory. Raises UsageError when it is no image."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        got = f"values of type {image.dtype}" if isinstance(image, np.ndarray) else f"a {type(image).__name__}"
        raise UsageError(f"expected an image as an array of uint8, got {got}: decode or convert it first")
    if image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise UsageError(
            f"expected an image of shape (height, width, 3), or (height, width) in grey, got {image.shape}"
        )
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return np.ascontiguousarray(image)


def _larger(position: NDArray[np.float64], shrink: int) -> NDArray[np.float64]:
    """Places in a smaller image as places in the image [px]."""
    return (position + 0.5) * shrink - 0.5
