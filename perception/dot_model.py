"""The dot model, estimated from the first image: dot profile, ellipse and contrast per marker, and pixel noise.

All dots are prints of one shape seen through one lens. Each has the same profile over q = dᵀ Q d, d the offset from its
centre. The ellipse Q combines the local grid steps, which contain tilt, keystone and lens distortion, with one
common matrix for the print. Centres and profile are estimated alternately.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception._tracker import PROFILE_STEPS, Tracker
from gelflow.perception.detect import PLANES, image_plane
from gelflow.perception.errors import TrackerInitError, draw_detections
from gelflow.perception.grid import MarkerGrid

Floats = NDArray[np.float64]

_ROUNDS = 2  # of the alternating estimation
_PROFILE_REACH = 2.2  # the profile ends at this many radii
_MIN_MATCHING = 0.6  # fraction of the dots that must match the common profile
_RINGS = 44  # bins of the radius in which the profile is averaged


@dataclass(frozen=True)
class DotModel:
    """The dot model of a `Tracker`. Markers row by row."""

    rest: Floats  # positions at rest (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # whether the first image shows the dot, shape (markers,)
    ellipse: Floats  # Q as xx, xy, yy [1/px²], shape (markers, 3); dᵀ Q d = 1 on the edge of a dot
    contrast: Floats  # of each dot, negative for dark dots, shape (markers,)
    profile: NDArray[
        np.float32
    ]  # at equidistant q up to _PROFILE_REACH², 1 inside, 0 outside, shape (PROFILE_STEPS + 1,)
    noise: float  # standard deviation of a pixel / background
    quality: Floats  # of the fit of each dot, 0 where not visible, shape (markers,)


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
    windows = _DotWindows(plane, grid)
    ellipse = windows.ellipses(grid)
    sign = 1.0 if grid.appearance.bright else -1.0
    profile = _edge(np.sqrt(np.linspace(0, _PROFILE_REACH**2, PROFILE_STEPS + 1)))
    visible = grid.visible.reshape(-1)
    contrast = np.full(len(visible), sign * float(np.median(windows.contrast)))
    quality = visible.astype(np.float64)
    model = DotModel(grid.positions.reshape(-1, 2), visible, ellipse, contrast, profile, 0.02, quality)
    for _ in range(_ROUNDS):
        tracker = _make_tracker(image, grid, model)
        fit = tracker.start(image)
        visible = _matching(image, grid, fit.quality)
        contrast = np.where(visible, fit.contrast, np.median(fit.contrast[visible]))
        profile, noise = windows.profile(fit.position, ellipse, visible)
        model = replace(model, contrast=contrast, rest=fit.position, profile=profile, noise=noise)
    tracker = _make_tracker(image, grid, model)
    fit = tracker.start(image)
    visible = _matching(image, grid, fit.quality)
    return tracker, replace(model, rest=fit.position, visible=visible, quality=fit.quality)


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
        profile_reach=_PROFILE_REACH**2,
        rest=model.rest,
        visible=model.visible,
        ellipse=model.ellipse,
        contrast=model.contrast,
    )


class _DotWindows:
    """Pixel windows around the visible dots: values, offsets from the initial centre, and fitted background."""

    def __init__(self, plane: Floats, grid: MarkerGrid) -> None:
        half = int(np.ceil(min(2.0 * grid.radius + 1, 0.5 * grid.spacing)))
        self.markers = np.flatnonzero(grid.visible)
        self.centre_pixel = np.round(grid.positions.reshape(-1, 2)).astype(np.intp)
        padded = cv2.copyMakeBorder(plane, half, half, half, half, cv2.BORDER_REPLICATE)
        steps = np.arange(-half, half + 1, max(1, round(grid.radius / 4)))  # denser samples add no information
        down, right = (a.reshape(-1) for a in np.meshgrid(steps, steps, indexing="ij"))
        self.step = np.stack([right, down], axis=1).astype(np.float64)  # shape (pixels, 2)
        at = np.clip(self.centre_pixel[self.markers], 0, (plane.shape[1] - 1, plane.shape[0] - 1))
        self.pixels = padded[at[:, 1, None] + half + down, at[:, 0, None] + half + right]  # shape (dots, pixels)
        self.offset = self.step - (grid.positions.reshape(-1, 2) - self.centre_pixel)[self.markers][:, None]
        distance = np.linalg.norm(self.offset, axis=-1)
        self.background = _fit_planes(self.pixels, self.step, (distance > 1.6 * grid.radius).astype(np.float64))
        ratio = self.pixels / np.maximum(self.background, 1.0) - 1
        inside = distance < 0.6 * grid.radius
        self.contrast = np.abs((ratio * inside).sum(1) / np.maximum(inside.sum(1), 1))
        sign = 1.0 if grid.appearance.bright else -1.0
        self.ink = sign * ratio / np.maximum(self.contrast, 1e-3)[:, None]

    def ellipses(self, grid: MarkerGrid) -> Floats:
        """Q of each marker, shape (markers, 3), from the second moments of the dots and the local grid steps."""
        inner = np.linalg.norm(self.offset, axis=-1) < 2.0 * grid.radius
        weight = np.clip((self.ink - 0.25) / 0.5, 0, 1) * inner
        total = np.maximum(weight.sum(1), 1e-9)[:, None]
        mean = (weight[:, None] @ self.offset)[:, 0] / total
        off = self.offset - mean[:, None]
        moments = (off * weight[..., None]).transpose(0, 2, 1) @ off / total[..., None]
        steps = _grid_steps(grid)
        inverse = np.linalg.inv(steps)
        # In units of the grid steps, all dots have the same moments; a disc of radius 1 has second moments 1/4.
        common = np.median(inverse[self.markers] @ moments @ inverse[self.markers].transpose(0, 2, 1), axis=0)
        q = inverse.transpose(0, 2, 1) @ np.linalg.inv(4 * common) @ inverse
        return np.stack([q[:, 0, 0], q[:, 0, 1], q[:, 1, 1]], axis=1)

    def profile(self, rest: Floats, ellipse: Floats, visible: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float]:
        """The mean profile, as in `DotModel`, and the pixel noise outside the dots."""
        use = visible[self.markers]
        markers = self.markers[use]
        off = self.step - (rest - self.centre_pixel)[markers][:, None]
        xx, xy, yy = ellipse[markers].T[:, :, None]
        radius = np.sqrt(off[..., 0] ** 2 * xx + 2 * off[..., 0] * off[..., 1] * xy + off[..., 1] ** 2 * yy)
        background = _fit_planes(self.pixels[use], self.step, (radius > 1.7).astype(np.float64))
        ratio = self.pixels[use] / np.maximum(background, 1.0) - 1
        inside = radius < 0.6
        contrast = (ratio * inside).sum(1) / np.maximum(inside.sum(1), 1)
        ink = ratio / np.where(np.abs(contrast) > 1e-3, contrast, 1e-3)[:, None]
        ring = np.minimum(radius / _PROFILE_REACH * _RINGS, _RINGS).astype(np.intp)
        sound = np.abs(ink - _edge(radius)) < 0.75  # excludes damaged parts of dots
        count = np.bincount(ring[sound], minlength=_RINGS + 1)[:_RINGS]
        total = np.bincount(ring[sound], ink[sound], minlength=_RINGS + 1)[:_RINGS]
        middle = (np.arange(_RINGS) + 0.5) / _RINGS * _PROFILE_REACH
        mean = np.interp(middle, middle[count > 0], total[count > 0] / count[count > 0])
        mean = np.convolve(np.pad(mean, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
        mean -= mean[middle > 1.8].mean()
        mean /= mean[middle < 0.6].mean()
        at = np.sqrt(np.linspace(0, _PROFILE_REACH**2, PROFILE_STEPS + 1))
        table = np.interp(at, middle, mean, right=0.0) * np.clip((_PROFILE_REACH - at) / 0.3, 0, 1)
        outside = ratio[(radius > 1.7) & (radius < 2.0)]
        noise = 1.4826 * float(np.median(np.abs(outside))) if outside.size else 0.02
        return table.astype(np.float32), noise


def _fit_planes(pixels: Floats, step: Floats, weight: Floats) -> Floats:
    """Weighted least-squares plane through the pixels of each window, shape (windows, pixels)."""
    terms = np.concatenate([np.ones((len(step), 1)), step / np.abs(step).max()], axis=1)
    products = (terms[:, :, None] * terms[:, None, :]).reshape(-1, 9)
    matrix = (weight @ products).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
    right = (weight * pixels) @ terms
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0] @ terms.T)


def _grid_steps(grid: MarkerGrid) -> Floats:
    """Local grid steps (rightward, downward) as matrix columns [px], shape (markers, 2, 2), from a cubic fit."""
    rows, cols = grid.shape
    degree = min(3, rows - 1, cols - 1)
    down, right = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    terms = np.stack([right**i * down**j for i, j in powers], axis=-1)
    weights = np.linalg.lstsq(terms[grid.visible], grid.positions[grid.visible], rcond=None)[0]
    along_row = np.stack([i * right ** max(i - 1, 0) * down**j for i, j in powers], axis=-1) @ weights
    along_column = np.stack([j * right**i * down ** max(j - 1, 0) for i, j in powers], axis=-1) @ weights
    steps = np.stack([along_row * 2 / (cols - 1), along_column * 2 / (rows - 1)], axis=-1)
    return steps.reshape(-1, 2, 2)


def _edge(radius: Floats) -> NDArray[np.float32]:
    """Initial profile: a smooth step at radius 1."""
    part = np.clip((1.5 - radius) / 1.0, 0, 1)
    return (part * part * (3 - 2 * part)).astype(np.float32)
