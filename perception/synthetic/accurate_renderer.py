"""Pictures of a gel whose dots' centres are known to 0.003 px, with every flaw of `DegradedGelAppearance`.

The way of the light: the gel's light, the contact's shading, the ink, what shines or lies over it, the lens's blur,
the sensor's noise, 8 bits, JPEG. A dot is an ellipse around its centre; its edge is a step as wide as a pixel, so that
a pixel holds what a real one would collect. Lens and stretched gel move a dot's centre and, to first order, turn and
stretch it around that centre: the truth is the centre, whatever is done to the dot.

`FastGelRenderer` draws `GelAppearance` faster, with dot positions rounded to 1/128 px.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic import image_layers
from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.fast_renderer import Image
from gelflow.perception.synthetic.image_layers import Contact
from gelflow.perception.synthetic.printed_dots import Print

Points = NDArray[np.float64]

_HIDDEN = 0.25  # share of a dot that may be covered before it counts as not visible
_BLACK, _YELLOW = (-1.0, -1.0, -1.0), (-0.3, 1.1, 1.0)  # what paint of full contrast adds to blue, green and red
_SHINE = 280.0  # what shines is beyond the sensor's range [grey levels]
_OCCLUDER = (0.55, 0.5, 0.6)  # B G R, as a share of the gel's mean light


@dataclass(frozen=True)
class Exposure:
    """What falls on the sensor, and what is true in it. Markers row by row."""

    picture: image_layers.Layer  # B G R in grey levels, shape (height, width, 3)
    position: Points  # centres of the dots (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # printed, wholly in the image, and not covered, shape (markers,)


@dataclass(frozen=True)
class Frame:
    """One image and what is true in it. Markers row by row."""

    jpeg: bytes
    position: Points  # centres of the dots (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # printed, wholly in the image, and not covered, shape (markers,)

    @property
    def image(self) -> Image:
        """What a reader of the JPEG sees: B G R, shape (height, width, 3)."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


class AccurateGelRenderer:
    """Draws one gel. The same appearance and the same arguments give the same image, byte for byte (on one machine)."""

    def __init__(self, appearance: DegradedGelAppearance) -> None:
        self.appearance = appearance
        rng = np.random.default_rng(appearance.seed)
        self._light = image_layers.light(appearance, rng)
        self._dust = image_layers.dust(appearance, rng)
        self._angle = float(rng.uniform(0, 2 * np.pi))
        self._spots = rng.uniform(-0.7, 0.7, (appearance.highlights, 2))
        self._paths = image_layers.occluder_paths(appearance, rng)
        self._print = Print(appearance, rng)
        self._plain = appearance.to_pixels(appearance.positions_mm())

    def render(
        self,
        displacement_mm: ArrayLike,
        *,
        number: int = 0,
        contact: Contact | None = None,
        smear: ArrayLike | None = None,
        progress: float = 0.0,
    ) -> Frame:
        """The gel with its markers displaced along the pad's x and y [mm], shape (rows * cols, 2).

        `number` chooses the noise; `smear` [px], shape (markers, 2), is each dot's way during the exposure;
        `progress` (0 to 1) is how far the occluders have come. Raises UsageError for arrays of another shape and a
        displacement that is not finite.
        """
        exposed = self.expose(displacement_mm, contact=contact, smear=smear, progress=progress)
        rng = np.random.default_rng((self.appearance.seed, number))
        picture = image_layers.noisy(exposed.picture, self.appearance, rng)
        raw = np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)
        return Frame(_encoded(raw, self.appearance.quality), exposed.position, exposed.visible)

    def expose(
        self,
        displacement_mm: ArrayLike,
        *,
        contact: Contact | None = None,
        smear: ArrayLike | None = None,
        progress: float = 0.0,
    ) -> Exposure:
        """What falls on the sensor, without its noise; arguments as in `render`."""
        appearance = self.appearance
        displacement = np.asarray(displacement_mm, dtype=float)
        if displacement.shape != self._plain.shape:
            raise UsageError(f"displacement must have shape {self._plain.shape} [mm], got {displacement.shape}")
        if not np.isfinite(displacement).all():
            raise UsageError("displacement of the markers must be finite")
        centers, shapes = self._placed(appearance.to_pixels(appearance.positions_mm() + displacement))
        motion = np.zeros_like(centers) if smear is None else np.asarray(smear, dtype=float)
        if motion.shape != centers.shape:
            raise UsageError(f"smear must have shape {centers.shape} [px], got {motion.shape}")
        clear, dots = self._print.draw(centers, shapes, motion)
        picture = (
            self._light * image_layers.shading(appearance, contact, self._angle) if contact else self._light.copy()
        )
        paint = appearance.contrast * np.array(_YELLOW if appearance.bright else _BLACK, dtype=np.float32)
        picture *= self._dust[..., None] * (1 + paint * (1 - clear)[..., None])
        hidden = np.zeros_like(clear)
        if contact is not None and (appearance.ridges or appearance.highlights):
            hidden = image_layers.shine(appearance, contact, self._spots, self._angle)
            picture += hidden[..., None] * (_SHINE - picture)
        if appearance.occluders:
            over = image_layers.occlusion(appearance, self._paths, progress)
            picture += over[..., None] * (
                np.float32(appearance.light) * np.array(_OCCLUDER, dtype=np.float32) - picture
            )
            hidden = np.maximum(hidden, over)
        visible = self._print.printed & dots.inside() & (dots.covered(hidden) < _HIDDEN)
        return Exposure(image_layers.blurred(picture, appearance), centers, visible)

    def _placed(self, plain: Points) -> tuple[Points, Points]:
        """Centres in the image [px], shape (markers, 2), and what stretches and turns each dot, shape (markers, 2, 2).

        The gel's own stretch comes from differences between neighbours, the lens's from those of its mapping.
        """
        appearance = self.appearance
        shape = (appearance.grid.rows, appearance.grid.cols, 2)
        now, rest = plain.reshape(shape), self._plain.reshape(shape)
        stretched, straight = (np.stack(np.gradient(at, axis=(0, 1)), axis=-1) for at in (now, rest))
        gel = (stretched @ np.linalg.inv(straight)).reshape(-1, 2, 2)
        step = 0.5 * np.eye(2)
        lens = np.stack([appearance.warp(plain + one) - appearance.warp(plain - one) for one in step], axis=-1)
        return appearance.warp(plain), lens @ gel @ np.diag([np.sqrt(appearance.oval), 1 / np.sqrt(appearance.oval)])


def _encoded(image: Image, quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()
