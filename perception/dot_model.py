"""What the tracker learns from the first image: the shape of a dot, its oval at each marker, its contrast, the noise.

All dots are prints of one shape, seen through one lens: each is the same profile over q = dᵀ Q d, d from its centre,
where the oval Q follows the local steps of the grid (so that tilt, keystone and distortion are in it) and one matrix
for the print itself. Centres and profile are found in turns, each with the other known.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception._tracker import PROFILE_STEPS, Tracker
from gelflow.perception.detect import PLANES, plane_of
from gelflow.perception.errors import TrackerInitError, draw_seen
from gelflow.perception.grid import Found

Floats = NDArray[np.float64]

_ROUNDS = 2
_REACH = 2.2  # the profile is known up to this many radii
_ALIKE = 0.6  # share of the dots that must have the common shape
_RINGS = 44  # in which it is averaged, as a function of the radius


@dataclass(frozen=True)
class Learned:
    """What `Tracker` is built from, for the markers line by line."""

    rest: Floats  # [px], shape (markers, 2)
    seen: NDArray[np.bool_]  # shape (markers,)
    oval: Floats  # Q as xx, xy, yy [1/px²], shape (markers, 3); 1 = dᵀ Q d is a dot's edge
    contrast: Floats  # of a dot, negative where it is dark, shape (markers,)
    profile: NDArray[np.float32]  # over q in equal steps up to _REACH², 1 inside, 0 outside
    noise: float  # of a pixel, as a share of the light
    quality: Floats  # of each dot's fit, 0 where not seen, shape (markers,)


def learn(image: NDArray[np.uint8], found: Found) -> tuple[Tracker, Learned]:
    """A tracker for the markers `found` in `image` (B G R), started there.

    Raises TrackerInitError when the dots do not look alike, or like no dots: then they are no print.
    """
    _alike(image, found, found.seen.astype(np.float64).reshape(-1))
    try:
        return _learn(image, found)
    except ValueError as error:  # of a shape without an edge, of dots that touch
        picture = draw_seen(image, found.positions[found.seen], found.radius, None)
        raise TrackerInitError(
            f"the spots in lines and columns are no dots that can be measured: {error}", picture
        ) from None


def _learn(image: NDArray[np.uint8], found: Found) -> tuple[Tracker, Learned]:
    plane = plane_of(image, found.look.plane).astype(np.float64)
    window = _Windows(plane, found)
    oval = window.ovals(found)
    sign = 1.0 if found.look.bright else -1.0
    profile = _edge(np.sqrt(np.linspace(0, _REACH**2, PROFILE_STEPS + 1)))
    seen = found.seen.reshape(-1)
    contrast = np.full(len(seen), sign * float(np.median(window.depth)))
    learned = Learned(found.positions.reshape(-1, 2), seen, oval, contrast, profile, 0.02, seen.astype(np.float64))
    for _ in range(_ROUNDS):
        tracker = _tracker(image, found, learned)
        rest, measured, quality = tracker.start(image)
        seen = _alike(image, found, quality)
        contrast = np.where(seen, measured, np.median(measured[seen]))
        profile, noise = window.profile(rest, oval, seen)
        learned = replace(learned, contrast=contrast, rest=rest, profile=profile, noise=noise)
    tracker = _tracker(image, found, learned)
    rest, _, quality = tracker.start(image)
    return tracker, replace(learned, rest=rest, seen=_alike(image, found, quality), quality=quality)


def _alike(image: NDArray[np.uint8], found: Found, quality: Floats) -> NDArray[np.bool_]:
    """Which dots have the common shape."""
    seen, dots = quality > 0, int(found.seen.sum())
    if seen.sum() < max(_ALIKE * dots, 6):
        raise TrackerInitError(
            f"of {dots} spots in lines and columns only {seen.sum()} look alike: they are no printed markers, "
            "or too blurred or damaged",
            draw_seen(image, found.positions[found.seen], found.radius, None),
        )
    return seen


def _tracker(image: NDArray[np.uint8], found: Found, learned: Learned) -> Tracker:
    return Tracker(
        width=image.shape[1],
        height=image.shape[0],
        channel=PLANES.index(found.look.plane),
        bright=found.look.bright,
        rows=found.shape[0],
        cols=found.shape[1],
        spacing=found.spacing,
        radius=found.radius,
        noise=learned.noise,
        profile=learned.profile,
        reach=_REACH**2,
        rest=learned.rest,
        seen=learned.seen,
        oval=learned.oval,
        contrast=learned.contrast,
    )


class _Windows:
    """The pixels around each dot that was seen, their offsets from a first guess of its centre, and their light."""

    def __init__(self, plane: Floats, found: Found) -> None:
        half = int(np.ceil(min(2.0 * found.radius + 1, 0.5 * found.spacing)))
        self.seen = np.flatnonzero(found.seen)
        self.corner = np.round(found.positions.reshape(-1, 2)).astype(np.intp)
        padded = cv2.copyMakeBorder(plane, half, half, half, half, cv2.BORDER_REPLICATE)
        steps = np.arange(-half, half + 1, max(1, round(found.radius / 4)))  # more pixels would tell no more
        down, right = (a.reshape(-1) for a in np.meshgrid(steps, steps, indexing="ij"))
        self.step = np.stack([right, down], axis=1).astype(np.float64)  # shape (pixels, 2)
        at = np.clip(self.corner[self.seen], 0, (plane.shape[1] - 1, plane.shape[0] - 1))
        self.pixels = padded[at[:, 1, None] + half + down, at[:, 0, None] + half + right]  # shape (dots, pixels)
        self.offset = self.step - (found.positions.reshape(-1, 2) - self.corner)[self.seen][:, None]
        distance = np.linalg.norm(self.offset, axis=-1)
        self.light = _plane_through(self.pixels, self.step, (distance > 1.6 * found.radius).astype(np.float64))
        share = self.pixels / np.maximum(self.light, 1.0) - 1
        inside = distance < 0.6 * found.radius
        self.depth = np.abs((share * inside).sum(1) / np.maximum(inside.sum(1), 1))
        sign = 1.0 if found.look.bright else -1.0
        self.ink = sign * share / np.maximum(self.depth, 1e-3)[:, None]

    def ovals(self, found: Found) -> Floats:
        """Q of every marker, shape (markers, 3), from the dots' second moments and the grid's local steps."""
        near = np.linalg.norm(self.offset, axis=-1) < 2.0 * found.radius
        weight = np.clip((self.ink - 0.25) / 0.5, 0, 1) * near
        total = np.maximum(weight.sum(1), 1e-9)[:, None]
        mean = (weight[:, None] @ self.offset)[:, 0] / total
        off = self.offset - mean[:, None]
        moments = (off * weight[..., None]).transpose(0, 2, 1) @ off / total[..., None]
        steps = _steps(found)
        back = np.linalg.inv(steps)
        # As a share of the steps the print is the same everywhere; a disc of radius 1 has the moments 1/4.
        common = np.median(back[self.seen] @ moments @ back[self.seen].transpose(0, 2, 1), axis=0)
        q = back.transpose(0, 2, 1) @ np.linalg.inv(4 * common) @ back
        return np.stack([q[:, 0, 0], q[:, 0, 1], q[:, 1, 1]], axis=1)

    def profile(self, rest: Floats, oval: Floats, seen: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float]:
        """The mean ink over q, as `Learned.profile`, and the noise that is left."""
        use = seen[self.seen]
        markers = self.seen[use]
        off = self.step - (rest - self.corner)[markers][:, None]
        xx, xy, yy = oval[markers].T[:, :, None]
        radius = np.sqrt(off[..., 0] ** 2 * xx + 2 * off[..., 0] * off[..., 1] * xy + off[..., 1] ** 2 * yy)
        light = _plane_through(self.pixels[use], self.step, (radius > 1.7).astype(np.float64))
        share = self.pixels[use] / np.maximum(light, 1.0) - 1
        inside = radius < 0.6
        depth = (share * inside).sum(1) / np.maximum(inside.sum(1), 1)
        ink = share / np.where(np.abs(depth) > 1e-3, depth, 1e-3)[:, None]
        ring = np.minimum(radius / _REACH * _RINGS, _RINGS).astype(np.intp)
        sound = np.abs(ink - _edge(radius)) < 0.75  # not where dots are damaged
        count = np.bincount(ring[sound], minlength=_RINGS + 1)[:_RINGS]
        total = np.bincount(ring[sound], ink[sound], minlength=_RINGS + 1)[:_RINGS]
        middle = (np.arange(_RINGS) + 0.5) / _RINGS * _REACH
        mean = np.interp(middle, middle[count > 0], total[count > 0] / count[count > 0])
        mean = np.convolve(np.pad(mean, 1, mode="edge"), (0.25, 0.5, 0.25), mode="valid")
        mean -= mean[middle > 1.8].mean()
        mean /= mean[middle < 0.6].mean()
        at = np.sqrt(np.linspace(0, _REACH**2, PROFILE_STEPS + 1))
        table = np.interp(at, middle, mean, right=0.0) * np.clip((_REACH - at) / 0.3, 0, 1)
        outside = share[(radius > 1.7) & (radius < 2.0)]
        noise = 1.4826 * float(np.median(np.abs(outside))) if outside.size else 0.02
        return table.astype(np.float32), noise


def _plane_through(pixels: Floats, step: Floats, weight: Floats) -> Floats:
    """The least-squares plane through each window's pixels, shape (windows, pixels)."""
    terms = np.concatenate([np.ones((len(step), 1)), step / np.abs(step).max()], axis=1)
    products = (terms[:, :, None] * terms[:, None, :]).reshape(-1, 9)
    matrix = (weight @ products).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
    right = (weight * pixels) @ terms
    return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0] @ terms.T)


def _steps(found: Found) -> Floats:
    """The grid's local steps to the right and down as columns [px], shape (markers, 2, 2)."""
    rows, cols = found.shape
    degree = min(3, rows - 1, cols - 1)
    down, right = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    terms = np.stack([right**i * down**j for i, j in powers], axis=-1)
    weights = np.linalg.lstsq(terms[found.seen], found.positions[found.seen], rcond=None)[0]
    by_right = np.stack([i * right ** max(i - 1, 0) * down**j for i, j in powers], axis=-1) @ weights
    by_down = np.stack([j * right**i * down ** max(j - 1, 0) for i, j in powers], axis=-1) @ weights
    steps = np.stack([by_right * 2 / (cols - 1), by_down * 2 / (rows - 1)], axis=-1)
    return steps.reshape(-1, 2, 2)


def _edge(radius: Floats) -> NDArray[np.float32]:
    """A first guess of the profile: a smooth step at radius 1."""
    part = np.clip((1.5 - radius) / 1.0, 0, 1)
    return (part * part * (3 - 2 * part)).astype(np.float32)
