"""Pictures of a gel with printed markers, drawn from the markers' displacement: what a tactile camera would see.

Speed is the point: two cameras stream these images while a simulation runs beside them. Illumination, print and a
stock of sensor noise are drawn once for a look; an image then only costs its dots (small sprites at sub-pixel
places), one multiplication and the JPEG encoder.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid

_NOISE_IMAGES = 8  # prepared pictures of the gel with sensor noise; an image takes one of them
_PHASES = 64  # sprites per pixel and axis: a dot's place is exact to 1/128 px

GELSLIM_GRID = Grid(rows=18, cols=14, pitch=1.4, center=(2.0, 0.0))  # printed markers on the pad [mm]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class GelLook:
    """How a gel looks to its camera. The defaults follow published pictures of a GelSlim 3.0."""

    grid: Grid = GELSLIM_GRID
    width: int = 320  # of the image [px]
    height: int = 427  # of the image [px]
    pixels_per_mm: float = 15.7
    rotation: Literal[0, 90, 180, 270] = 0  # clockwise in the image; at 0 the finger's tip is at the bottom
    mirrored: bool = True  # the camera sees the gel from behind
    radius: float = 4.4  # of a dot [px]
    contrast: float = 0.62  # how much darker than its surroundings a dot is, 0 to 1
    blur: float = 1.0  # standard deviation of the optical blur [px]
    noise: float = 1.2  # standard deviation of the sensor noise [grey levels]
    light: float = 125.0  # mean brightness of the gel [grey levels]
    colour: float = 0.35  # strength of the coloured gradients, 0 (even grey) to 1
    missing: float = 0.0  # share of the markers that are not printed, 0 to 1
    bright: bool = False  # dots brighter than the gel
    quality: int = 88  # of the JPEG, 1 to 100
    seed: int = 0  # illumination, print and noise are drawn from it

    def __post_init__(self) -> None:
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096):
            raise UsageError(f"a gel image is 16 to 4096 px wide and high, got {self.width} × {self.height}")
        if self.rotation not in (0, 90, 180, 270):
            raise UsageError(f"rotation must be 0, 90, 180 or 270 degrees, got {self.rotation}")
        for name, low, high in (
            ("pixels_per_mm", 0.1, 1000.0),
            ("radius", 0.5, 100.0),
            ("contrast", 0.0, 1.0),
            ("blur", 0.1, 20.0),
            ("noise", 0.0, 40.0),
            ("light", 1.0, 255.0),
            ("colour", 0.0, 1.0),
            ("missing", 0.0, 1.0),
            ("quality", 1, 100),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"{name} of a gel's look must be within {low} to {high}, got {value}")

    def positions_mm(self) -> NDArray[np.float64]:
        """Markers at rest in the pad's frame (x base to tip, y = z × x) [mm], shape (markers, 2), row by row."""
        return self.grid.positions()

    def to_pixels(self, positions_mm: ArrayLike) -> NDArray[np.float64]:
        """Where places on the pad [mm], shape (n, 2), appear in the image [px], shape (n, 2): right, down."""
        offset = np.asarray(positions_mm, dtype=float) - self.grid.center
        # Seen from outside with the tip at the bottom, x points down and y to the right; from behind, y to the left.
        right, down = (-offset[:, 1] if self.mirrored else offset[:, 1]), offset[:, 0]
        for _ in range(self.rotation // 90):
            right, down = -down, right
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.stack([right, down], axis=1) * self.pixels_per_mm + middle


class GelRenderer:
    """Draws one gel. The same look, displacement and sequence number give the same image, byte for byte."""

    def __init__(self, look: GelLook | None = None) -> None:
        self.look = look = GelLook() if look is None else look
        rng = np.random.default_rng(look.seed)
        light = illumination(look, rng)
        markers = look.grid.rows * look.grid.cols
        printed = np.ones(markers, dtype=bool)
        printed[rng.permutation(markers)[: round(look.missing * markers)]] = False
        sign = 1.0 if look.bright else -1.0
        self._density = (sign * look.contrast * rng.normal(1.0, 0.04, markers).clip(0.8, 1.2)).astype(np.float32)
        self._gels = [
            (light + rng.normal(0, look.noise, light.shape)).clip(0, 255).astype(np.float32)
            for _ in range(_NOISE_IMAGES)
        ]
        self._rest = look.positions_mm()
        sprites, self._reach = _sprites(look)
        used = (sprites > 0).any(axis=0)  # the corners of the square stay empty
        self._sprites = np.ascontiguousarray(sprites[:, used])
        self._margin = 2 * self._reach + 2
        self._ink = np.ones((look.height + 2 * self._margin, look.width + 2 * self._margin), dtype=np.float32)
        # Offsets of a sprite's pixels in the flattened picture.
        steps = np.arange(-self._reach, self._reach + 1)
        self._steps = (steps[:, None] * self._ink.shape[1] + steps).ravel()[used]
        # Sprites of one class never touch unless the gel folds, so that a class is drawn in one stroke.
        row, col = np.divmod(np.arange(markers), look.grid.cols)
        self._classes = [np.flatnonzero(printed & (row % 2 == i) & (col % 2 == j)) for i in (0, 1) for j in (0, 1)]

    def render(self, displacement_mm: ArrayLike, *, sequence: int = 0) -> Image:
        """The image (B G R, uint8, shape (height, width, 3)) of the gel with its markers displaced.

        `displacement_mm` [mm], shape (rows * cols, 2), along the pad's x and y; `sequence` chooses the noise.
        Raises UsageError for another shape or values that are not finite.
        """
        displacement = np.asarray(displacement_mm, dtype=float)
        if displacement.shape != self._rest.shape:
            raise UsageError(f"displacement must have shape {self._rest.shape} [mm], got {displacement.shape}")
        if not np.isfinite(displacement).all():
            raise UsageError("displacement of the markers must be finite")
        factor = self._draw_dots(self.look.to_pixels(self._rest + displacement))
        # Knuth's multiplicative hash: neighbours in sequence take pictures that do not follow a visible cycle.
        gel = self._gels[(sequence * 2654435761 % 2**32) * _NOISE_IMAGES >> 32]
        return np.asarray(cv2.multiply(gel, cv2.merge([factor] * 3), dtype=cv2.CV_8U), dtype=np.uint8)

    def encode(self, image: Image) -> bytes:
        """`image` as JPEG."""
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.look.quality])
        if not done:
            raise UsageError(f"an image of shape {image.shape} and type {image.dtype} can not become a JPEG")
        return data.tobytes()

    def _draw_dots(self, centers: NDArray[np.float64]) -> NDArray[np.float32]:
        """By how much the dots dim or light each pixel, shape (height, width); off the image they are cut off."""
        look, margin = self.look, self._margin
        self._ink[:] = 1
        flat, stride = self._ink.reshape(-1), self._ink.shape[1]
        # A dot far outside is moved to just outside, where nothing of it shows.
        limit = np.array([look.width, look.height]) + self._reach
        centers = np.clip(centers, -self._reach - 1.0, limit)
        fine = np.round(centers * _PHASES).astype(np.intp)
        whole, phase = fine // _PHASES, fine % _PHASES
        first = (whole[:, 1] + margin) * stride + whole[:, 0] + margin
        sprite = phase[:, 1] * _PHASES + phase[:, 0]
        keep = np.maximum if look.bright else np.minimum
        for markers in self._classes:
            places = first[markers, None] + self._steps
            flat[places] = keep(flat[places], 1 + self._density[markers, None] * self._sprites[sprite[markers]])
        return self._ink[margin : margin + look.height, margin : margin + look.width]


def _sprites(look: GelLook) -> tuple[NDArray[np.float32], int]:
    """A dot's ink (0 to 1) at every phase within a pixel, shape (phases², side²), and its reach.

    side is 2 reach + 1; the edge is a smooth step as wide as makes its slope's standard deviation the blur's.
    """
    width = np.sqrt(5) * look.blur  # half the step's width [px]
    reach = int(np.ceil(look.radius + width)) + 1
    steps = np.arange(-reach, reach + 1)
    squared = (steps - np.arange(_PHASES)[:, None] / _PHASES) ** 2
    distance = np.sqrt(squared[:, None, :, None] + squared[None, :, None, :])  # phase down, right; pixel down, right
    edge = np.clip((look.radius - distance) / (2 * width) + 0.5, 0, 1)
    sprites = (edge * edge * (3 - 2 * edge)).astype(np.float32)
    return sprites.reshape(_PHASES**2, steps.size**2), reach


def illumination(look: GelLook, rng: np.random.Generator) -> NDArray[np.float32]:
    """The gel without markers: a coloured light from each side, a vignette and soft unevenness."""
    down, right = np.meshgrid(np.linspace(-1, 1, look.height), np.linspace(-1, 1, look.width), indexing="ij")
    angle = rng.uniform(0, 2 * np.pi)
    channels = []
    for channel in range(3):
        turn = angle + channel * 2 * np.pi / 3
        side = np.cos(turn) * right + np.sin(turn) * down
        coarse = cv2.resize(rng.normal(0, 1, (5, 4)), (look.width, look.height), interpolation=cv2.INTER_CUBIC)
        glow = 1 + look.colour * (0.55 * side + 0.12 * coarse)
        channels.append(look.light * glow * (1 - 0.18 * look.colour * (right**2 + down**2)))
    return np.ascontiguousarray(np.clip(np.stack(channels, axis=-1), 8, 250), dtype=np.float32)
