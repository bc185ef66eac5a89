"""Selects the visible part of the printed grid in a lattice of dots, and finds the borders at which the grid ends.

Sides and skipped lines are ordered above, below, left, right, in the orientation of the image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.grid_detection.detect import DetectedDots
from gelflow.perception.grid_detection.lattice import Lattice, interpolate_nodes

Polarity = Literal["auto", "dark", "bright"]
Side = Literal["ends", "continues", "unknown"]  # unknown: the next line would be outside the image
Skipped = tuple[int, int, int, int]  # numbers of printed lines outside the image: above, below, left, right
Floats = NDArray[np.float64]

_MOSTLY_COMPLETE = 0.6  # fraction of entire dots in the outer lines of a grid of unknown shape
_PRINTED = 0.42  # the same of a line without cut dots, whose other dots are missing in the print
_PARTLY_COMPLETE = 0.3  # the same of a grid of known shape
_MIN_COUNT = 0.7  # entire dots / nodes of a requested grid
_ANCHOR_RADIUS = 0.4  # largest distance of a marker from its calibrated position / spacing; at 0.5 rows are exchanged
_BEYOND = 2  # lines by which a requested part may extend beyond the lattice
_PRESENT = 0.35  # contrast of a dot beyond the grid / median contrast of the grid
_GEL_BRIGHTNESS = 0.4  # of the gel beyond the grid / median brightness of the gel


@dataclass(frozen=True)
class GridRequest:
    """The grid that the caller expects in an image."""

    rows: int | None = None  # visible rows; None: detected
    cols: int | None = None  # visible markers in a row; None: detected
    either_way: bool = True  # also accept the transposed shape
    polarity: Polarity = "auto"
    skipped: Skipped = (0, 0, 0, 0)
    # Position of the marker in row rows // 2 and column cols // 2 at rest [px], known from a calibration. Without it,
    # the outer line on a side without skipped lines is the first one in the image.
    anchor: tuple[float, float] | None = None

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Accepted (rows, columns); empty: any. Raises UsageError for impossible ones."""
        rows, cols = self.rows, self.cols
        if rows is None and cols is None:
            return ()
        if rows is None or cols is None:
            raise UsageError("give both rows and cols of the grid of markers, or neither")
        if not all(isinstance(lines, int | np.integer) and 3 <= lines <= 200 for lines in (rows, cols)):
            raise UsageError(f"a grid of markers has 3 to 200 rows and columns, got {rows} × {cols}")
        return ((rows, cols), (cols, rows)) if self.either_way and rows != cols else ((rows, cols),)


@dataclass(frozen=True)
class GridExtent:
    """The part of a printed grid that an image shows: lines with at least 30 % entire dots."""

    rows: int
    cols: int
    sides: tuple[Side, Side, Side, Side]
    middle: tuple[float, float]  # position of the marker in row rows // 2 and column cols // 2 [px]

    def possible_skips(self, rows: int, cols: int) -> list[Skipped]:
        """The skipped lines that this part may have in a printed grid of `rows` × `cols`; empty: none fit."""
        vertical = _possible_skips(rows - self.rows, *self.sides[:2])
        across = _possible_skips(cols - self.cols, *self.sides[2:])
        return [(*one, *other) for one in vertical for other in across]


def _possible_skips(missing: int, first: Side, last: Side) -> list[tuple[int, int]]:
    """The possible numbers of lines before the first and after the last visible line, `missing` in total."""
    fewest = [int(side == "continues") for side in (first, last)]
    most = [0 if side == "ends" else missing for side in (first, last)]
    if missing == 0:
        return [(0, 0)]  # a dot beyond a complete grid is dirt or damage
    numbers = range(missing + 1)
    return [(n, missing - n) for n in numbers if fewest[0] <= n <= most[0] and fewest[1] <= missing - n <= most[1]]


def completeness(lattice: Lattice, dots: DetectedDots) -> Floats:
    """1 at nodes with an entire dot, 0.01 at nodes with a cut one, 0 elsewhere, shape (rows, columns)."""
    occupied = lattice.dots >= 0
    return np.where(occupied, np.where(dots.inside[lattice.dots], 1.0, 0.01), 0.0)


def trim(complete: Floats, least: float = _MOSTLY_COMPLETE) -> tuple[int, int, int, int]:
    """The part of the grid whose outer lines are complete enough: top, bottom, left, right.

    A line is complete enough with `least` of its dots, or with `_PRINTED` of them if the image border cuts none.
    """
    top, bottom, left, right = 0, complete.shape[0], 0, complete.shape[1]
    while bottom - top >= 3 and right - left >= 3:
        part = complete[top:bottom, left:right]
        edges = (part[0], part[-1], part[:, 0], part[:, -1])
        shares = [line.mean() / (least if ((line > 0) & (line < 1)).any() else min(least, _PRINTED)) for line in edges]
        worst = int(np.argmin(shares))
        if shares[worst] >= 1:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return top, bottom, left, right


def grid_extent(
    lattice: Lattice, dots: DetectedDots, response: NDArray[np.float32], brightness: NDArray[np.float32]
) -> GridExtent:
    """The visible part of the grid.

    `response` is the smoothed contrast of the image, `brightness` that of the gel [grey levels].
    """
    top, bottom, left, right = trim(completeness(lattice, dots), _PARTLY_COMPLETE)
    if min(bottom - top, right - left) < 3:
        (top, left), (bottom, right) = (0, 0), lattice.shape
    index = lattice.dots[top:bottom, left:right]
    nodes = interpolate_nodes(dots.centers[index], index >= 0)
    known = index[index >= 0]
    contrast, gel = float(np.median(dots.peaks[known])), float(np.median(_values(brightness, dots.centers[known])))
    reach = max(int(0.3 * lattice.spacing), 1)
    strongest = _highest(response, reach)
    sides = []
    for first, second in (
        (nodes[0], nodes[1]),
        (nodes[-1], nodes[-2]),
        (nodes[:, 0], nodes[:, 1]),
        (nodes[:, -1], nodes[:, -2]),
    ):
        beyond = 2 * first - second
        limit = np.array([response.shape[1] - 1, response.shape[0] - 1])
        border = np.minimum(beyond, limit - beyond).min(axis=1)
        near = border > -0.25 * lattice.spacing
        peaks = _values(strongest, beyond)
        present = near & (peaks > _PRESENT * contrast)
        absent = (border > 0.25 * lattice.spacing) & ~present & (_values(brightness, beyond) > _GEL_BRIGHTNESS * gel)
        enough = max(3, 0.25 * len(beyond))
        sides.append(_side(int(present.sum()), int(absent.sum()), enough))
    middle = nodes[(bottom - top) // 2, (right - left) // 2].tolist()
    return GridExtent(bottom - top, right - left, (sides[0], sides[1], sides[2], sides[3]), (middle[0], middle[1]))


def _side(present: int, absent: int, enough: float) -> Side:
    if present >= enough:
        return "continues"
    return "ends" if absent >= enough else "unknown"


def _highest(response: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    return np.asarray(cv2.dilate(response, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)), dtype=np.float32)


def _values(image: NDArray[np.float32], positions: Floats) -> NDArray[np.float32]:
    """Pixels of `image` nearest to `positions` (right, down), clipped to the image."""
    limit = (image.shape[1] - 1, image.shape[0] - 1)
    right, down = np.clip(np.rint(positions), 0, limit).astype(np.intp).T
    return np.asarray(image[down, right])


def select_part(
    lattice: Lattice, dots: DetectedDots, request: GridRequest, extent: Callable[[], GridExtent]
) -> tuple[str, Lattice | None]:
    """The part of `lattice` that is the requested grid, or None and the reason when it is ambiguous.

    `extent` is called for a partly visible grid only.
    """
    complete = completeness(lattice, dots)
    top, bottom, left, right = trim(complete)
    if not request.shapes:
        if bottom - top < 3 or right - left < 3:
            return "the grid of markers in the image has fewer than 3 × 3 entire dots", None
        return "", _part(lattice, top, left, bottom - top, right - left)
    found = f"the image shows {bottom - top} rows of {right - left} entire markers"
    found += f", expected {request.rows} × {request.cols}"
    if any(request.skipped):
        return _select_visible_part(lattice, dots, request, extent(), found)
    windows = ((size, _best_window(complete, *size)) for size in request.shapes)
    size, (count, top_best, left_best, second) = max(windows, key=lambda choice: choice[1][0])
    if count < _MIN_COUNT * size[0] * size[1]:
        return f"{found}: correct rows and columns, or leave them out to detect them", None
    if count - second < 0.25 * min(size):
        return f"{found}, and it is ambiguous which lines to ignore: correct rows and columns", None
    part = _part(lattice, top_best, left_best, *size)
    occupied = part.dots >= 0
    outer = min(float(line.mean()) for line in (occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1]))
    if outer < _PARTLY_COMPLETE:  # dirt may look like a line of few dots and stand in for a missing line
        return f"{found}: an outer line has {outer:.0%} of its markers; correct rows and columns", None
    return "", part


def _select_visible_part(
    lattice: Lattice, dots: DetectedDots, request: GridRequest, extent: GridExtent, found: str
) -> tuple[str, Lattice | None]:
    """The requested part of a partly visible grid, located by the anchor or by the ends of the printed grid."""
    ((rows, cols),) = request.shapes[:1]
    part = trim(completeness(lattice, dots), _PARTLY_COMPLETE)
    if request.anchor is not None:
        start, reason = _start_at_anchor(lattice, dots, request.anchor, rows, cols)
    else:
        start, reason = _start_at_ends(part, extent.sides, request.skipped, rows, cols)
    if start is None:
        return f"{found}; {reason}", None
    top, left = start
    outside = (top - part[0], part[1] - top - rows, left - part[2], part[3] - left - cols)
    if any(lines > skipped for lines, skipped in zip(outside, request.skipped, strict=True)):
        return (
            f"{found}; it shows lines that are said to be outside the image: correct the visible rows and columns",
            None,
        )
    if any(lines < 0 and side == "ends" for lines, side in zip(outside, extent.sides, strict=True)):
        return f"{found}; the grid ends before the visible rows and columns: calibrate the camera again", None
    wider = Lattice(np.pad(lattice.dots, _BEYOND, constant_values=-1), lattice.spacing, lattice.irregularity)
    top, left = top + _BEYOND, left + _BEYOND
    inside = 0 <= top <= wider.shape[0] - rows and 0 <= left <= wider.shape[1] - cols
    chosen = _part(wider, top, left, rows, cols) if inside else None
    if chosen is None or completeness(chosen, dots).sum() < _MIN_COUNT * rows * cols:
        return f"{found}: correct the visible rows and columns", None
    return "", chosen


def _start_at_anchor(
    lattice: Lattice, dots: DetectedDots, anchor: tuple[float, float], rows: int, cols: int
) -> tuple[tuple[int, int] | None, str]:
    """First row and column in the lattice of the part whose middle marker is at `anchor` [px]; None and the reason."""
    nodes = interpolate_nodes(dots.centers[lattice.dots], lattice.dots >= 0)
    distance = np.linalg.norm(nodes - anchor, axis=-1)
    row, col = (int(k) for k in np.unravel_index(int(distance.argmin()), distance.shape))
    off = distance[row, col] / lattice.spacing
    if off > _ANCHOR_RADIUS:
        return None, (
            f"the markers are {off:.2f} spacings away from their calibrated positions, so rows cannot be told apart: "
            "calibrate the camera again, with the gel at rest"
        )
    return (row - rows // 2, col - cols // 2), ""


def _start_at_ends(
    part: tuple[int, int, int, int], sides: Sequence[Side], skipped: Skipped, rows: int, cols: int
) -> tuple[tuple[int, int] | None, str]:
    """First row and column in the lattice of a part that reaches the end of the grid on one side of each axis."""
    starts = []
    for k, count in ((0, rows), (2, cols)):
        first, last, before, after = part[k], part[k + 1], skipped[k], skipped[k + 1]
        shown = sides[k] if after else sides[k + 1]
        if (before and after) or ((before or after) and shown != "ends"):
            return None, (
                "without a calibration the lines of a partly visible grid cannot be told apart unless the image shows "
                "the end of the grid with a margin of one spacing: calibrate the camera"
            )
        if not before and not after and last - first != count:
            return None, "correct the visible rows and columns"
        starts.append(last - count if before else first)
    return (starts[0], starts[1]), ""


def _part(lattice: Lattice, top: int, left: int, rows: int, cols: int) -> Lattice:
    return Lattice(lattice.dots[top : top + rows, left : left + cols], lattice.spacing, lattice.irregularity)


def _best_window(complete: Floats, rows: int, cols: int) -> tuple[float, int, int, float]:
    """The window of rows × cols with the most dots: (dots, top, left, dots of the second best window)."""
    if rows > complete.shape[0] or cols > complete.shape[1]:
        return 0.0, 0, 0, 0.0
    total = np.pad(complete.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = total[rows:, cols:] - total[:-rows, cols:] - total[rows:, :-cols] + total[:-rows, :-cols]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    others = np.delete(sums.reshape(-1), int(sums.argmax()))
    return float(sums.max()), int(top), int(left), float(others.max()) if len(others) else 0.0
