"""The printed dots of `AccurateGelRenderer`: missing, damaged and joined dots, and their ink in an image."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.image_layers import SHARP, Layer, pixel_coordinates

Array = NDArray[np.float64]
Patches = NDArray[np.float32]  # shape (dots, side, side)

# Kind of damage → ranges of offset from the dot centre and size, in radii, as observed on worn gels.
_DAMAGE_RANGES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "cut": ((0.2, 0.8), (0.0, 0.0)),
    "scratch": ((-0.6, 0.6), (0.08, 0.22)),
    "hole": ((0.3, 0.9), (0.15, 0.4)),
    "worn": ((0.0, 0.0), (0.06, 0.2)),
}
_WORN_HOLES = 6  # holes of a worn dot
_WAVES = np.arange(2, 7)  # periods of the deviation of an outline around a dot; one period would be an offset
_LARGEST = 2.5  # deviation of a radius or of an outline in standard deviations
_INK_DENSITY = 0.96  # mean ink density; `contrast` of the appearance is for density 1


@dataclass(frozen=True)
class Damage:
    """Missing ink of one dot, in the undeformed frame of the dot and in units of its radius."""

    kind: str  # "cut", "scratch", "hole" or "worn" (several small holes)
    angle: float
    offset: float
    size: float

    def remaining(self, x: Patches, y: Patches, edge: float) -> Patches:
        """Fraction of the ink that remains at (x, y); `edge` is the standard deviation of the edges."""
        right, down = math.cos(self.angle), math.sin(self.angle)
        if self.kind in ("cut", "scratch"):
            beyond = x * right + y * down - self.offset
            return np.asarray(ndtr((np.abs(beyond) - self.size if self.kind == "scratch" else -beyond) / edge))
        if self.kind == "hole":
            distance = np.hypot(x - self.offset * right, y - self.offset * down)
            return np.asarray(ndtr((distance - self.size) / edge))
        ink = np.ones_like(x)
        for k in range(_WORN_HOLES):
            turn, out = self.angle + 2.4 * k, math.sqrt((k + 0.5) / _WORN_HOLES)  # 2.4: the golden angle
            distance = np.hypot(x - out * math.cos(turn), y - out * math.sin(turn))
            ink = ink * ndtr((distance - self.size) / edge)
        return np.asarray(ink)


def _random_damage(rng: np.random.Generator) -> Damage:
    kind = tuple(_DAMAGE_RANGES)[rng.integers(len(_DAMAGE_RANGES))]
    offset, size = (rng.uniform(*limits) for limits in _DAMAGE_RANGES[kind])
    return Damage(kind, rng.uniform(0, 2 * np.pi), offset, size)


class Outlines:
    """Ragged outlines of the dots of one print.

    In the undeformed frame of a dot, in units of its radius, the outline is 1 plus a random sum of waves at each angle;
    the origin is the centroid of the inked area.
    """

    def __init__(self, deviation: float, dots: int, rng: np.random.Generator) -> None:
        falling = 1 / _WAVES
        scale = deviation / np.sqrt((falling**2).sum())
        self._waves = rng.normal(size=(dots, 2, len(_WAVES))).clip(-_LARGEST, _LARGEST) * falling * scale
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        edge = self._edge(self._waves[:, :, :, None], angle)
        area = (edge**2).sum(axis=-1) / 2
        self._centroid = np.stack([(edge**3 * one(angle)).sum(axis=-1) / 3 / area for one in (np.cos, np.sin)])

    def distance(self, x: Patches, y: Patches) -> Patches:
        """Distance from the outline at (x, y) [radii], shape (dots, side, side), negative inside."""
        right, down = (self._centroid.astype(np.float32)[:, :, None, None] + np.stack([x, y])).astype(np.float32)
        waves = self._waves.astype(np.float32)[:, :, :, None, None]
        return np.asarray(np.hypot(right, down) - self._edge(waves, np.arctan2(down, right)))

    @staticmethod
    def _edge(waves: NDArray[Any], angle: NDArray[Any]) -> NDArray[Any]:
        """Radius of the outline at `angle`; `waves` has shape (dots, 2, waves, ...)."""
        edge = 1.0
        for k, period in enumerate(_WAVES.tolist()):
            edge = edge + waves[:, 0, k] * np.cos(period * angle) + waves[:, 1, k] * np.sin(period * angle)
        return np.asarray(edge)


@dataclass(frozen=True)
class DotPatches:
    """Square pixel patches around the dots of one image."""

    appearance: DegradedGelAppearance
    centers: Array  # [px], shape (dots, 2)
    shapes: Array  # maps a disc with the appearance's radius to the dot's ellipse, shape (dots, 2, 2)
    motion_blur: Array  # motion of each dot during the exposure [px], shape (dots, 2)
    outlines: Outlines | None = None  # None: ellipses
    # Half the second derivative of the displacement of the gel, in the frame of each dot, in which its radius is 1;
    # shape (dots, 2, 2, 2). None: all 0.
    curvatures: Array | None = None

    @cached_property
    def _half(self) -> Array:
        """Half width and half height of each dot with motion blur [px], shape (dots, 2)."""
        largest = self.appearance.radius * (1 + _LARGEST * self.appearance.ragged)
        return np.asarray(largest * np.linalg.norm(self.shapes, axis=-1) + np.abs(self.motion_blur) / 2)

    @cached_property
    def reach(self) -> int:
        """Half the side of a patch [px]."""
        return int(np.ceil(self._half.max() + 4 * SHARP)) + 1

    @cached_property
    def corner(self) -> NDArray[np.intp]:
        """First pixel (right, down) of each patch, shape (dots, 2), clipped to patches just outside the image."""
        size = np.array([self.appearance.width, self.appearance.height])
        near = np.clip(np.rint(self.centers), -self.reach - 1, size + self.reach)
        return np.asarray(near.astype(np.intp) - self.reach)

    @cached_property
    def _to_dot_frame(self) -> Array:
        """Maps image offsets to the frame of each dot, in which its radius is 1, shape (dots, 2, 2)."""
        return np.asarray(np.linalg.inv(self.shapes) / self.appearance.radius)

    @cached_property
    def inner(self) -> tuple[Patches, Patches]:
        """Coordinates (right, down) of the patch pixels in the frame of each dot, in radii."""
        steps = np.arange(2 * self.reach + 1)
        off = self.corner - self.centers
        right = (off[:, :1] + steps).astype(np.float32)[:, None, :]
        down = (off[:, 1:] + steps).astype(np.float32)[:, :, None]
        (a, b), (c, d) = self._to_dot_frame.astype(np.float32).transpose(1, 2, 0)[..., None, None]
        x, y = a * right + b * down, c * right + d * down
        if self.curvatures is None or not self.curvatures.any():
            return x, y
        (xx, xy), (_, yy) = self.curvatures.astype(np.float32).transpose(2, 3, 1, 0)[..., None, None]
        moved = xx * (x * x) + 2 * xy * (x * y) + yy * (y * y)
        return x - moved[0], y - moved[1]

    @cached_property
    def ink(self) -> Patches:
        """Ink (1 inside, 0 outside): a smooth step of the first-order distance to the ellipse."""
        x, y = self.inner
        distance = np.maximum(np.hypot(x, y), np.float32(1e-6))
        (a, b), (c, d) = self._to_dot_frame.astype(np.float32).transpose(1, 2, 0)[..., None, None]
        # Gradient of `distance`: the normal of the outline times the length of a pixel in radii.
        right, down = (a * x + c * y) / distance, (b * x + d * y) / distance
        steep = np.maximum(np.hypot(right, down), np.float32(1e-6))
        variance = np.float32(SHARP**2)
        if self.motion_blur.any():
            motion = self.motion_blur.astype(np.float32)[:, :, None, None]
            # A Gaussian edge with the variance of a box filter of the motion's length.
            variance = variance + ((right * motion[:, 0] + down * motion[:, 1]) / steep) ** 2 / 12
        inwards = 1 - distance if self.outlines is None else -self.outlines.distance(x, y)
        return np.asarray(ndtr(inwards / (steep * np.sqrt(variance))))

    def transmission(self, ink: NDArray[np.floating]) -> Layer:
        """Transmission (0 to 1) of `ink`, shape (dots, side, side), at each pixel of the image."""
        margin, appearance = 2 * self.reach + 2, self.appearance
        clear = np.ones((appearance.height + 2 * margin, appearance.width + 2 * margin))
        np.multiply.at(clear.reshape(-1), self._flat(margin), 1 - ink)
        return np.asarray(clear[margin:-margin, margin:-margin], dtype=np.float32)

    def inside(self) -> NDArray[np.bool_]:
        """Whether each dot is entirely inside the image, shape (dots,)."""
        last = np.array([self.appearance.width, self.appearance.height]) - 0.5
        return np.asarray(((self.centers - self._half > -0.5) & (self.centers + self._half < last)).all(axis=1))

    def covered(self, hidden: Layer) -> Array:
        """Fraction of each dot covered by the opacity `hidden`, shape (height, width); shape (dots,)."""
        margin = 2 * self.reach + 2
        over = np.pad(hidden, margin).reshape(-1)[self._flat(margin)]
        return np.asarray((over * self.ink).sum(axis=(1, 2)) / np.maximum(self.ink.sum(axis=(1, 2)), 1e-9))

    def _flat(self, margin: int) -> NDArray[np.intp]:
        steps = np.arange(2 * self.reach + 1)
        stride = self.appearance.width + 2 * margin
        first = (self.corner[:, 1] + margin) * stride + self.corner[:, 0] + margin
        return np.asarray(first[:, None, None] + steps[:, None] * stride + steps)


class DotPrint:
    """One print with random defects."""

    def __init__(self, appearance: DegradedGelAppearance, rng: np.random.Generator) -> None:
        self.appearance = appearance
        markers = appearance.grid.rows * appearance.grid.cols
        self.printed = np.ones(markers, dtype=bool)
        self.printed[rng.permutation(markers)[: round(appearance.missing * markers)]] = False
        self._density = rng.normal(_INK_DENSITY, 0.03, markers).clip(0.85, 1.0)
        whole = rng.permutation(np.flatnonzero(self.printed))
        self._damages = {int(marker): _random_damage(rng) for marker in whole[: round(appearance.damaged * markers)]}
        self._bridges = self._random_bridges(rng)
        radii = 1 + appearance.radius_spread * rng.normal(size=markers).clip(-_LARGEST, _LARGEST)
        self._radii = radii[:, None, None]  # relative to `appearance.radius`
        self._outlines = Outlines(appearance.ragged, markers, rng) if appearance.ragged else None
        offset = rng.normal(size=(markers, 2)).clip(-_LARGEST, _LARGEST)
        # Of the dots from the grid, in the undistorted image (right, down) [px], shape (markers, 2).
        self.offset = appearance.print_offset * appearance.spacing * offset

    def draw(self, centers: Array, shapes: Array, curvatures: Array, motion_blur: Array) -> tuple[Layer, DotPatches]:
        """Transmission (0 to 1) of the print, shape (height, width), and the patches of the markers."""
        appearance, cols = self.appearance, self.appearance.grid.cols
        curvatures = self._radii[..., None] * curvatures
        dots = DotPatches(appearance, centers, self._radii * shapes, motion_blur, self._outlines, curvatures)
        ink = dots.ink * np.where(self.printed, self._density, 0.0)[:, None, None]
        x, y = dots.inner
        for marker, damage in self._damages.items():
            ink[marker] *= damage.remaining(x[marker], y[marker], SHARP / appearance.radius)
        clear = dots.transmission(ink)
        if appearance.cut_row:
            above = DotPatches(
                appearance, 2 * centers[:cols] - centers[cols : 2 * cols], shapes[:cols], motion_blur[:cols]
            )
            clear = clear * above.transmission(_INK_DENSITY * above.ink)
        for one, other, width in self._bridges:
            bar = _bar(appearance, centers[one], centers[other], width * appearance.radius)
            clear = np.minimum(clear, 1 - _INK_DENSITY * bar)
        return np.asarray(clear, dtype=np.float32), dots

    def _random_bridges(self, rng: np.random.Generator) -> list[tuple[int, int, float]]:
        """Disjoint pairs of printed neighbours, and the half width of the bar between them in radii."""
        number = np.arange(self.printed.size).reshape(self.appearance.grid.rows, self.appearance.grid.cols)
        rightward = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
        downward = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
        pairs = np.concatenate([rightward, downward])
        found: list[tuple[int, int, float]] = []
        free = self.printed.copy()
        for k in rng.permutation(len(pairs)):
            one, other = (int(marker) for marker in pairs[k])
            if len(found) < self.appearance.bridges and free[one] and free[other]:
                free[[one, other]] = False
                found.append((one, other, rng.uniform(0.4, 0.8)))
        return found


def _bar(appearance: DegradedGelAppearance, start: Array, end: Array, half: float) -> Layer:
    """Ink of the straight bar between two positions [px], shape (height, width)."""
    right, down = pixel_coordinates(appearance)
    x, y = right - float(start[0]), down - float(start[1])
    along, across = (float(one) for one in end - start)
    share = ((x * along + y * across) / (along**2 + across**2)).clip(0, 1)
    return np.asarray(ndtr((half - np.hypot(x - share * along, y - share * across)) / SHARP))
