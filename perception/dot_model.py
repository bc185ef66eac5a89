"""The dot model, estimated from the first image: dot profile, shape and contrast per marker, and pixel noise.

All dots have one profile over the distance from the centre relative to the outline. The outline of a dot begins as an
ellipse: the local grid steps, which contain tilt, keystone and lens distortion, times one common matrix for the print.
Its own size, ellipse and raggedness follow by least squares. Centres, outlines and profile are estimated alternately.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception._tracker import PROFILE_STEPS, Tracker
from gelflow.perception.errors import TrackerInitError, draw_detections
from gelflow.perception.grid_detection.detect import PLANES, image_plane
from gelflow.perception.grid_detection.grid import MarkerGrid

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]  # windows around the dots: single precision takes half the time

_ROUNDS = 2  # of the alternating estimation
_PROFILE_REACH = 2.2  # the profile ends at this many radii
_MIN_MATCHING = 0.6  # fraction of the dots that must match the common profile
_SHAPE_STEPS = 2  # of the fit of the shapes
_WAVE_LIMIT = 0.25  # smallest |z|² of a wave, as in csrc/dot_fit.hpp
_MAX_CHANGE = 0.2  # of size, ellipse and waves in a step
# The outline of a sound dot differs from that of the median dot by less than this [radii], or a multiple of the median
# difference. Others are damaged, or joined to another one.
_SOUND = 0.04
_LARGEST_SIZE = 0.6  # difference from the size of the median dot [radii]
_TOLERATED = (0.16, 0.7)  # smallest and largest tolerated residual / contrast
_USUAL = 0.03  # standard deviation of the residuals of a sound dot / contrast: JPEG, quantization
_UNEXPLAINED = 6.0  # tolerated residual / standard deviation of what the model does not explain at rest
_RINGS = 44  # bins of the radius in which the profile is averaged


@dataclass(frozen=True)
class DotModel:
    """The dot model of a `Tracker`. Markers row by row."""

    rest: Floats  # positions at rest (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # whether the first image shows the dot, shape (markers,)
    # Frame of each dot as xx, xy, yx, yy [1/px]: maps an offset from the centre to coordinates in which the dot is a
    # disc of radius 1; then the coefficients of the waves of its outline (`_waves`). Shape (markers, 8).
    shape: Floats
    contrast: Floats  # of each dot, negative for dark dots, shape (markers,)
    tolerated: Floats  # residual / contrast at which a pixel has half the weight, shape (markers,)
    # At equidistant squared radii up to _PROFILE_REACH², 1 inside, 0 outside; shape (PROFILE_STEPS + 1,).
    profile: NDArray[np.float32]
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
    shape = windows.common
    sign = 1.0 if grid.appearance.bright else -1.0
    profile = _edge(np.sqrt(np.linspace(0, _PROFILE_REACH**2, PROFILE_STEPS + 1)))
    visible = grid.visible.reshape(-1)
    contrast = np.full(len(visible), sign * float(np.median(windows.contrast)))
    quality, tolerated = visible.astype(np.float64), np.full(len(visible), _TOLERATED[0])
    model = DotModel(grid.positions.reshape(-1, 2), visible, shape, contrast, tolerated, profile, 0.02, quality)
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
    model = replace(model, tolerated=windows.tolerated(model))
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
        shape=model.shape,
        contrast=model.contrast,
        tolerated=model.tolerated,
    )


class _DotWindows:
    """Pixel windows around the visible dots: values, offsets from the initial centre, and fitted background."""

    def __init__(self, plane: Floats, grid: MarkerGrid) -> None:
        half = int(np.ceil(min(2.0 * grid.radius + 1, 0.5 * grid.spacing)))
        self.markers = np.flatnonzero(grid.visible)
        self.centre_pixel = np.round(grid.positions.reshape(-1, 2)).astype(np.intp)
        padded = cv2.copyMakeBorder(plane, half, half, half, half, cv2.BORDER_REPLICATE)
        sampling = max(1, round(grid.radius / 3.7))  # [px], about 3 samples a radius: denser ones add no information
        steps = np.arange(-half, half + 1, sampling)
        down, right = (a.reshape(-1) for a in np.meshgrid(steps, steps, indexing="ij"))
        self.step = np.stack([right, down]).astype(np.float32)  # shape (2, pixels)
        at = np.clip(self.centre_pixel[self.markers], 0, (plane.shape[1] - 1, plane.shape[0] - 1))
        self.pixels = padded[at[:, 1, None] + half + down, at[:, 0, None] + half + right].astype(np.float32)
        self.offset = self._offsets(grid.positions.reshape(-1, 2), self.markers)
        distance = _length(*self.offset)
        self.background = _fit_planes(self.pixels, self.step, (distance > 1.6 * grid.radius).astype(np.float32))
        ratio = self.pixels / np.maximum(self.background, 1.0) - 1
        inside = distance < 0.6 * grid.radius
        self.contrast = np.abs((ratio * inside).sum(1) / np.maximum(inside.sum(1), 1))
        sign = 1.0 if grid.appearance.bright else -1.0
        self.ink = sign * ratio / np.maximum(self.contrast, 1e-3)[:, None]
        self.common = self._common_shapes(grid, distance)
        self.inner = np.flatnonzero(_length(*self.step) < 1.6 * grid.radius + 1)

    def _common_shapes(self, grid: MarkerGrid, distance: Pixels) -> Floats:
        """Shapes as in `DotModel` of equal elliptic dots, from the second moments of the dots and the grid steps."""
        weight = np.clip((self.ink - 0.25) / 0.5, 0, 1) * (distance < 2.0 * grid.radius)
        total = np.maximum(weight.sum(1), 1e-9)
        off = np.stack(self.offset, axis=1)
        off -= ((off @ weight[..., None]) / total[:, None, None]).astype(np.float32)
        moments = off * weight[:, None] @ off.transpose(0, 2, 1) / total[:, None, None]
        steps = _grid_steps(grid)
        inverse = np.linalg.inv(steps)
        # In units of the grid steps, all dots have the same moments; a disc of radius 1 has second moments 1/4.
        common = np.median(inverse[self.markers] @ moments @ inverse[self.markers].transpose(0, 2, 1), axis=0)
        q = inverse.transpose(0, 2, 1) @ np.linalg.inv(4 * common) @ inverse
        frames = np.linalg.cholesky(q).transpose(0, 2, 1).reshape(-1, 4)
        return np.concatenate([frames, np.zeros_like(frames)], axis=1)

    def refined(self, rest: Floats, shape: Floats, profile: Pixels) -> Floats:
        """The shapes with size, stretch and waves of each dot by least squares; the median size is kept."""
        markers = self.markers
        refined = shape[markers]
        right, down = self._offsets(rest, markers)
        ink = self._ink(_DotPixels.at(right, down, shape[markers]).radius, np.ones(len(markers), dtype=bool))[0]
        ink, right, down = (np.take(values, self.inner, axis=1) for values in (ink, right, down))
        for _ in range(_SHAPE_STEPS):
            pixels = _DotPixels.at(right, down, refined)
            here, slope = _sample(profile, pixels.radius)
            change = _least_squares(pixels.outline_changes() * slope, ink - here)
            change[:, 0] -= np.median(change[:, 0])
            change = np.clip(change, -_MAX_CHANGE, _MAX_CHANGE)
            moved = np.linalg.solve(refined[:, :4].reshape(-1, 2, 2), change[:, 1:3, None]).astype(np.float32)
            right -= moved[:, 0]
            down -= moved[:, 1]
            refined = _reshaped(refined, change)
        size, raggedness = _deviations(refined, self.common[markers])
        sound = (raggedness < max(_SOUND, 3.5 * float(np.median(raggedness)))) & (size < _LARGEST_SIZE)
        result = shape.copy()
        result[markers[sound]] = refined[sound]
        return result

    def tolerated(self, model: DotModel) -> Floats:
        """Tolerated residuals as in `DotModel`: more for a dot that the model does not explain at rest.

        Damaged dots, whose shape is the common one, get the smallest value: their other parts must be without weight.
        """
        shape = model.shape[self.markers]
        radius = _DotPixels.at(*self._offsets(model.rest, self.markers), shape).radius
        ink, _ = self._ink(radius, np.ones(len(self.markers), dtype=bool))
        residual = ink - _sample(model.profile, radius)[0]
        inside = radius < 1.5
        variance = (residual**2 * inside).sum(1) / inside.sum(1) - (model.noise / model.contrast[self.markers]) ** 2
        variance -= _USUAL**2
        sound = (shape != self.common[self.markers]).any(axis=1)
        result = np.full(len(model.rest), _TOLERATED[0])
        unexplained = np.sqrt(np.maximum(variance, 0.0)) * sound
        result[self.markers] = np.clip(_TOLERATED[0] + _UNEXPLAINED * unexplained, *_TOLERATED)
        return result

    def _offsets(self, rest: Floats, markers: NDArray[np.intp]) -> tuple[Pixels, Pixels]:
        """Offsets of the pixels from the centres `rest` of all markers: right and down [px], shape (dots, pixels)."""
        centre = (rest - self.centre_pixel)[markers].astype(np.float32)
        return self.step[0] - centre[:, :1], self.step[1] - centre[:, 1:]

    def _ink(self, radius: Pixels, use: NDArray[np.bool_]) -> tuple[Pixels, Pixels]:
        """Ink at the distances `radius` from the centres, and value over background less 1, shape (dots, pixels)."""
        background = _fit_planes(self.pixels[use], self.step, (radius > 1.7).astype(np.float32))
        ratio = self.pixels[use] / np.maximum(background, 1.0) - 1
        inside = radius < 0.6
        contrast = (ratio * inside).sum(1) / np.maximum(inside.sum(1, dtype=np.float32), 1)
        return ratio / np.where(np.abs(contrast) > 1e-3, contrast, np.float32(1e-3))[:, None], ratio

    def profile(self, rest: Floats, shape: Floats, visible: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float]:
        """The mean profile, as in `DotModel`, and the pixel noise outside the dots."""
        use = visible[self.markers]
        radius = _DotPixels.at(*self._offsets(rest, self.markers[use]), shape[self.markers[use]]).radius
        ink, ratio = self._ink(radius, use)
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


@dataclass(frozen=True)
class _DotPixels:
    """Pixels in the frames of their dots, in which a dot is a disc of radius 1; shapes (dots, pixels)."""

    x: Pixels
    y: Pixels
    square: Pixels  # x² + y²
    radius: Pixels  # distance from the centre relative to the outline
    waves: tuple[Pixels, ...]  # of an outline: Re z³, Im z³, Re z⁴, Im z⁴ over |z|⁴ with z = x + i y

    @classmethod
    def at(cls, right: Pixels, down: Pixels, shape: Floats) -> "_DotPixels":
        """The pixels at these offsets from the centres; `shape` as in `DotModel`."""
        xx, xy, yx, yy, *shares = shape.astype(np.float32).T[:, :, None]
        x, y = xx * right + xy * down, yx * right + yy * down
        square, real, imaginary = x * x + y * y, x * x - y * y, 2 * x * y
        inverse = 1 / np.square(np.maximum(square, np.float32(_WAVE_LIMIT)))
        third = (x * real - y * imaginary) * inverse, (x * imaginary + y * real) * inverse
        waves = (*third, (real * real - imaginary * imaginary) * inverse, 2 * real * imaginary * inverse)
        bulge = sum(share * wave for share, wave in zip(shares, waves, strict=True))
        return cls(x, y, square, np.asarray(np.sqrt(square) * (1 - bulge)), waves)

    def outline_changes(self) -> Pixels:
        """Changes of an outline by size, offset (right, down), stretch (two) and waves, shape (dots, 9, pixels)."""
        x, y, square = self.x, self.y, np.maximum(self.square, np.float32(_WAVE_LIMIT))
        inverse = 1 / np.sqrt(square)
        stretch = (x * x - y * y) / square, 2 * x * y / square
        return np.stack([np.ones_like(x), x * inverse, y * inverse, *stretch, *self.waves], axis=1)


def _length(x: Pixels, y: Pixels) -> Pixels:
    return np.asarray(np.sqrt(x * x + y * y))


def _least_squares(terms: Pixels, values: Pixels) -> Floats:
    """Coefficients of `terms` (dots, n, pixels) that sum to `values` (dots, pixels), shape (dots, n)."""
    # The product of an array with its own transpose takes a routine of BLAS that is slow for small matrices.
    matrix = (terms.copy() @ terms.transpose(0, 2, 1)).astype(np.float64) + 1e-5 * np.eye(terms.shape[1])
    return np.asarray(np.linalg.solve(matrix, terms @ values[..., None])[..., 0])


def _reshaped(shape: Floats, change: Floats) -> Floats:
    """Shapes after a change of the outline: size, offset (ignored), stretch, waves."""
    size, long, turned = change[:, [0, 3, 4]].T
    stretch = np.stack([1 + size + long, turned, turned, 1 + size - long], axis=1).reshape(-1, 2, 2)
    frame = np.linalg.solve(stretch, shape[:, :4].reshape(-1, 2, 2)).reshape(-1, 4)
    return np.concatenate([frame, shape[:, 4:] + change[:, 5:]], axis=1)


def _deviations(shape: Floats, common: Floats) -> tuple[Floats, Floats]:
    """Size of each dot from the median size, and its outline from the median one; standard deviations in radii."""
    (a, b), (c, d) = np.moveaxis(common[:, :4].reshape(-1, 2, 2) @ np.linalg.inv(shape[:, :4].reshape(-1, 2, 2)), 0, -1)
    outline = np.stack([(a - d) / 2, (b + c) / 2, *shape[:, 4:].T], axis=1)
    outline -= np.median(outline, axis=0)
    size = (a + d) / 2
    return np.abs(size - np.median(size)), np.asarray(np.sqrt((outline**2).sum(axis=1) / 2))


def _sample(profile: Pixels, radius: Pixels) -> tuple[Pixels, Pixels]:
    """The profile at distances from the centre [radii], and its change by the logarithm of the size, (dots, 1, ...)."""
    at = np.minimum(np.square(radius) * np.float32(PROFILE_STEPS / _PROFILE_REACH**2), np.float32(PROFILE_STEPS - 1e-3))
    index = at.astype(np.intp)
    steps = np.diff(profile)[index]
    return profile[index] + (at - index) * steps, (-2 * at * steps)[:, None]


def _fit_planes(pixels: Pixels, step: Pixels, weight: Pixels) -> Pixels:
    """Weighted least-squares plane through the pixels of each window, shape (windows, pixels)."""
    terms = np.stack([np.ones_like(step[0]), *(step / np.abs(step).max())], axis=1)
    products = (terms[:, :, None] * terms[:, None, :]).reshape(-1, 9)
    matrix = (weight @ products).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
    right = (weight * pixels) @ terms
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0].astype(np.float32) @ terms.T)


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


def _edge(radius: NDArray[np.floating]) -> Pixels:
    """Initial profile: a smooth step at radius 1."""
    part = np.clip((1.5 - radius) / 1.0, 0, 1)
    return np.asarray(part * part * (3 - 2 * part), dtype=np.float32)
