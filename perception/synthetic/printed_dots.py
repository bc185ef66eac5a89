"""The print on a gel: which dots it lacks, which are damaged or run together, and the ink of all in an image."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.image_layers import SHARP, Layer, places

Array = NDArray[np.float64]
Patches = NDArray[np.float32]  # shape (dots, side, side)

# Offsets from the dot's middle and sizes of what is gone, in radii, as on old gels.
_DAMAGES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "cut": ((0.2, 0.8), (0.0, 0.0)),
    "scratch": ((-0.6, 0.6), (0.08, 0.22)),
    "hole": ((0.3, 0.9), (0.15, 0.4)),
    "worn": ((0.0, 0.0), (0.06, 0.2)),
}
_LITTLE = 6  # holes of a worn dot
_DENSE = 0.96  # usual density of the ink; the appearance's contrast is that of a density of 1


@dataclass(frozen=True)
class Damage:
    """Ink that is gone from one dot. Places in units of the dot's radius, in the dot's own, unstretched frame."""

    kind: str  # "cut", "scratch", "hole" or "worn": many little holes
    angle: float
    offset: float
    size: float

    def left(self, x: Patches, y: Patches, edge: float) -> Patches:
        """Share of the ink that is left at places (x, y); edges are as soft as `edge`."""
        right, down = math.cos(self.angle), math.sin(self.angle)
        if self.kind in ("cut", "scratch"):
            beyond = x * right + y * down - self.offset
            return np.asarray(ndtr((np.abs(beyond) - self.size if self.kind == "scratch" else -beyond) / edge))
        if self.kind == "hole":
            far = np.hypot(x - self.offset * right, y - self.offset * down)
            return np.asarray(ndtr((far - self.size) / edge))
        ink = np.ones_like(x)
        for k in range(_LITTLE):
            turn, out = self.angle + 2.4 * k, math.sqrt((k + 0.5) / _LITTLE)  # 2.4: the golden angle
            far = np.hypot(x - out * math.cos(turn), y - out * math.sin(turn))
            ink = ink * ndtr((far - self.size) / edge)
        return np.asarray(ink)


def _drawn_damage(rng: np.random.Generator) -> Damage:
    kind = tuple(_DAMAGES)[rng.integers(len(_DAMAGES))]
    offset, size = (rng.uniform(*limits) for limits in _DAMAGES[kind])
    return Damage(kind, rng.uniform(0, 2 * np.pi), offset, size)


@dataclass(frozen=True)
class Dots:
    """Square patches of pixels, one around each dot, in one image."""

    appearance: DegradedGelAppearance
    centers: Array  # [px], shape (dots, 2)
    shapes: Array  # a dot's ellipse is this matrix times a disc of the appearance's radius, shape (dots, 2, 2)
    smear: Array  # way of each dot during the exposure [px], shape (dots, 2)

    @cached_property
    def _half(self) -> Array:
        """Half the width and height of each dot with its smear [px], shape (dots, 2)."""
        return np.asarray(self.appearance.radius * np.linalg.norm(self.shapes, axis=-1) + np.abs(self.smear) / 2)

    @cached_property
    def reach(self) -> int:
        """Half a patch's side [px]."""
        return int(np.ceil(self._half.max() + 4 * SHARP)) + 1

    @cached_property
    def corner(self) -> NDArray[np.intp]:
        """First pixel of each patch (right, down), shape (dots, 2); far outside is as good as just outside."""
        size = np.array([self.appearance.width, self.appearance.height])
        near = np.clip(np.rint(self.centers), -self.reach - 1, size + self.reach)
        return np.asarray(near.astype(np.intp) - self.reach)

    @cached_property
    def _back(self) -> Array:
        """From the image to each dot's own frame, in which its radius is 1, shape (dots, 2, 2)."""
        return np.asarray(np.linalg.inv(self.shapes) / self.appearance.radius)

    @cached_property
    def inner(self) -> tuple[Patches, Patches]:
        """Places (right, down) of the patches' pixels in each dot's own frame, in radii."""
        steps = np.arange(2 * self.reach + 1)
        off = self.corner - self.centers
        right = (off[:, :1] + steps).astype(np.float32)[:, None, :]
        down = (off[:, 1:] + steps).astype(np.float32)[:, :, None]
        (a, b), (c, d) = self._back.astype(np.float32).transpose(1, 2, 0)[..., None, None]
        return a * right + b * down, c * right + d * down

    @cached_property
    def ink(self) -> Patches:
        """1 inside, 0 outside: a step over the distance to the ellipse, to first order."""
        x, y = self.inner
        far = np.maximum(np.hypot(x, y), np.float32(1e-6))
        (a, b), (c, d) = self._back.astype(np.float32).transpose(1, 2, 0)[..., None, None]
        # The gradient of `far`: the outline's normal, and how many radii a pixel is along it.
        right, down = (a * x + c * y) / far, (b * x + d * y) / far
        steep = np.maximum(np.hypot(right, down), np.float32(1e-6))
        variance = np.float32(SHARP**2)
        if self.smear.any():
            way = self.smear.astype(np.float32)[:, :, None, None]
            # A box as long as the way has this variance; a Gaussian edge with it is as wide.
            variance = variance + ((right * way[:, 0] + down * way[:, 1]) / steep) ** 2 / 12
        return np.asarray(ndtr((1 - far) / (steep * np.sqrt(variance))))

    def show_through(self, ink: NDArray[np.floating]) -> Layer:
        """How much of the gel is seen through `ink`, shape (dots, side, side), in the image: 0 to 1."""
        margin, appearance = 2 * self.reach + 2, self.appearance
        clear = np.ones((appearance.height + 2 * margin, appearance.width + 2 * margin))
        np.multiply.at(clear.reshape(-1), self._flat(margin), 1 - ink)
        return np.asarray(clear[margin:-margin, margin:-margin], dtype=np.float32)

    def inside(self) -> NDArray[np.bool_]:
        """Whether a dot is wholly in the image, shape (dots,)."""
        last = np.array([self.appearance.width, self.appearance.height]) - 0.5
        return np.asarray(((self.centers - self._half > -0.5) & (self.centers + self._half < last)).all(axis=1))

    def covered(self, hidden: Layer) -> Array:
        """Share of each dot that `hidden`, 0 to 1, shape (height, width), lies over, shape (dots,)."""
        margin = 2 * self.reach + 2
        over = np.pad(hidden, margin).reshape(-1)[self._flat(margin)]
        return np.asarray((over * self.ink).sum(axis=(1, 2)) / np.maximum(self.ink.sum(axis=(1, 2)), 1e-9))

    def _flat(self, margin: int) -> NDArray[np.intp]:
        steps = np.arange(2 * self.reach + 1)
        stride = self.appearance.width + 2 * margin
        first = (self.corner[:, 1] + margin) * stride + self.corner[:, 0] + margin
        return np.asarray(first[:, None, None] + steps[:, None] * stride + steps)


class Print:
    """The flaws of one print, drawn at random."""

    def __init__(self, appearance: DegradedGelAppearance, rng: np.random.Generator) -> None:
        self.appearance = appearance
        markers = appearance.grid.rows * appearance.grid.cols
        self.printed = np.ones(markers, dtype=bool)
        self.printed[rng.permutation(markers)[: round(appearance.missing * markers)]] = False
        self._density = rng.normal(_DENSE, 0.03, markers).clip(0.85, 1.0)
        whole = rng.permutation(np.flatnonzero(self.printed))
        self._damages = {int(marker): _drawn_damage(rng) for marker in whole[: round(appearance.damaged * markers)]}
        self._bridges = self._drawn_bridges(rng)

    def draw(self, centers: Array, shapes: Array, smear: Array) -> tuple[Layer, Dots]:
        """How much of the gel is seen through the print, 0 to 1, shape (height, width); and the markers' dots."""
        appearance, cols = self.appearance, self.appearance.grid.cols
        dots = Dots(appearance, centers, shapes, smear)
        ink = dots.ink * np.where(self.printed, self._density, 0.0)[:, None, None]
        x, y = dots.inner
        for marker, damage in self._damages.items():
            ink[marker] *= damage.left(x[marker], y[marker], SHARP / appearance.radius)
        clear = dots.show_through(ink)
        if appearance.cut_row:
            above = Dots(appearance, 2 * centers[:cols] - centers[cols : 2 * cols], shapes[:cols], smear[:cols])
            clear = clear * above.show_through(_DENSE * above.ink)
        for one, other, width in self._bridges:
            bar = _bar(appearance, centers[one], centers[other], width * appearance.radius)
            clear = np.minimum(clear, 1 - _DENSE * bar)
        return np.asarray(clear, dtype=np.float32), dots

    def _drawn_bridges(self, rng: np.random.Generator) -> list[tuple[int, int, float]]:
        """Pairs of printed neighbours, no marker in two, and the half width of the bar between them in radii."""
        number = np.arange(self.printed.size).reshape(self.appearance.grid.rows, self.appearance.grid.cols)
        beside = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
        below = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
        pairs = np.concatenate([beside, below])
        found: list[tuple[int, int, float]] = []
        free = self.printed.copy()
        for k in rng.permutation(len(pairs)):
            one, other = (int(marker) for marker in pairs[k])
            if len(found) < self.appearance.bridges and free[one] and free[other]:
                free[[one, other]] = False
                found.append((one, other, rng.uniform(0.4, 0.8)))
        return found


def _bar(appearance: DegradedGelAppearance, start: Array, end: Array, half: float) -> Layer:
    """1 on the straight bar between two places [px], 0 elsewhere, shape (height, width)."""
    right, down = places(appearance)
    x, y = right - float(start[0]), down - float(start[1])
    along, across = (float(one) for one in end - start)
    share = ((x * along + y * across) / (along**2 + across**2)).clip(0, 1)
    return np.asarray(ndtr((half - np.hypot(x - share * along, y - share * across)) / SHARP))
