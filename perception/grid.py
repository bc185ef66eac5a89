"""Finds the grid of markers in a first image. The numbers of rows and columns are optional."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.detect import BRIGHT, DARK, DetectedDots, DotAppearance, detect_dots, downsample, local_contrast
from gelflow.perception.errors import TrackerInitError, draw_detections
from gelflow.perception.lattice import Lattice, fill_from_neighbours, grow_lattice

Polarity = Literal["auto", "dark", "bright"]

_RADII = (2.2, 3.2, 4.6, 6.6, 9.5, 14.0)  # of the searched dots [px], in an image of about _SEARCH_SIZE px
_SEARCH_SIZE = 360
_MAX_DOTS = 2500  # weaker dots are texture
_MAX_BETWEEN = 0.4  # limit of (dots between the rows and columns) / (dots of the grid)
_MAX_IRREGULARITY = 0.12  # limit of `Lattice.irregularity`


@dataclass(frozen=True)
class MarkerGrid:
    """The grid of markers at rest in the first image. Rows run downwards, columns rightwards."""

    appearance: DotAppearance
    radius: float  # of a dot [px]
    spacing: float  # of neighbouring markers [px]
    positions: NDArray[np.float64]  # (right, down) [px], shape (rows, columns, 2); interpolated where not visible
    visible: NDArray[np.bool_]  # shape (rows, columns)

    @property
    def shape(self) -> tuple[int, int]:
        return self.visible.shape[0], self.visible.shape[1]

    def scaled(self, factor: float) -> "MarkerGrid":
        """The same grid in the image scaled by `factor`."""
        positions = (self.positions + 0.5) * factor - 0.5
        return replace(self, radius=factor * self.radius, spacing=factor * self.spacing, positions=positions)


@dataclass(frozen=True)
class _Request:
    """The grid that the caller expects."""

    rows: int | None
    cols: int | None
    shapes: tuple[tuple[int, int], ...]  # accepted (rows, columns); empty: any
    polarity: Polarity


def find_grid(
    image: NDArray[np.uint8],
    *,
    rows: int | None = None,
    cols: int | None = None,
    either_way: bool = True,
    polarity: Polarity = "auto",
) -> MarkerGrid:
    """Finds the grid of markers in `image` (B G R).

    With `rows` and `cols`, the grid has this shape or, with `either_way`, the transposed one; further lines that the
    image border cuts are ignored. Without them, the grid consists of all lines that are mostly visible. Raises
    TrackerInitError when no grid or a grid of another shape is found, UsageError for impossible `rows` and `cols`.
    """
    request = _Request(rows, cols, _accepted_shapes(rows, cols, either_way), polarity)
    shrink = max(1, round(max(image.shape[:2]) / _SEARCH_SIZE))
    small = downsample(image, shrink)
    appearances = _candidate_appearances(small, polarity)
    best = _search(small, appearances)
    if best is None:
        raise _no_grid_error(image, appearances[0], polarity)
    appearance, radius, spacing = best
    # Repeats the detection with the estimated radius and spacing.
    response = local_contrast(small, appearance, _background_window(spacing))
    dots = _plausible(detect_dots(response, radius=radius, min_distance=0.4 * spacing))
    lattice = grow_lattice(dots.centers)
    reason, part = _rejection_reason(lattice, dots, polarity), None
    if lattice is not None and not reason:
        reason, part = _select_part(lattice, dots, request)
    if part is None:
        raise TrackerInitError(reason, draw_detections(small, dots.centers, radius, lattice.dots if lattice else None))
    return _marker_grid(appearance, part, dots).scaled(shrink)


def _background_window(spacing: float) -> int:
    """Side of the box of the local mean [px]: one period, so that a regular grid leaves no ripple."""
    return max(round(spacing), 3) | 1


def _candidate_appearances(image: NDArray[np.uint8], polarity: Polarity) -> tuple[DotAppearance, ...]:
    """The appearances to try, likely ones first: dots are a minority of pixels, so the contrast is skewed."""
    if polarity != "auto":
        return DARK if polarity == "dark" else BRIGHT
    response = local_contrast(image, BRIGHT[0], round(5 * _RADII[2]))
    return BRIGHT + DARK if float((response**3).mean()) > 0 else DARK + BRIGHT


def _no_grid_error(image: NDArray[np.uint8], appearance: DotAppearance, polarity: Polarity) -> TrackerInitError:
    """The error for an image without a grid, with the number of detected dots."""
    sizes = [
        (
            r,
            detect_dots(local_contrast(image, appearance, round(5 * r)), radius=r, min_distance=1.5 * r, threshold=0.1),
        )
        for r in _RADII[::2]
    ]
    radius, dots = max(sizes, key=lambda size: len(size[1]))
    if len(dots) > _MAX_DOTS:
        found = f"{len(dots)} dots detected, a grid of markers has at most {_MAX_DOTS}"
    elif len(dots) >= 9:
        found = f"{len(dots)} dots detected, they form no rows and columns"
    else:
        found = f"{len(dots) or 'no'} dots detected, a grid of markers has at least 3 × 3"
    picture = draw_detections(image, dots.centers, radius, None)
    return TrackerInitError(f"no grid of markers found in the image: {found}{_hint(polarity)}", picture)


def _hint(polarity: Polarity) -> str:
    restriction = {"dark": " (only dark dots were searched)", "bright": " (only bright dots were searched)", "auto": ""}
    return f"{restriction[polarity]}; check illumination, focus and that the image shows a gel"


def _accepted_shapes(rows: int | None, cols: int | None, either_way: bool) -> tuple[tuple[int, int], ...]:
    if rows is None and cols is None:
        return ()
    if rows is None or cols is None:
        raise UsageError("give both rows and cols of the grid of markers, or neither")
    if min(rows, cols) < 3 or max(rows, cols) > 200:
        raise UsageError(f"a grid of markers has 3 to 200 rows and columns, got {rows} × {cols}")
    return ((rows, cols), (cols, rows)) if either_way and rows != cols else ((rows, cols),)


def _plausible(dots: DetectedDots) -> DetectedDots:
    """The strongest dots, without those of unusual area."""
    if len(dots) > _MAX_DOTS:
        dots = dots.select(np.sort(np.argsort(-dots.peaks, kind="stable")[:_MAX_DOTS]))
    if len(dots) < 9:
        return dots
    median = np.median(dots.areas)
    return dots.select((dots.areas > 0.3 * median) & (dots.areas < 3 * median))


def _rejection_reason(lattice: Lattice | None, dots: DetectedDots, polarity: Polarity) -> str:
    """The reason why `lattice` is not a grid of markers; empty if it may be one."""
    if lattice is None or lattice.irregularity > _MAX_IRREGULARITY:
        return f"no regular grid of markers found in the image{_hint(polarity)}"
    between = _count_between(lattice, dots)
    if between > _MAX_BETWEEN * lattice.dot_count:
        return (
            f"{between} dots lie between the rows and columns of the {lattice.dot_count} that form a grid: "
            "not markers, or a grid rotated by more than 30° in the image"
        )
    return ""


def _count_between(lattice: Lattice, dots: DetectedDots) -> int:
    """Number of dots inside the grid that do not belong to it. A grid of diagonals has as many as its own dots."""
    index = lattice.dots[lattice.dots >= 0]
    low, high = dots.centers[index].min(axis=0), dots.centers[index].max(axis=0)
    between = ((dots.centers > low) & (dots.centers < high)).all(axis=1)
    between[index] = False
    return int(between.sum())


def _dot_radius(dots: DetectedDots, lattice: Lattice) -> float:
    return float(np.sqrt(np.median(dots.areas[lattice.dots[lattice.dots >= 0]]) / np.pi))


def _completeness(lattice: Lattice, dots: DetectedDots) -> NDArray[np.float64]:
    """1 at nodes with an entire dot, 0.01 at nodes with a cut one, 0 elsewhere, shape (rows, columns)."""
    occupied = lattice.dots >= 0
    return np.where(occupied, np.where(dots.inside[lattice.dots], 1.0, 0.01), 0.0)


def _search(
    image: NDArray[np.uint8], appearances: tuple[DotAppearance, ...]
) -> tuple[DotAppearance, float, float] | None:
    """Appearance, dot radius and spacing [px] of the best grid: many dots, few gaps, regular steps, high contrast."""
    best, best_score = None, 0.0
    for appearance in appearances:
        for radius in _RADII:
            response = local_contrast(image, appearance, round(5 * radius))
            dots = _plausible(detect_dots(response, radius=radius, min_distance=1.5 * radius))
            lattice = grow_lattice(dots.centers)
            if lattice is None or lattice.irregularity > _MAX_IRREGULARITY or _are_gaps(response, dots, lattice):
                continue
            score, certain = _score(response, dots, lattice)
            if score > best_score:
                best, best_score = (appearance, _dot_radius(dots, lattice), lattice.spacing), score
            if certain:
                return best
    return best


def _score(response: NDArray[np.float32], dots: DetectedDots, lattice: Lattice) -> tuple[float, bool]:
    """Score of a grid, and whether the search can stop with it."""
    completeness = _completeness(lattice, dots)
    top, bottom, left, right = _trim(completeness)
    inner = completeness[top:bottom, left:right]
    texture = 1.5 * float(np.median(np.abs(response[::3, ::3]))) + 1e-3
    clear = float(np.median(dots.peaks[lattice.dots[lattice.dots >= 0]])) / texture
    share = float(inner.mean())
    score = float(inner.sum()) * share * (1 - lattice.irregularity / _MAX_IRREGULARITY) * clear / (clear + 4)
    regular = lattice.irregularity < 0.5 * _MAX_IRREGULARITY
    return score, clear > 4 and share > 0.85 and regular and bool(inner.sum() > 0.8 * len(dots))


def _are_gaps(response: NDArray[np.float32], dots: DetectedDots, lattice: Lattice) -> bool:
    """Whether `lattice` is the grid of the gaps between dots, which differ slightly from the mean of dots and gel.

    The opposite contrast, that of the dots, is then much larger.
    """
    opposite = -float(np.quantile(response[::3, ::3], 0.01))
    return float(np.median(dots.peaks[lattice.dots[lattice.dots >= 0]])) < 0.5 * opposite


def _trim(completeness: NDArray[np.float64]) -> tuple[int, int, int, int]:
    """The part of the grid whose outer lines are mostly complete: top, bottom, left, right."""
    top, bottom, left, right = 0, completeness.shape[0], 0, completeness.shape[1]
    while bottom - top >= 3 and right - left >= 3:
        part = completeness[top:bottom, left:right]
        rows, columns = part.mean(axis=1), part.mean(axis=0)
        edges = (rows[0], rows[-1], columns[0], columns[-1])
        worst = int(np.argmin(edges))
        if edges[worst] >= 0.6:
            break
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return top, bottom, left, right


def _best_window(completeness: NDArray[np.float64], rows: int, cols: int) -> tuple[float, int, int, float]:
    """The window of rows × cols with the most dots: (dots, top, left, dots of the second best window)."""
    if rows > completeness.shape[0] or cols > completeness.shape[1]:
        return 0.0, 0, 0, 0.0
    total = np.pad(completeness.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    sums = total[rows:, cols:] - total[:-rows, cols:] - total[rows:, :-cols] + total[:-rows, :-cols]
    top, left = np.unravel_index(int(sums.argmax()), sums.shape)
    others = np.delete(sums.reshape(-1), int(sums.argmax()))
    return float(sums.max()), int(top), int(left), float(others.max()) if len(others) else 0.0


def _select_part(lattice: Lattice, dots: DetectedDots, request: _Request) -> tuple[str, Lattice | None]:
    """The part of `lattice` that is the printed grid, or None and the reason when it is ambiguous."""
    completeness = _completeness(lattice, dots)
    top, bottom, left, right = _trim(completeness)
    if not request.shapes:
        if bottom - top < 3 or right - left < 3:
            return "the grid of markers in the image has fewer than 3 × 3 entire dots", None
        return "", Lattice(lattice.dots[top:bottom, left:right], lattice.spacing, lattice.irregularity)
    windows = ((size, _best_window(completeness, *size)) for size in request.shapes)
    size, (count, top_best, left_best, second) = max(windows, key=lambda choice: choice[1][0])
    found = f"the image shows {bottom - top} rows of {right - left} entire markers"
    found += f", expected {request.rows} × {request.cols}"
    if count < 0.7 * size[0] * size[1]:
        return f"{found}: correct rows and columns, or leave them out to detect them", None
    if count - second < 0.25 * min(size):
        return f"{found}, and it is ambiguous which lines to ignore: correct rows and columns", None
    part = lattice.dots[top_best : top_best + size[0], left_best : left_best + size[1]]
    return "", Lattice(part, lattice.spacing, lattice.irregularity)


def _marker_grid(appearance: DotAppearance, lattice: Lattice, dots: DetectedDots) -> MarkerGrid:
    index = lattice.dots
    median = float(np.median(dots.areas[index[index >= 0]]))
    area = dots.areas[index]
    visible = (index >= 0) & dots.inside[index] & (area > 0.4 * median) & (area < 2.0 * median)
    positions = _interpolate(dots.centers[index], index >= 0)
    return MarkerGrid(appearance, float(np.sqrt(median / np.pi)), lattice.spacing, positions, visible)


def _interpolate(positions: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Interpolates unknown nodes: a bilinear fit to the known nodes plus the deviation of the neighbours from it."""
    row, column = np.meshgrid(*(np.arange(n, dtype=float) for n in known.shape), indexing="ij")
    terms = np.stack([np.ones_like(row), row, column, row * column], axis=-1)
    fit = terms @ np.linalg.lstsq(terms[known], positions[known], rcond=None)[0]
    deviation = fill_from_neighbours(positions - fit, known)
    return np.where(known[..., None], positions, fit + deviation)
