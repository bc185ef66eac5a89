"""The trackers of the benchmark: gelflow, and OpenCV's Lucas-Kanade and dense optical flow with tuned settings.

The OpenCV trackers are given the true marker positions in the first image; gelflow detects them.
"""

from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.tracker import MarkerTracker

_WINDOW = 0.5  # side of the Lucas-Kanade window / marker spacing

Image = NDArray[np.uint8]
Points = NDArray[np.float64]
Mask = NDArray[np.bool_]  # shape (markers,)


class MarkerEstimate(NamedTuple):
    """The estimate of a tracker for one image."""

    position: Points  # [px], shape (markers, 2)
    displacement: Points  # from rest [px], shape (markers, 2)
    valid: Mask  # whether each marker is measured


class BenchmarkTracker(Protocol):
    """A tracker of the benchmark."""

    def start(self, image: Image, rest: Points, visible: Mask, rows: int, cols: int) -> MarkerEstimate:
        """Starts with the first image, whose `rows` × `cols` markers are at `rest` [px], row by row."""

    def track(self, image: Image) -> MarkerEstimate:
        """Estimates the markers in the next image."""


class GelflowTracker:
    """`MarkerTracker` without prior knowledge."""

    def __init__(self) -> None:
        self._tracker = MarkerTracker()

    def start(self, image: Image, rest: Points, visible: Mask, rows: int, cols: int) -> MarkerEstimate:
        """Raises TrackerInitError as `MarkerTracker` does, UsageError when it detects another grid."""
        result = self._tracker.start(image)
        if (result.rows, result.cols) != (rows, cols):
            raise UsageError(f"detected {result.rows} × {result.cols} markers, expected {rows} × {cols}")
        return MarkerEstimate(result.position, result.displacement, result.valid)

    def track(self, image: Image) -> MarkerEstimate:
        result = self._tracker.track(image)
        return MarkerEstimate(result.position, result.displacement, result.valid)


class LucasKanade:
    """Pyramidal Lucas-Kanade at each marker, from the first to the current image, starting at the last position.

    Best setting on the class "typical" among windows of 0.5 to 1.6 spacings, 0 to 3 pyramid levels, and tracking from
    the previous image, whose errors accumulate.
    """

    def start(self, image: Image, rest: Points, visible: Mask, rows: int, cols: int) -> MarkerEstimate:
        self._first = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._rest = np.ascontiguousarray(rest, dtype=np.float32)
        self._last = self._rest.copy()
        side = max(5, round(_WINDOW * float(np.linalg.norm(rest[1] - rest[0]))) | 1)
        self._window, self._visible = (side, side), visible
        return MarkerEstimate(rest, np.zeros_like(rest), visible)

    def track(self, image: Image) -> MarkerEstimate:
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
        valid = good.reshape(-1).astype(bool) & self._visible
        self._last = np.where(valid[:, None], now, self._last)
        position = self._last.astype(np.float64)
        return MarkerEstimate(position, position - self._rest, valid)


class DenseFlow:
    """Dense inverse search (DIS, medium) from the first to the current image, starting at the last flow.

    The other presets and flow from the previous image have larger errors on the class "typical".
    """

    def start(self, image: Image, rest: Points, visible: Mask, rows: int, cols: int) -> MarkerEstimate:
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._first = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._rest, self._visible = rest, visible
        self._flow = np.zeros((*image.shape[:2], 2), dtype=np.float32)
        return MarkerEstimate(rest, np.zeros_like(rest), visible)

    def track(self, image: Image) -> MarkerEstimate:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._flow = self._search.calc(self._first, grey, self._flow)
        right, down = self._rest.astype(np.float32).T[:, :, None]
        moved = cv2.remap(self._flow, right, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return MarkerEstimate(self._rest + moved[:, 0], moved[:, 0].astype(np.float64), self._visible)


TRACKERS: dict[str, type[BenchmarkTracker]] = {
    "gelflow": GelflowTracker,
    "Lucas-Kanade": LucasKanade,
    "dense flow": DenseFlow,
}
