"""Errors of the trackers on real first images that are warped by known displacement fields.

Published tactile images come without true displacements. Warped by a known field, with sensor noise and optionally the
shading of a contact added, they show what real prints, lenses and illuminations do to a tracker. The trackers receive
the warped images; the truth is the field at the rest positions that are found in the first one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.benchmark.baselines import BenchmarkTracker, GelflowTracker, LucasKanade, MarkerEstimate
from gelflow.perception.tracker import MarkerTracker, TrackingResult

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

_FRAMES = 12  # warped images of each field
_PEAK = 0.4  # largest displacement / marker spacing
_NOISE = 1.0  # standard deviation [grey levels]
_SHADING = 0.35  # largest relative change of the brightness
_INVERSE_STEPS = 12  # of the fixed-point iteration; it converges linearly by the gradient of the field, below 0.4


@dataclass(frozen=True)
class WarpedErrors:
    """95th percentiles of the displacement error on one image [px]."""

    image: str
    markers: int
    gelflow: float
    lucas_kanade: float
    gelflow_shaded: float  # with the shading of a moving contact
    lucas_kanade_shaded: float


def measure_warped(name: str, image: Image, *, seed: int = 0) -> WarpedErrors:
    """The errors on `image` (B G R) of a gel at rest. Raises TrackerInitError where no grid is found."""
    grid = MarkerTracker().start(image)
    errors = []
    for shading in (0.0, _SHADING):
        found: dict[str, list[float]] = {"gelflow": [], "lucas_kanade": []}
        for field in ("press", "shear", "twist"):
            trackers: dict[str, BenchmarkTracker] = {"gelflow": GelflowTracker(), "lucas_kanade": LucasKanade()}
            images = _warped(image, grid, field, shading, seed)
            at_rest = next(images).image
            first = MarkerTracker().start(at_rest, grid.rows, grid.cols)
            for tracker in trackers.values():
                tracker.start(at_rest, first.position, first.valid, grid.rows, grid.cols)
            for warped in images:
                truth = warped.displacement(first.position)
                for key, tracker in trackers.items():
                    found[key] += _errors(tracker.track(warped.image), truth)
        errors += [float(np.percentile(found[key], 95)) for key in ("gelflow", "lucas_kanade")]
    return WarpedErrors(name, len(grid.position), *errors)


def _errors(estimate: MarkerEstimate, truth: Points) -> list[float]:
    distance = np.linalg.norm(estimate.displacement - truth, axis=1)[estimate.valid]
    return list(map(float, distance))


@dataclass(frozen=True)
class _Warped:
    image: Image
    displacement: Callable[[Points], Points]  # of the gel at positions at rest (right, down) [px], shape (..., 2)


def _warped(image: Image, grid: TrackingResult, field: str, shading: float, seed: int) -> Iterator[_Warped]:
    """Images of a warped gel, the first one at rest; `grid`: its markers."""
    rng = np.random.default_rng(seed)
    height, width = image.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    middle, reach = grid.position.mean(axis=0), 0.35 * float(np.ptp(grid.position, axis=0).min())
    for number in range(_FRAMES + 1):
        peak = _PEAK * grid.spacing * np.sin(np.pi * number / _FRAMES)
        centre = middle + 0.3 * reach * np.array([np.cos(number), np.sin(2 * number)])

        def displacement(at: Points, peak: float = peak, centre: Points = centre) -> Points:
            return np.asarray(peak * _field(field, (at - centre) / reach))

        start = pixels  # of each pixel before the motion
        for _ in range(_INVERSE_STEPS):
            start = pixels - displacement(start)
        x, y = np.moveaxis(start.astype(np.float32), -1, 0)
        moved = cv2.remap(image, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE).astype(float)
        if number and shading:
            off = (pixels - centre) / reach
            moved *= (1 + shading * (off[..., 0] + 0.5 * off[..., 1]) * np.exp(-(off**2).sum(axis=-1)))[..., None]
        noisy = moved + rng.normal(0, _NOISE, moved.shape)
        yield _Warped(noisy.clip(0, 255).round().astype(np.uint8), displacement)


def _field(name: str, at: Points) -> Points:
    """Displacement field of length up to 1 at positions relative to the contact [contact radii], shape (..., 2)."""
    square = (at**2).sum(axis=-1, keepdims=True)
    if name == "shear":
        return np.asarray(np.exp(-square / 2) * np.array([0.8, 0.6]))
    around = at * np.exp((1 - square) / 2)
    return np.asarray(around if name == "press" else np.stack([-around[..., 1], around[..., 0]], axis=-1))
