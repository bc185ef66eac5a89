"""Trackers that people use, from OpenCV, as well set as was found: what the project's own is compared with.

Both are told which markers are in the first image, and where: on a robot somebody would have to find them.
"""

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.tracker import MarkerTracker

_WINDOW = 0.5  # side of Lucas-Kanade's window, as a share of the spacing

Image = NDArray[np.uint8]
Points = NDArray[np.float64]
Flags = NDArray[np.bool_]  # shape (markers,)
# Where each marker is and how far it went from rest [px], shape (markers, 2), and whether it was measured.
Found = tuple[Points, Points, Flags]


class Follower(Protocol):
    """Follows the markers through images."""

    def start(self, image: Image, rest: Points, seen: Flags, rows: int, cols: int) -> Found:
        """Takes the first image, of `rows` × `cols` markers that truly are at `rest` [px], row by row, if `seen`."""

    def track(self, image: Image) -> Found:
        """The markers in the next image."""


class Own:
    """The project's tracker, which is told nothing."""

    def __init__(self) -> None:
        self._tracker = MarkerTracker()

    def start(self, image: Image, rest: Points, seen: Flags, rows: int, cols: int) -> Found:
        """Raises TrackerInitError as the tracker does, and UsageError when it found another grid."""
        tracked = self._tracker.start(image)
        if (tracked.rows, tracked.cols) != (rows, cols):
            raise UsageError(f"found {tracked.rows} × {tracked.cols} markers, there are {rows} × {cols}")
        return tracked.position, tracked.displacement, tracked.valid

    def track(self, image: Image) -> Found:
        tracked = self._tracker.track(image)
        return tracked.position, tracked.displacement, tracked.valid


class LucasKanade:
    """Pyramidal Lucas-Kanade at each marker: each image against the first, starting where the marker was last.

    Windows of 0.5 to 1.6 spacings, 0 to 3 levels, and each image against the one before were tried on the typical
    class: this was best. Against the image before, errors are the same at first and add up.
    """

    def start(self, image: Image, rest: Points, seen: Flags, rows: int, cols: int) -> Found:
        self._first = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._rest = np.ascontiguousarray(rest, dtype=np.float32)
        self._last = self._rest.copy()
        side = max(5, round(_WINDOW * float(np.linalg.norm(rest[1] - rest[0]))) | 1)
        self._window, self._seen = (side, side), seen
        return rest, np.zeros_like(rest), seen

    def track(self, image: Image) -> Found:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        now, good, _ = cv2.calcOpticalFlowPyrLK(
            self._first,
            grey,
            self._rest,
            self._last.copy(),
            winSize=self._window,
            maxLevel=2,
            criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.003),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        valid = good.reshape(-1).astype(bool) & self._seen
        self._last = np.where(valid[:, None], now, self._last)
        return self._last.astype(np.float64), self._last.astype(np.float64) - self._rest, valid


class DenseFlow:
    """Dense inverse search (DIS, medium) of each image against the first, starting at the last flow, at each marker.

    The other presets, and each image against the one before, were worse on the typical class.
    """

    def start(self, image: Image, rest: Points, seen: Flags, rows: int, cols: int) -> Found:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._first = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._rest, self._seen = rest, seen
        self._flow = np.zeros((*image.shape[:2], 2), dtype=np.float32)
        return rest, np.zeros_like(rest), seen

    def track(self, image: Image) -> Found:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._flow = self._search.calc(self._first, grey, self._flow)
        right, down = self._rest.astype(np.float32).T[:, :, None]
        moved = cv2.remap(self._flow, right, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return self._rest + moved[:, 0], moved[:, 0].astype(np.float64), self._seen


FOLLOWERS: dict[str, type[Follower]] = {"gelflow": Own, "Lucas-Kanade": LucasKanade, "dense flow": DenseFlow}
