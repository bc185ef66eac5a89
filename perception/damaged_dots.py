"""Damaged dots of a first image: ink is missing, or joins a dot to another one.

An outline that followed the damage would move the centre of the dot. The outline of a damaged dot is therefore
estimated from its intact part, with the deviations of the other dots as prior, and a mask excludes the damaged part
from every fit of its centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from gelflow.perception._tracker import MASK_CELLS, MASK_REACH
from gelflow.perception.dot_windows import (
    MAX_CHANGE,
    DotPixels,
    DotWindows,
    Floats,
    Pixels,
    deviations,
    fit_planes,
    reshaped,
    sample,
)

# A dot is damaged if the ink of a pixel differs from the profile by this much [contrast]: ink is missing, or is where
# none should be. Smaller differences on real prints belong to the dot.
_DAMAGED = 0.7
# A pixel is damaged if it differs from the profile by more than this multiple of the median, over the dots, of their
# largest differences, within these limits [contrast], plus what a deviation of the outline explains there.
_UNUSUAL = 1.25
_UNUSUAL_LIMITS = (0.2, 0.4)
_ROUNDS = 5  # of the alternating estimation of outline and intact part
_SIZE_ROUNDS = 2  # the first ones, in which the outline changes in size only
_DEVIATION = (4.0, 1.5)  # of the outline, relative to the median one, in the first rounds and in the others
_STEPS = 2  # Gauss-Newton steps in a round
_HALF_WEIGHT = 0.16  # residual / contrast at which a pixel has half the weight
_RESIDUAL = 0.12  # standard deviation of the residuals / contrast, for the weight of the prior
_MIN_SPREAD = 0.005  # smallest standard deviation of the prior [radii]
_MAX_EXCLUDED = 0.6  # largest part of a dot that a mask may exclude


@dataclass(frozen=True)
class DamagedDots:
    """The damaged dots of a first image; `n` of them."""

    markers: NDArray[np.intp]  # shape (n,)
    rest: Floats  # centres (right, down) [px], shape (n, 2)
    shape: Floats  # as in `DotModel`, shape (n, 8)
    # Over the frame of each dot, from -MASK_REACH to MASK_REACH radii, rows downwards: 1 where the shape describes the
    # dot, else 0. Shape (n, MASK_CELLS, MASK_CELLS).
    masks: Pixels


def find_damaged(windows: DotWindows, rest: Floats, shape: Floats, profile: Pixels) -> DamagedDots | None:
    """The damaged dots among those of `windows`, None without any. `rest`, `shape` and `profile` as in `DotModel`.

    Dots whose own outline could not be estimated have the common shape.
    """
    residual, radius = windows.residuals(rest, shape, profile)
    largest = (np.abs(residual) * (radius < 1.6)).max(axis=1)
    dots = np.flatnonzero(largest > _DAMAGED)
    if not dots.size:
        return None
    limit = float(np.clip(_UNUSUAL * np.median(largest), *_UNUSUAL_LIMITS))
    own, markers = windows.have_own_shape(shape), windows.markers
    both = deviations(shape[markers], windows.common[markers])
    size, raggedness = (float(np.median(one[own])) if own.any() else 0.0 for one in both)
    found = _IntactPartFit(windows, dots, limit, size, raggedness).run(rest, shape, profile)
    return found if found.markers.size else None


class _IntactPartFit:
    """Fits the outlines of some `dots` (indices into those of `windows`) to their intact parts.

    `limit` is the difference of a damaged pixel; `size` and `raggedness` are the median deviations of the other dots.
    """

    def __init__(
        self, windows: DotWindows, dots: NDArray[np.intp], limit: float, size: float, raggedness: float
    ) -> None:
        self._windows, self._dots, self._limit, self._raggedness = windows, dots, limit, raggedness
        self._markers = windows.markers[dots]
        self._side = round(windows.step.shape[1] ** 0.5)
        # 1.48: standard deviation / median; 0.58: the raggedness is the root of half the sum over six coefficients.
        spread = np.maximum([1.48 * size, *[0.58 * raggedness] * 6], _MIN_SPREAD)
        self._precision = np.insert((_RESIDUAL / spread) ** 2, 1, (0.0, 0.0))  # size, offset, stretch, waves

    def run(self, rest: Floats, shape: Floats, profile: Pixels) -> DamagedDots:
        """The dots that are damaged. Arguments as of `find_damaged`."""
        centre, outline = rest[self._markers], shape[self._markers]
        change = np.zeros((len(centre), 9))
        intact = np.ones((len(centre), self._side**2), dtype=np.float32)
        for number in range(_ROUNDS):
            later = number >= _SIZE_ROUNDS
            ink = self._ink(self._at(centre, outline).radius, intact)
            precision = self._precision if later else self._precision + np.r_[0, 0, 0, np.full(6, 1e6)]
            for _ in range(_STEPS):
                step = self._step(ink, intact, self._at(centre, outline), profile, precision, change)
                change += step * (self._precision > 0)
                centre = centre + np.linalg.solve(outline[:, :4].reshape(-1, 2, 2), step[:, 1:3, None])[..., 0]
                outline = reshaped(outline, step)
            intact = self._intact(ink, self._at(centre, outline).radius, profile, _DEVIATION[later])
        inside = self._at(centre, outline).radius < 1.2
        excluded = 1 - (intact * inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        use = (intact < 1).any(axis=1) & (excluded < _MAX_EXCLUDED)
        return DamagedDots(self._markers[use], centre[use], outline[use], self._masks(centre, outline, intact)[use])

    def _at(self, centre: Floats, outline: Floats) -> DotPixels:
        return DotPixels.at(*self._windows.offsets(centre, self._markers), outline)

    def _ink(self, radius: Pixels, intact: Pixels) -> Pixels:
        """Ink relative to a background without damaged pixels, shape (dots, pixels)."""
        pixels = self._windows.pixels[self._dots]
        inside, outside = (radius < 0.6) * intact, (radius > 1.5) * intact
        weight, ink = outside, pixels
        for _ in range(2):
            ratio = pixels / np.maximum(fit_planes(pixels, self._windows.step, weight), 1.0) - 1
            contrast = (ratio * inside).sum(1) / np.maximum(inside.sum(1), 1e-3)
            ink = ratio / np.where(np.abs(contrast) > 1e-3, contrast, 1e-3)[:, None]
            weight = outside / (1 + (ink / 0.1) ** 4)  # without the ink of another dot
        return np.asarray(ink, dtype=np.float32)

    def _step(
        self, ink: Pixels, intact: Pixels, pixels: DotPixels, profile: Pixels, precision: Floats, change: Floats
    ) -> Floats:
        """Gauss-Newton step of size, offset, stretch and waves, shape (dots, 9); `change` is their sum so far."""
        here, slope = sample(profile, pixels.radius)
        residual = ink - here
        weight = intact / (1 + (residual / _HALF_WEIGHT) ** 2) * (pixels.radius < 1.7)
        terms = pixels.outline_changes() * slope
        weighted = terms * weight[:, None]
        matrix = (weighted @ terms.transpose(0, 2, 1)).astype(np.float64) + np.diag(precision + 1e-5)
        gradient = (weighted @ residual[..., None])[..., 0] - precision * change
        return np.clip(np.linalg.solve(matrix, gradient[..., None])[..., 0], -MAX_CHANGE, MAX_CHANGE)

    def _intact(self, ink: Pixels, radius: Pixels, profile: Pixels, deviation: float) -> Pixels:
        """Weight 1 for each intact pixel, 0 for damaged ones and their neighbours, shape (dots, pixels)."""
        here, slope = sample(profile, radius)
        allowed = self._limit + deviation * self._raggedness * np.abs(slope[:, 0])
        damaged = ((np.abs(ink - here) > allowed) & (radius < 2.0)).reshape(-1, self._side, self._side)
        return np.asarray(~maximum_filter(damaged, size=(1, 3, 3)), dtype=np.float32).reshape(ink.shape)

    def _masks(self, centre: Floats, outline: Floats, intact: Pixels) -> Pixels:
        """The masks as in `DamagedDots`, from the weights of the pixels."""
        cell = MASK_REACH * ((np.arange(MASK_CELLS) + 0.5) / MASK_CELLS * 2 - 1)
        down, right = np.meshgrid(cell, cell, indexing="ij")
        offset = np.linalg.inv(outline[:, :4].reshape(-1, 2, 2)) @ np.stack([right, down]).reshape(2, -1)
        offset += (centre - self._windows.centre_pixel[self._markers])[:, :, None]
        first, second = self._windows.step[0, :2]
        nearest = np.rint((offset - first) / (second - first)).clip(0, self._side - 1).astype(np.intp)
        return np.take_along_axis(intact, nearest[:, 1] * self._side + nearest[:, 0], axis=1).reshape(
            -1, MASK_CELLS, MASK_CELLS
        )
