"""Finds the grid of markers in a first image. The numbers of rows and columns are optional."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.errors import TrackerInitError, draw_detections
from gelflow.perception.grid_detection.detect import (
    BRIGHT,
    DARK,
    DetectedDots,
    DotAppearance,
    detect_dots,
    downsample,
    image_plane,
    local_contrast,
    smooth_response,
)
from gelflow.perception.grid_detection.grid_part import (
    GridExtent,
    GridRequest,
    Polarity,
    completeness,
    grid_extent,
    select_part,
    trim,
)
from gelflow.perception.grid_detection.lattice import Lattice, grow_lattice, interpolate_nodes
from gelflow.perception.grid_detection.pattern import pattern_reason

_RADII = (2.2, 3.2, 4.6, 6.6, 9.5, 14.0)  # of the searched dots [px], in an image of about _SEARCH_SIZE px
_SEARCH_SIZE = 360
_MAX_DOTS = 2500  # weaker dots are texture
_MAX_BETWEEN = 0.4  # limit of (dots between the rows and columns) / (dots of the grid)
_MAX_IRREGULARITY = 0.12  # limit of `Lattice.irregularity`
_MAX_AREA = 2.2  # of a dot / median; larger ones are joined dots
_CLEARLY_BETTER = 1.05  # score of a grid / score in an earlier image plane, which has less noise if they are alike


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


def find_grid(image: NDArray[np.uint8], request: GridRequest) -> MarkerGrid:
    """Finds the grid of markers in `image` (B G R).

    With `rows` and `cols` of the request, the grid has this shape or, with `either_way`, the transposed one; further
    lines that the image border cuts are ignored. Without them, the grid consists of the lines that `trim` leaves.
    Raises TrackerInitError when no grid or a grid of another shape is found, UsageError for impossible requests.
    """
    _ = request.shapes  # raises UsageError
    found = _detect(image, request.polarity)
    reason, part = select_part(found.lattice, found.dots, found.request(request), found.extent)
    if part is None:
        raise found.error(reason)
    return _marker_grid(found.appearance, part, found.dots).scaled(found.shrink)


def find_extent(image: NDArray[np.uint8], polarity: Polarity = "auto") -> GridExtent:
    """The part of a printed grid of unknown shape that `image` (B G R) shows.

    Raises TrackerInitError when no grid is found.
    """
    found = _detect(image, polarity)
    extent = found.extent()
    right, down = ((value + 0.5) * found.shrink - 0.5 for value in extent.middle)
    return replace(extent, middle=(right, down))


@dataclass(frozen=True)
class _Detection:
    """The lattice of all dots of an image, found in the image downsampled by `shrink`."""

    image: NDArray[np.uint8]  # downsampled
    shrink: int
    appearance: DotAppearance
    response: NDArray[np.float32]  # contrast of `image`
    radius: float  # of a dot in `image` [px]
    dots: DetectedDots
    lattice: Lattice

    def request(self, request: GridRequest) -> GridRequest:
        """`request` for an image that is an image of `self.shrink` times the size."""
        if request.anchor is None:
            return request
        right, down = ((value + 0.5) / self.shrink - 0.5 for value in request.anchor)
        return replace(request, anchor=(right, down))

    def extent(self) -> GridExtent:
        """The visible part of the printed grid, in pixels of `self.image`."""
        # The local mean is the brightness of the gel, slightly changed by the dots.
        window = 2 * _background_window(self.lattice.spacing) + 1
        grey = image_plane(self.image, "value").astype(np.float32)
        brightness = np.asarray(cv2.boxFilter(grey, -1, (window, window)), dtype=np.float32)
        return grid_extent(self.lattice, self.dots, smooth_response(self.response, self.radius), brightness)

    def error(self, reason: str) -> TrackerInitError:
        """An error with a picture of this detection."""
        return TrackerInitError(reason, draw_detections(self.image, self.dots.centers, self.radius, self.lattice.dots))


def _detect(image: NDArray[np.uint8], polarity: Polarity) -> _Detection:
    """Detects the lattice of all dots in `image`. Raises TrackerInitError when there is none."""
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
    reason = _rejection_reason(lattice, dots, polarity)
    if lattice is None or reason:
        raise TrackerInitError(reason, draw_detections(small, dots.centers, radius, lattice.dots if lattice else None))
    return _Detection(small, shrink, appearance, response, radius, dots, lattice)


def _background_window(spacing: float) -> int:
    """Side of the box of the local mean [px]: one period, so that a regular grid leaves no ripple."""
    return max(round(spacing), 3) | 1


def _candidate_appearances(image: NDArray[np.uint8], polarity: Polarity) -> tuple[DotAppearance, ...]:
    """The appearances to try, likely ones first: dots are a minority of pixels, so the contrast is skewed."""
    if polarity != "auto":
        return DARK if polarity == "dark" else BRIGHT
    response = local_contrast(image, BRIGHT[0], round(5 * _RADII[2]))
    return BRIGHT + DARK if float((response * response * response).mean()) > 0 else DARK + BRIGHT


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
    if lattice.dots.size > _MAX_DOTS:  # the weaker dots of such a grid are omitted
        rows, cols = lattice.dots.shape
        return f"{rows} × {cols} dots detected, a grid of markers has at most {_MAX_DOTS}"
    between = _count_between(lattice, dots)
    if between > _MAX_BETWEEN * lattice.dot_count:
        return (
            f"{between} dots lie between the rows and columns of the {lattice.dot_count} that form a grid: "
            "not markers, or a grid rotated by more than 30° in the image"
        )
    return pattern_reason(lattice, dots)


def _count_between(lattice: Lattice, dots: DetectedDots) -> int:
    """Number of dots inside the grid that do not belong to it. A grid of diagonals has as many as its own dots."""
    index = lattice.dots[lattice.dots >= 0]
    low, high = dots.centers[index].min(axis=0), dots.centers[index].max(axis=0)
    between = ((dots.centers > low) & (dots.centers < high)).all(axis=1)
    between[index] = False
    return int(between.sum())


def _dot_radius(dots: DetectedDots, lattice: Lattice) -> float:
    return float(np.sqrt(np.median(dots.areas[lattice.dots[lattice.dots >= 0]]) / np.pi))


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
            if score > best_score * (1 if best is None or best[0] == appearance else _CLEARLY_BETTER):
                best, best_score = (appearance, _dot_radius(dots, lattice), lattice.spacing), score
            if certain:
                return best
    return best


def _score(response: NDArray[np.float32], dots: DetectedDots, lattice: Lattice) -> tuple[float, bool]:
    """Score of a grid, and whether the search can stop with it."""
    complete = completeness(lattice, dots)
    top, bottom, left, right = trim(complete)
    inner = complete[top:bottom, left:right]
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


def _marker_grid(appearance: DotAppearance, lattice: Lattice, dots: DetectedDots) -> MarkerGrid:
    index = lattice.dots
    median = float(np.median(dots.areas[index[index >= 0]]))
    area = dots.areas[index]
    visible = (index >= 0) & dots.inside[index] & (area > 0.4 * median) & (area < _MAX_AREA * median)
    positions = interpolate_nodes(dots.centers[index], index >= 0)
    return MarkerGrid(appearance, float(np.sqrt(median / np.pi)), lattice.spacing, positions, visible)
