"""The dot model, estimated from the first image: dot profile, shape and contrast per marker, and pixel noise.

All dots have one profile over the distance from the centre relative to the outline. The outline of a dot begins as an
ellipse: the local grid steps, which contain tilt, keystone and lens distortion, times one common matrix for the print.
Its own size, ellipse and raggedness follow by least squares. Centres, outlines and profile are estimated alternately.
At last, damaged dots get an outline and a mask from their intact part.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gelflow.perception._tracker import MASK_CELLS, PROFILE_STEPS, Tracker
from gelflow.perception.damaged_dots import find_damaged
from gelflow.perception.dot_windows import PROFILE_REACH, DotWindows, Floats, initial_profile
from gelflow.perception.errors import TrackerInitError, draw_detections
from gelflow.perception.grid_detection.detect import PLANES, image_plane
from gelflow.perception.grid_detection.grid import MarkerGrid

_ROUNDS = 2  # of the alternating estimation
_MIN_MATCHING = 0.6  # fraction of the dots that must match the common profile
_TOLERATED = (0.16, 0.7)  # smallest and largest tolerated residual / contrast
_USUAL = 0.03  # standard deviation of the residuals of an intact dot / contrast: JPEG, quantization
_UNEXPLAINED = 6.0  # tolerated residual / standard deviation of what the model does not explain at rest


@dataclass(frozen=True)
class DotModel:
    """The dot model of a `Tracker`. Markers row by row."""

    rest: Floats  # positions at rest (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # whether the first image shows the dot, shape (markers,)
    # Frame of each dot as xx, xy, yx, yy [1/px]: maps an offset from the centre to coordinates in which the dot is a
    # disc of radius 1; then the coefficients of the waves of its outline (`DotPixels.waves`). Shape (markers, 8).
    shape: Floats
    contrast: Floats  # of each dot, negative for dark dots, shape (markers,)
    tolerated: Floats  # residual / contrast at which a pixel has half the weight, shape (markers,)
    # At equidistant squared radii up to PROFILE_REACH², 1 inside, 0 outside; shape (PROFILE_STEPS + 1,).
    profile: NDArray[np.float32]
    noise: float  # standard deviation of a pixel / background
    quality: Floats  # of the fit of each dot, 0 where not visible, shape (markers,)
    mask_of: NDArray[np.intp]  # index of the mask of each dot, -1 for a dot without a mask, shape (markers,)
    masks: NDArray[np.float32]  # as in `DamagedDots`


def fit_dot_model(image: NDArray[np.uint8], grid: MarkerGrid) -> tuple[Tracker, DotModel]:
    """A tracker started on the marker `grid` of `image` (B G R), and its dot model.

    Raises TrackerInitError when the dots do not have a common profile or cannot be fitted.
    """
    _matching(image, grid, grid.visible.astype(np.float64).reshape(-1))
    try:
        return _fit(image, grid)
    except ValueError as error:  # profile without an edge, or dots that touch
        picture = draw_detections(image, grid.positions[grid.visible], grid.radius, None)
        raise TrackerInitError(f"the spots in rows and columns cannot be measured as dots: {error}", picture) from None


def _fit(image: NDArray[np.uint8], grid: MarkerGrid) -> tuple[Tracker, DotModel]:
    plane = image_plane(image, grid.appearance.plane).astype(np.float64)
    windows = DotWindows(plane, grid)
    shape = windows.common
    sign = 1.0 if grid.appearance.bright else -1.0
    profile = initial_profile(np.sqrt(np.linspace(0, PROFILE_REACH**2, PROFILE_STEPS + 1)))
    visible = grid.visible.reshape(-1)
    contrast = np.full(len(visible), sign * float(np.median(windows.contrast)))
    quality, tolerated = visible.astype(np.float64), np.full(len(visible), _TOLERATED[0])
    mask_of, masks = np.full(len(visible), -1), np.empty((0, MASK_CELLS, MASK_CELLS), dtype=np.float32)
    model = DotModel(
        grid.positions.reshape(-1, 2), visible, shape, contrast, tolerated, profile, 0.02, quality, mask_of, masks
    )
    for _ in range(_ROUNDS):
        fit = _make_tracker(image, grid, model).start(image)
        shape = windows.refined(fit.position, model.shape, model.profile)
        other = _make_tracker(image, grid, replace(model, shape=shape, rest=fit.position)).start(image)
        better = other.quality > fit.quality  # a damaged dot may match with its former shape only
        shape = np.where(better[:, None], shape, model.shape)
        rest = np.where(better[:, None], other.position, fit.position)
        visible = _matching(image, grid, np.maximum(fit.quality, other.quality))
        contrast = np.where(better, other.contrast, fit.contrast)
        contrast = np.where(visible, contrast, np.median(contrast[visible]))
        profile, noise = windows.profile(rest, shape, visible)
        model = replace(model, contrast=contrast, rest=rest, shape=shape, profile=profile, noise=noise)
    model = _with_masks(image, grid, windows, model)
    model = replace(model, tolerated=_tolerated(windows, model))
    tracker = _make_tracker(image, grid, model)
    fit = tracker.start(image)
    visible = _matching(image, grid, fit.quality)
    return tracker, replace(model, rest=fit.position, visible=visible, quality=fit.quality)


def _with_masks(image: NDArray[np.uint8], grid: MarkerGrid, windows: DotWindows, model: DotModel) -> DotModel:
    """The model with the masks of damaged dots, except those whose intact part does not determine the centre."""
    damaged = find_damaged(windows, model.rest, model.shape, model.profile)
    if damaged is None:
        return model
    rest, shape, mask_of = model.rest.copy(), model.shape.copy(), model.mask_of.copy()
    rest[damaged.markers], shape[damaged.markers] = damaged.rest, damaged.shape
    mask_of[damaged.markers] = np.arange(len(damaged.markers))
    masked = replace(model, rest=rest, shape=shape, mask_of=mask_of, masks=damaged.masks)
    fit = _make_tracker(image, grid, masked).start(image)
    use = (fit.quality > 0) & (mask_of >= 0)
    return replace(
        masked,
        rest=np.where(use[:, None], fit.position, model.rest),
        shape=np.where(use[:, None], shape, model.shape),
        mask_of=np.where(use, mask_of, -1),
    )


def _tolerated(windows: DotWindows, model: DotModel) -> Floats:
    """Tolerated residuals as in `DotModel`: more for a dot that the model does not explain at rest.

    Dots with a mask, or without an outline of their own, get the smallest value: damaged pixels must be without weight.
    """
    residual, radius = windows.residuals(model.rest, model.shape, model.profile)
    inside = radius < 1.5
    variance = (residual**2 * inside).sum(1) / inside.sum(1) - (model.noise / model.contrast[windows.markers]) ** 2
    variance -= _USUAL**2
    intact = windows.have_own_shape(model.shape) & (model.mask_of[windows.markers] < 0)
    result = np.full(len(model.rest), _TOLERATED[0])
    unexplained = np.sqrt(np.maximum(variance, 0.0)) * intact
    result[windows.markers] = np.clip(_TOLERATED[0] + _UNEXPLAINED * unexplained, *_TOLERATED)
    return result


def _matching(image: NDArray[np.uint8], grid: MarkerGrid, quality: Floats) -> NDArray[np.bool_]:
    """Which dots match the common profile, shape (markers,). Raises TrackerInitError when too few match."""
    visible, dots = quality > 0, int(grid.visible.sum())
    if visible.sum() < max(_MIN_MATCHING * dots, 6):
        raise TrackerInitError(
            f"only {visible.sum()} of {dots} spots in rows and columns have the same shape: they are not printed "
            "markers, or too blurred or damaged",
            draw_detections(image, grid.positions[grid.visible], grid.radius, None),
        )
    return visible


def _make_tracker(image: NDArray[np.uint8], grid: MarkerGrid, model: DotModel) -> Tracker:
    return Tracker(
        width=image.shape[1],
        height=image.shape[0],
        channel=PLANES.index(grid.appearance.plane),
        bright=grid.appearance.bright,
        rows=grid.shape[0],
        cols=grid.shape[1],
        spacing=grid.spacing,
        radius=grid.radius,
        noise=model.noise,
        profile=model.profile,
        profile_reach=PROFILE_REACH**2,
        rest=model.rest,
        visible=model.visible,
        shape=model.shape,
        contrast=model.contrast,
        tolerated=model.tolerated,
        mask_of=model.mask_of,
        masks=model.masks,
    )
