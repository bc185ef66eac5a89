"""A fast renderer of undamaged gels for streaming mock cameras.

Illumination, print and a field of sensor noise are drawn once per appearance. An image then costs one crop of the noise
field, one small sprite per dot at a sub-pixel position, one multiplication and the JPEG encoder.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.lens import Lens

_NOISE_SHIFTS = 64  # crops of the noise field per axis [px]
_PHASES = 64  # sprites per pixel and axis: dot positions are rounded to 1/64 px

Image = NDArray[np.uint8]
Map = NDArray[np.float32]


class FastGelRenderer:
    """Renders one gel. Equal appearance, displacement and sequence number give bit-identical images.

    `lens` moves and deforms the dots. Illumination and sensor noise belong to the image and are not distorted.
    """

    def __init__(self, appearance: GelAppearance | None = None, *, lens: Lens | None = None) -> None:
        self.appearance = appearance = GelAppearance() if appearance is None else appearance
        self._pad, self._sources = 0, None  # border of the ideal image that the lens moves into view [px]
        if lens is not None and not lens.ideal:
            self._pad, self._sources = _padded(lens.sources(appearance))
        rng = np.random.default_rng(appearance.seed)
        light = illumination(appearance, rng)
        markers = appearance.grid.rows * appearance.grid.cols
        printed = np.ones(markers, dtype=bool)
        printed[rng.permutation(markers)[: round(appearance.missing * markers)]] = False
        sign = 1.0 if appearance.bright else -1.0
        self._density = (sign * appearance.contrast * rng.normal(1.0, 0.04, markers).clip(0.8, 1.2)).astype(np.float32)
        self._light = light
        field = (appearance.height + _NOISE_SHIFTS, appearance.width + _NOISE_SHIFTS, 3)
        self._noise = rng.normal(0, appearance.noise, field).astype(np.float32)
        self._rest = appearance.positions_mm()
        sprites, self._reach = _sprites(appearance)
        used = (sprites > 0).any(axis=0)  # drops the empty corners of the square
        self._sprites = np.ascontiguousarray(sprites[:, used])
        self._margin = 2 * self._reach + 2 + self._pad
        self._ink = np.ones(
            (appearance.height + 2 * self._margin, appearance.width + 2 * self._margin), dtype=np.float32
        )
        self._view = self._ink[
            self._margin - self._pad : self._margin + appearance.height + self._pad,
            self._margin - self._pad : self._margin + appearance.width + self._pad,
        ]
        self._drawn: NDArray[np.intp] | None = None  # rounded centers of the dots in `_ink`
        # Offsets of the pixels of a sprite in the flattened image.
        steps = np.arange(-self._reach, self._reach + 1)
        self._steps = (steps[:, None] * self._ink.shape[1] + steps).ravel()[used]
        # The sprites of one class do not overlap, so the dots of a class are drawn in one operation.
        row, col = np.divmod(np.arange(markers), appearance.grid.cols)
        self._classes = [np.flatnonzero(printed & (row % 2 == i) & (col % 2 == j)) for i in (0, 1) for j in (0, 1)]

    def render(self, displacement_mm: ArrayLike, *, sequence: int = 0) -> Image:
        """The image (B G R, uint8, shape (height, width, 3)) of the gel with displaced markers.

        `displacement_mm` [mm], shape (rows * cols, 2), is along the pad's x and y axes; `sequence` selects the
        noise, which repeats after 4096 images. Raises UsageError for a wrong shape or values that are not finite.
        """
        displacement = np.asarray(displacement_mm, dtype=float)
        if displacement.shape != self._rest.shape:
            raise UsageError(f"displacement must have shape {self._rest.shape} [mm], got {displacement.shape}")
        if not np.isfinite(displacement).all():
            raise UsageError("displacement of the markers must be finite")
        factor = self._draw_dots(self.appearance.to_pixels(self._rest + displacement))
        if self._sources is not None:
            factor = np.asarray(cv2.remap(factor, *self._sources, cv2.INTER_LINEAR), dtype=np.float32)
        # The odd factor visits every crop once before it repeats one, in an order without a visible motion.
        down, right = divmod(sequence * 2531 % _NOISE_SHIFTS**2, _NOISE_SHIFTS)
        noise = self._noise[down : down + self.appearance.height, right : right + self.appearance.width]
        gel = cv2.add(self._light, noise)
        return np.asarray(cv2.multiply(gel, cv2.merge([factor] * 3), dtype=cv2.CV_8U), dtype=np.uint8)

    def encode(self, image: Image) -> bytes:
        """`image` as JPEG. Raises UsageError when it cannot be encoded."""
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.appearance.quality])
        if not done:
            raise UsageError(f"an image of shape {image.shape} and type {image.dtype} cannot be encoded as JPEG")
        return data.tobytes()

    def _draw_dots(self, centers: NDArray[np.float64]) -> NDArray[np.float32]:
        """Brightness factor of the dots at each pixel, shape (height + 2 pad, width + 2 pad)."""
        appearance, margin, pad = self.appearance, self._margin, self._pad
        flat, stride = self._ink.reshape(-1), self._ink.shape[1]
        # Dots far outside the image are moved to just outside, which keeps their index in the padded image valid.
        limit = np.array([appearance.width, appearance.height]) + self._reach + pad
        centers = np.clip(centers, -self._reach - 1.0 - pad, limit)
        fine = np.round(centers * _PHASES).astype(np.intp)
        if self._drawn is not None and np.array_equal(fine, self._drawn):
            return self._view
        self._drawn, self._ink[:] = fine, 1
        whole, phase = fine // _PHASES, fine % _PHASES
        first = (whole[:, 1] + margin) * stride + whole[:, 0] + margin
        sprite = phase[:, 1] * _PHASES + phase[:, 0]
        keep = np.maximum if appearance.bright else np.minimum
        for markers in self._classes:
            pixels = first[markers, None] + self._steps
            flat[pixels] = keep(flat[pixels], 1 + self._density[markers, None] * self._sprites[sprite[markers]])
        return self._view


def _padded(sources: tuple[Map, Map]) -> tuple[int, tuple[Map, Map]]:
    """The border that contains all source positions [px], and the positions relative to its corner."""
    height, width = sources[0].shape
    right, down = sources
    outside = max(-right.min(), right.max() - (width - 1), -down.min(), down.max() - (height - 1), 0.0)
    pad = int(np.ceil(outside)) + 1
    return pad, (right + np.float32(pad), down + np.float32(pad))


def _sprites(appearance: GelAppearance) -> tuple[NDArray[np.float32], int]:
    """Ink (0 to 1) of a dot at every sub-pixel phase, shape (phases², side²), and `reach` = (side − 1) / 2.

    The edge is a smoothstep whose slope has the standard deviation of the optical blur.
    """
    width = np.sqrt(5) * appearance.blur  # half the width of the step [px]
    reach = int(np.ceil(appearance.radius + width)) + 1
    steps = np.arange(-reach, reach + 1)
    squared = (steps - np.arange(_PHASES)[:, None] / _PHASES) ** 2
    distance = np.sqrt(squared[:, None, :, None] + squared[None, :, None, :])  # phase down, right; pixel down, right
    edge = np.clip((appearance.radius - distance) / (2 * width) + 0.5, 0, 1)
    sprites = (edge * edge * (3 - 2 * edge)).astype(np.float32)
    return sprites.reshape(_PHASES**2, steps.size**2), reach


def illumination(appearance: GelAppearance, rng: np.random.Generator) -> NDArray[np.float32]:
    """The gel without markers, B G R in grey levels: three coloured lights, a vignette and smooth random unevenness."""
    down, right = np.meshgrid(
        np.linspace(-1, 1, appearance.height), np.linspace(-1, 1, appearance.width), indexing="ij"
    )
    angle = rng.uniform(0, 2 * np.pi)
    channels = []
    for channel in range(3):
        turn = angle + channel * 2 * np.pi / 3
        side = np.cos(turn) * right + np.sin(turn) * down
        coarse = cv2.resize(
            rng.normal(0, 1, (5, 4)), (appearance.width, appearance.height), interpolation=cv2.INTER_CUBIC
        )
        glow = 1 + appearance.colour * (0.55 * side + 0.12 * coarse)
        channels.append(appearance.light * glow * (1 - 0.18 * appearance.colour * (right**2 + down**2)))
    return np.ascontiguousarray(np.clip(np.stack(channels, axis=-1), 8, 250), dtype=np.float32)
