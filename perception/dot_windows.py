"""Pixel windows around the dots of a first image: ink relative to the background, outlines of dots, and the profile."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception._tracker import PROFILE_STEPS
from gelflow.perception.grid_detection.grid import MarkerGrid

Floats = NDArray[np.float64]
Pixels = NDArray[np.float32]  # windows around the dots: single precision takes half the time

PROFILE_REACH = 2.2  # the profile ends at this many radii
_SHAPE_STEPS = 2  # of the fit of the shapes
_WAVE_LIMIT = 0.25  # smallest |z|² of a wave, as in csrc/dot_fit.hpp
MAX_CHANGE = 0.2  # of size, ellipse and waves in a step
# The outline of an intact dot differs from that of the median dot by less than this [radii], or a multiple of the
# median difference. Others are damaged, or joined to another one.
_INTACT = 0.04
_LARGEST_SIZE = 0.6  # difference from the size of the median dot [radii]
_RINGS = 44  # bins of the radius in which the profile is averaged


class DotWindows:
    """Square pixel windows around the visible dots, as large as the longest dot requires."""

    def __init__(self, plane: Floats, grid: MarkerGrid) -> None:
        self.markers = np.flatnonzero(grid.visible)
        self.centre_pixel = np.round(grid.positions.reshape(-1, 2)).astype(np.intp)
        half = min(2.0 * grid.radius + 1, 0.5 * grid.spacing)
        self._read(plane, grid.radius, half)
        self.contrast, self.common = self._contrast_and_shapes(grid)
        longest = float(_half_lengths(self.common[self.markers]).max())
        if longest > half:
            self._read(plane, grid.radius, min(1.3 * longest, 0.5 * grid.spacing))
        self.inner = np.flatnonzero(_length(*self.step) < max(1.6 * grid.radius, 1.2 * longest) + 1)

    def _read(self, plane: Floats, radius: float, half: float) -> None:
        """Reads the pixels up to `half` [px] away from the centres."""
        half = int(np.ceil(half))
        padded = cv2.copyMakeBorder(plane, half, half, half, half, cv2.BORDER_REPLICATE)
        sampling = max(1, round(radius / 3.7))  # [px], about 3 samples a radius: denser ones add no information
        steps = np.arange(-half, half + 1, sampling)
        down, right = (a.reshape(-1) for a in np.meshgrid(steps, steps, indexing="ij"))
        self.step = np.stack([right, down]).astype(np.float32)  # shape (2, pixels)
        at = np.clip(self.centre_pixel[self.markers], 0, (plane.shape[1] - 1, plane.shape[0] - 1))
        self.pixels = padded[at[:, 1, None] + half + down, at[:, 0, None] + half + right].astype(np.float32)

    def _contrast_and_shapes(self, grid: MarkerGrid) -> tuple[Pixels, Floats]:
        """The contrast of each dot, and shapes as in `DotModel` of equal elliptic dots.

        The shapes follow from the second moments of the dots and the grid steps.
        """
        offset = self.offsets(grid.positions.reshape(-1, 2)[self.markers], self.markers)
        distance = _length(*offset)
        background = fit_planes(self.pixels, self.step, (distance > 1.6 * grid.radius).astype(np.float32))
        ratio = self.pixels / np.maximum(background, 1.0) - 1
        inside = distance < 0.6 * grid.radius
        contrast = np.abs((ratio * inside).sum(1) / np.maximum(inside.sum(1), 1))
        sign = 1.0 if grid.appearance.bright else -1.0
        ink = sign * ratio / np.maximum(contrast, 1e-3)[:, None]
        weight = np.clip((ink - 0.25) / 0.5, 0, 1) * (distance < 2.0 * grid.radius)
        total = np.maximum(weight.sum(1), 1e-9)
        off = np.stack(offset, axis=1)
        off -= ((off @ weight[..., None]) / total[:, None, None]).astype(np.float32)
        moments = off * weight[:, None] @ off.transpose(0, 2, 1) / total[:, None, None]
        steps = _grid_steps(grid)
        inverse = np.linalg.inv(steps)
        # In units of the grid steps, all dots have the same moments; a disc of radius 1 has second moments 1/4.
        common = np.median(inverse[self.markers] @ moments @ inverse[self.markers].transpose(0, 2, 1), axis=0)
        q = inverse.transpose(0, 2, 1) @ np.linalg.inv(4 * common) @ inverse
        frames = np.linalg.cholesky(q).transpose(0, 2, 1).reshape(-1, 4)
        return contrast, np.concatenate([frames, np.zeros_like(frames)], axis=1)

    def refined(self, rest: Floats, shape: Floats, profile: Pixels) -> Floats:
        """The shapes with size, stretch and waves of each dot by least squares; the median size is kept."""
        markers = self.markers
        refined = shape[markers]
        right, down = self.offsets(rest[markers], markers)
        ink = self.ink_at(DotPixels.at(right, down, shape[markers]).radius, np.ones(len(markers), dtype=bool))[0]
        ink, right, down = (np.take(values, self.inner, axis=1) for values in (ink, right, down))
        for _ in range(_SHAPE_STEPS):
            pixels = DotPixels.at(right, down, refined)
            here, slope = sample(profile, pixels.radius)
            change = least_squares(pixels.outline_changes() * slope, ink - here)
            change[:, 0] -= np.median(change[:, 0])
            change = np.clip(change, -MAX_CHANGE, MAX_CHANGE)
            moved = np.linalg.solve(refined[:, :4].reshape(-1, 2, 2), change[:, 1:3, None]).astype(np.float32)
            right -= moved[:, 0]
            down -= moved[:, 1]
            refined = reshaped(refined, change)
        size, raggedness = deviations(refined, self.common[markers])
        intact = (raggedness < max(_INTACT, 3.5 * float(np.median(raggedness)))) & (size < _LARGEST_SIZE)
        result = shape.copy()
        result[markers[intact]] = refined[intact]
        return result

    def offsets(self, centre: Floats, markers: NDArray[np.intp]) -> tuple[Pixels, Pixels]:
        """Offsets of the pixels of `markers` (dots,) from their centres (dots, 2): right, down [px], (dots, pixels)."""
        moved = (centre - self.centre_pixel[markers]).astype(np.float32)
        return self.step[0] - moved[:, :1], self.step[1] - moved[:, 1:]

    def residuals(self, rest: Floats, shape: Floats, profile: Pixels) -> tuple[Pixels, Pixels]:
        """Ink of each pixel less the profile, and its distance from the centre [radii], shape (dots, pixels).

        Arguments as in `DotModel`.
        """
        radius = DotPixels.at(*self.offsets(rest[self.markers], self.markers), shape[self.markers]).radius
        ink, _ = self.ink_at(radius, np.ones(len(self.markers), dtype=bool))
        return ink - sample(profile, radius)[0], radius

    def have_own_shape(self, shape: Floats) -> NDArray[np.bool_]:
        """Which dots have an outline of their own in `shape`, as in `DotModel`, instead of the common one, (dots,)."""
        return np.asarray((shape[self.markers] != self.common[self.markers]).any(axis=1))

    def ink_at(self, radius: Pixels, use: NDArray[np.bool_]) -> tuple[Pixels, Pixels]:
        """Ink at the distances `radius` from the centres, and value over background less 1, shape (dots, pixels)."""
        background = fit_planes(self.pixels[use], self.step, (radius > 1.7).astype(np.float32))
        ratio = self.pixels[use] / np.maximum(background, 1.0) - 1
        inside = radius < 0.6
        contrast = (ratio * inside).sum(1) / np.maximum(inside.sum(1, dtype=np.float32), 1)
        return ratio / np.where(np.abs(contrast) > 1e-3, contrast, np.float32(1e-3))[:, None], ratio

    def profile(self, rest: Floats, shape: Floats, visible: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float]:
        """The mean profile, as in `DotModel`, and the pixel noise outside the dots."""
        use = visible[self.markers]
        markers = self.markers[use]
        radius = DotPixels.at(*self.offsets(rest[markers], markers), shape[markers]).radius
        ink, ratio = self.ink_at(radius, use)
        ring = np.minimum(radius / PROFILE_REACH * _RINGS, _RINGS).astype(np.intp)
        intact = np.abs(ink - initial_profile(radius)) < 0.75  # excludes damaged parts of dots
        count = np.bincount(ring[intact], minlength=_RINGS + 1)[:_RINGS]
        total = np.bincount(ring[intact], ink[intact], minlength=_RINGS + 1)[:_RINGS]
        middle = (np.arange(_RINGS) + 0.5) / _RINGS * PROFILE_REACH
        mean = np.interp(middle, middle[count > 0], total[count > 0] / count[count > 0])
        mean = np.convolve(np.pad(mean, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
        mean -= mean[middle > 1.8].mean()
        mean /= mean[middle < 0.6].mean()
        at = np.sqrt(np.linspace(0, PROFILE_REACH**2, PROFILE_STEPS + 1))
        table = np.interp(at, middle, mean, right=0.0) * np.clip((PROFILE_REACH - at) / 0.3, 0, 1)
        outside = ratio[(radius > 1.7) & (radius < 2.0)]
        noise = 1.4826 * float(np.median(np.abs(outside))) if outside.size else 0.02
        return table.astype(np.float32), noise


@dataclass(frozen=True)
class DotPixels:
    """Pixels in the frames of their dots, in which a dot is a disc of radius 1; shapes (dots, pixels)."""

    x: Pixels
    y: Pixels
    square: Pixels  # x² + y²
    radius: Pixels  # distance from the centre relative to the outline
    waves: tuple[Pixels, ...]  # of an outline: Re z³, Im z³, Re z⁴, Im z⁴ over |z|⁴ with z = x + i y

    @classmethod
    def at(cls, right: Pixels, down: Pixels, shape: Floats) -> "DotPixels":
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


def _half_lengths(shape: Floats) -> Floats:
    """Half the largest width or height of dots [px], shape (dots,)."""
    xx, xy, yx, yy = shape[:, :4].T
    return np.asarray(np.maximum(np.hypot(xy, yy), np.hypot(xx, yx)) / np.abs(xx * yy - xy * yx))


def _length(x: Pixels, y: Pixels) -> Pixels:
    return np.asarray(np.sqrt(x * x + y * y))


def least_squares(terms: Pixels, values: Pixels) -> Floats:
    """Coefficients of `terms` (dots, n, pixels) that sum to `values` (dots, pixels), shape (dots, n)."""
    # The product of an array with its own transpose takes a routine of BLAS that is slow for small matrices.
    matrix = (terms.copy() @ terms.transpose(0, 2, 1)).astype(np.float64) + 1e-5 * np.eye(terms.shape[1])
    return np.asarray(np.linalg.solve(matrix, terms @ values[..., None])[..., 0])


def reshaped(shape: Floats, change: Floats) -> Floats:
    """Shapes after a change of the outline: size, offset (ignored), stretch, waves."""
    size, long, turned = change[:, [0, 3, 4]].T
    stretch = np.stack([1 + size + long, turned, turned, 1 + size - long], axis=1).reshape(-1, 2, 2)
    frame = np.linalg.solve(stretch, shape[:, :4].reshape(-1, 2, 2)).reshape(-1, 4)
    return np.concatenate([frame, shape[:, 4:] + change[:, 5:]], axis=1)


def deviations(shape: Floats, common: Floats) -> tuple[Floats, Floats]:
    """Size of each dot from the median size, and its outline from the median one; standard deviations in radii."""
    (a, b), (c, d) = np.moveaxis(common[:, :4].reshape(-1, 2, 2) @ np.linalg.inv(shape[:, :4].reshape(-1, 2, 2)), 0, -1)
    outline = np.stack([(a - d) / 2, (b + c) / 2, *shape[:, 4:].T], axis=1)
    outline -= np.median(outline, axis=0)
    size = (a + d) / 2
    return np.abs(size - np.median(size)), np.asarray(np.sqrt((outline**2).sum(axis=1) / 2))


def sample(profile: Pixels, radius: Pixels) -> tuple[Pixels, Pixels]:
    """The profile at distances from the centre [radii], and its change by the logarithm of the size, (dots, 1, ...)."""
    at = np.minimum(np.square(radius) * np.float32(PROFILE_STEPS / PROFILE_REACH**2), np.float32(PROFILE_STEPS - 1e-3))
    index = at.astype(np.intp)
    steps = np.diff(profile)[index]
    return profile[index] + (at - index) * steps, (-2 * at * steps)[:, None]


def fit_planes(pixels: Pixels, step: Pixels, weight: Pixels) -> Pixels:
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


def initial_profile(radius: NDArray[np.floating]) -> Pixels:
    """Initial profile: a smooth step at radius 1."""
    part = np.clip((1.5 - radius) / 1.0, 0, 1)
    return np.asarray(part * part * (3 - 2 * part), dtype=np.float32)
