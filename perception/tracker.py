"""The marker tracker: position and displacement of the markers of one camera, image by image.

The first image is the reference: it gives the grid of markers and the dot model. Images at rest that follow refine the
reference. In each further image, all dots are detected again, which avoids drift, assigned to markers and fitted with
the dot model. The C++ part in csrc processes each image: dot_detector.hpp detects, assignment.hpp assigns, dot_fit.hpp
fits. Images with large dots are downsampled for it, which is faster, and fits converge from further away. Intact dots
that are not too large for the window of a fit are then fitted again in the image itself. Equal images in equal order
give bit-identical results.
"""

from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.perception._tracker import LARGEST_REFINEMENT, Tracker
from gelflow.perception.dot_model import DotModel, fit_dot_model
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.grid_detection.detect import downsample
from gelflow.perception.grid_detection.grid import MarkerGrid, find_grid
from gelflow.perception.grid_detection.grid_part import GridRequest, Polarity

_MAX_RADIUS = 10.0  # of a dot [px] in the image that is searched for dots
_MAX_FINE_RADIUS = 12.5  # of a dot [px] in the image in which dots are fitted again


@dataclass(frozen=True)
class TrackerConfig:
    """Prior knowledge of the markers. Raises UsageError for an unknown polarity."""

    rows: int | None = None  # rows of markers in the image; None: detected
    cols: int | None = None  # markers in a row; None: detected
    either_way: bool = True  # also accept the transposed shape, rows and cols exchanged in the image
    polarity: Polarity = "auto"  # dots are "dark" or "bright" relative to the gel
    # Of a partly visible grid, `rows` and `cols` being the visible ones; see `GridRequest`.
    skipped: tuple[int, int, int, int] = (0, 0, 0, 0)
    anchor: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.polarity not in get_args(Polarity):
            raise UsageError(f"polarity must be one of {', '.join(get_args(Polarity))}, got {self.polarity!r}")


@dataclass(frozen=True)
class TrackingResult:
    """The markers in one image, row by row from the top, each row from the left."""

    position: NDArray[np.float64]  # (right, down) [px], shape (markers, 2); predicted where not valid
    displacement: NDArray[np.float64]  # from rest [px], shape (markers, 2); NaN where neither valid nor inferred
    valid: NDArray[np.bool_]  # measured in this image, shape (markers,)
    inferred: NDArray[np.bool_]  # not measured, interpolated from neighbours, shape (markers,)
    quality: NDArray[np.float64]  # fraction of the dot edge that the fit explains, 0 where not valid, shape (markers,)
    rows: int  # in the image
    cols: int  # markers in a row
    spacing: float  # of the markers in the first image [px]


@dataclass(frozen=True)
class _Scale:
    """The tracker started with the first image at one resolution."""

    tracker: Tracker
    model: DotModel
    shrink: int  # downsampling factor of the images

    def rest(self) -> NDArray[np.float64]:
        """Positions of the markers at rest in the image that is not downsampled [px], shape (markers, 2)."""
        return _upscaled(self.tracker.rest(), self.shrink)


@dataclass(frozen=True)
class _Refinement:
    """Fits intact dots again, in images that are less downsampled."""

    scale: _Scale
    intact: NDArray[np.bool_]  # dots that are fitted, shape (markers,)

    def rest(self, coarse: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions at rest [px], those of `coarse` for dots that are not intact, shape (markers, 2)."""
        return np.where(self.intact[:, None], self.scale.rest(), coarse)

    def displacement(
        self,
        image: NDArray[np.uint8],
        position: NDArray[np.float64],
        displacement: NDArray[np.float64],
        valid: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Displacements [px] where the fit of a valid marker ends near `position`, and `displacement` elsewhere."""
        shrink = self.scale.shrink
        begin = (position + 0.5) / shrink - 0.5
        found = self.scale.tracker.refine(downsample(image, shrink), begin, valid & self.intact)
        return np.where(found.valid[:, None], shrink * found.displacement, displacement)


@dataclass(frozen=True)
class _Reference:
    """The tracker started with the first image."""

    coarse: _Scale  # which detects and assigns the dots
    fine: _Refinement | None  # None where the coarse one suffices
    size: tuple[int, int]  # height and width of the images [px]
    rows: int
    cols: int
    spacing: float  # [px]

    def rest(self) -> NDArray[np.float64]:
        """Positions of the markers at rest [px], shape (markers, 2)."""
        rest = self.coarse.rest()
        return rest if self.fine is None else self.fine.rest(rest)


class MarkerTracker:
    """Tracks the markers of one camera. Displacements are relative to the first image."""

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = TrackerConfig() if config is None else config
        self._reference: _Reference | None = None

    @property
    def rest(self) -> NDArray[np.float64]:
        """Positions of the markers at rest (right, down) [px], shape (markers, 2), row by row.

        They are the mean over up to eight images after the start, as long as nothing moves. Raises UsageError before
        `start`.
        """
        if self._reference is None:
            raise UsageError("the tracker has no rest positions yet: start it with an image at rest")
        return self._reference.rest()

    def start(self, image: NDArray[np.uint8], rows: int | None = None, cols: int | None = None) -> TrackingResult:
        """Finds the grid of markers in `image` (B G R or grey) and makes it the reference, with zero displacements.

        `rows` and `cols` replace those of the configuration. Raises TrackerInitError when the image does not clearly
        show such a grid, UsageError when `image` is not an image array or only one of `rows` and `cols` is given.
        """
        if (rows is None) != (cols is None):
            raise UsageError("give both rows and cols, or neither")
        config = self.config
        image = _as_bgr(image)
        rows, cols = (config.rows, config.cols) if rows is None else (rows, cols)
        request = GridRequest(rows, cols, config.either_way, config.polarity, config.skipped, config.anchor)
        grid = find_grid(image, request)
        coarse = _started(image, grid, _MAX_RADIUS)
        fine = _refinement(image, grid, coarse)
        rows, cols = grid.shape
        self._reference = _Reference(coarse, fine, (image.shape[0], image.shape[1]), rows, cols, grid.spacing)
        visible = coarse.model.visible
        rest, quality = self._reference.rest(), coarse.model.quality
        return TrackingResult(rest, np.zeros_like(rest), visible, ~visible, quality, rows, cols, grid.spacing)

    def track(self, image: NDArray[np.uint8]) -> TrackingResult:
        """The markers in the next image (B G R or grey). Without `start`, the first image must show
        the gel at rest: it becomes the reference.

        Markers that are hidden or ambiguous are not valid. Raises PeerError when the image size changes, UsageError
        when `image` is not an image array.
        """
        reference = self._reference
        if reference is None:
            return self.start(image)
        image = _as_bgr(image)
        if image.shape[:2] != reference.size:
            got, expected = (f"{width} × {height} px" for height, width in (image.shape[:2], reference.size))
            raise PeerError(f"the image size changed from {expected} to {got}: start the tracker again")
        shrink = reference.coarse.shrink
        result = reference.coarse.tracker.track(downsample(image, shrink))
        position, displacement = result.position, result.displacement
        if shrink > 1:
            position, displacement = _upscaled(position, shrink), shrink * displacement
        if reference.fine is not None:
            displacement = reference.fine.displacement(image, position, displacement, result.valid)
            position = np.where(np.isfinite(displacement), reference.rest() + displacement, position)
        grid = reference.rows, reference.cols, reference.spacing
        return TrackingResult(position, displacement, result.valid, result.inferred, result.quality, *grid)


def _started(image: NDArray[np.uint8], grid: MarkerGrid, max_radius: float) -> _Scale:
    """The tracker started on `image`, downsampled until the radius of its dots is at most `max_radius` [px]."""
    shrink = _shrink(grid, max_radius)
    tracker, model = fit_dot_model(downsample(image, shrink), grid.scaled(1 / shrink))
    return _Scale(tracker, model, shrink)


def _shrink(grid: MarkerGrid, max_radius: float) -> int:
    return max(1, int(np.ceil(grid.radius / max_radius)))


def _refinement(image: NDArray[np.uint8], grid: MarkerGrid, coarse: _Scale) -> _Refinement | None:
    """`fine` of a `_Reference`."""
    if _shrink(grid, _MAX_FINE_RADIUS) == coarse.shrink:
        return None
    try:
        fine = _started(image, grid, _MAX_FINE_RADIUS)
    except TrackerInitError:
        return None
    offset = np.linalg.norm(fine.rest() - coarse.rest(), axis=1)
    intact = fine.model.visible & (fine.model.mask_of < 0) & (coarse.model.mask_of < 0)
    return _Refinement(fine, intact & (offset < LARGEST_REFINEMENT * grid.radius))


def _as_bgr(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`image` as a contiguous B G R array. Raises UsageError when it is not an image array."""
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


def _upscaled(position: NDArray[np.float64], shrink: int) -> NDArray[np.float64]:
    """Positions in a downsampled image as positions in the original image [px]."""
    return (position + 0.5) * shrink - 0.5
