"""A renderer of imperfect gels whose dot centres are accurate to 0.003 px: the ground truth of tests and benchmarks.

The image is composed in the order of the light path: illumination, shading of the contact, ink, specular highlights
and occluders, optical blur, sensor noise, 8-bit quantization, JPEG. A dot is an ellipse with an edge as wide as a
pixel. Lens distortion and gel deformation move its centre and, to first order, rotate and stretch it about that
centre, and the curvature of the gel's displacement curves it. The ground truth is where the centre of the undeformed
dot has moved, which is not the centre of a curved outline.
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
from gelflow.perception.synthetic.printed_dots import DotPrint

Points = NDArray[np.float64]

_MAX_COVERED = 0.25  # covered fraction from which on a dot is not visible
_DARK_INK, _BRIGHT_INK = (-1.0, -1.0, -1.0), (-0.3, 1.1, 1.0)  # relative change of B, G, R at contrast 1
_SPECULAR = 280.0  # brightness of specular highlights, above the sensor range [grey levels]
_OCCLUDER = (0.55, 0.5, 0.6)  # B G R, relative to the mean brightness of the gel


@dataclass(frozen=True)
class NoiselessImage:
    """A noiseless image with its ground truth. Markers row by row."""

    picture: image_layers.Layer  # B G R in grey levels, shape (height, width, 3)
    position: Points  # centres of the dots (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # printed, entirely in the image and not covered, shape (markers,)


@dataclass(frozen=True)
class RenderedImage:
    """A JPEG image with its ground truth. Markers row by row."""

    jpeg: bytes
    position: Points  # centres of the dots (right, down) [px], shape (markers, 2)
    visible: NDArray[np.bool_]  # printed, entirely in the image and not covered, shape (markers,)

    @property
    def image(self) -> Image:
        """The decoded JPEG: B G R, uint8, shape (height, width, 3)."""
        return np.asarray(cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


class AccurateGelRenderer:
    """Renders one gel. Equal appearance and arguments give bit-identical images on the same machine."""

    def __init__(self, appearance: DegradedGelAppearance) -> None:
        self.appearance = appearance
        rng = np.random.default_rng(appearance.seed)
        self._light = image_layers.light(appearance, rng)
        self._dust = image_layers.dust(appearance, rng)
        self._angle = float(rng.uniform(0, 2 * np.pi))
        self._spots = rng.uniform(-0.7, 0.7, (appearance.highlights, 2))
        self._paths = image_layers.occluder_paths(appearance, rng)
        self._print = DotPrint(appearance, rng)
        self._undistorted = appearance.to_pixels(appearance.positions_mm())

    def render(
        self,
        displacement_mm: ArrayLike,
        *,
        number: int = 0,
        contact: Contact | None = None,
        motion_blur: ArrayLike | None = None,
        progress: float = 0.0,
    ) -> RenderedImage:
        """The image of the gel with displaced markers.

        Parameters
        ----------
        displacement_mm: marker displacement along the pad's x and y axes [mm], shape (markers, 2)
        number: seed of the noise of this image
        contact: contact pressed into the gel
        motion_blur: motion of each dot during the exposure (right, down) [px], shape (markers, 2)
        progress: position of the occluders on their paths, 0 to 1

        Raises UsageError for arrays of a wrong shape and a displacement that is not finite.
        """
        noiseless = self.render_noiseless(displacement_mm, contact=contact, motion_blur=motion_blur, progress=progress)
        rng = np.random.default_rng((self.appearance.seed, number))
        picture = image_layers.noisy(noiseless.picture, self.appearance, rng)
        raw = np.asarray(np.clip(np.rint(picture), 0, 255), dtype=np.uint8)
        return RenderedImage(_encode_jpeg(raw, self.appearance.quality), noiseless.position, noiseless.visible)

    def render_noiseless(
        self,
        displacement_mm: ArrayLike,
        *,
        contact: Contact | None = None,
        motion_blur: ArrayLike | None = None,
        progress: float = 0.0,
    ) -> NoiselessImage:
        """The image before sensor noise and quantization; arguments as in `render`."""
        appearance = self.appearance
        displacement = np.asarray(displacement_mm, dtype=float)
        if displacement.shape != self._undistorted.shape:
            raise UsageError(f"displacement must have shape {self._undistorted.shape} [mm], got {displacement.shape}")
        if not np.isfinite(displacement).all():
            raise UsageError("displacement of the markers must be finite")
        centers, shapes, curvatures = self._deformed_dots(
            appearance.to_pixels(appearance.positions_mm() + displacement)
        )
        motion = np.zeros_like(centers) if motion_blur is None else np.asarray(motion_blur, dtype=float)
        if motion.shape != centers.shape:
            raise UsageError(f"motion_blur must have shape {centers.shape} [px], got {motion.shape}")
        clear, dots = self._print.draw(centers, shapes, curvatures, motion)
        picture, hidden = self._compose(clear, contact, progress)
        visible = self._print.printed & dots.inside() & (dots.covered(hidden) < _MAX_COVERED)
        return NoiselessImage(image_layers.blurred(picture, appearance), centers, visible)

    def _compose(
        self, clear: image_layers.Layer, contact: Contact | None, progress: float
    ) -> tuple[image_layers.Layer, image_layers.Layer]:
        """The sharp image for the transmission `clear` of the print, and the opacity of highlights and occluders."""
        appearance = self.appearance
        shading = image_layers.shading(appearance, contact, self._angle) if contact else None
        picture = self._light.copy() if shading is None else self._light * shading
        ink = appearance.contrast * np.array(_BRIGHT_INK if appearance.bright else _DARK_INK, dtype=np.float32)
        picture *= self._dust[..., None] * (1 + ink * (1 - clear)[..., None])
        hidden = np.zeros_like(clear)
        if contact is not None and (appearance.ridges or appearance.highlights):
            hidden = image_layers.shine(appearance, contact, self._spots, self._angle)
            picture += hidden[..., None] * (_SPECULAR - picture)
        if appearance.occluders:
            covered = image_layers.occlusion(appearance, self._paths, progress)
            colour = np.float32(appearance.light) * np.array(_OCCLUDER, dtype=np.float32)
            picture += covered[..., None] * (colour - picture)
            hidden = np.maximum(hidden, covered)
        return picture, hidden

    def _deformed_dots(self, undistorted: Points) -> tuple[Points, Points, Points]:
        """Centres, deformation and curvature of each dot.

        Centres in the image [px], shape (markers, 2), and `shapes` and `curvatures` of `DotPatches`. The derivatives
        of the displacement come from finite differences between neighbouring markers, the Jacobian of the lens from
        finite differences of its mapping.
        """
        appearance = self.appearance
        shape = (appearance.grid.rows, appearance.grid.cols, 2)
        now, rest = undistorted.reshape(shape), self._undistorted.reshape(shape)
        stretched, straight = (np.stack([_derivative(at, 0), _derivative(at, 1)], axis=-1) for at in (now, rest))
        steps = np.linalg.inv(straight)  # rows and columns per pixel
        gel = (stretched @ steps).reshape(-1, 2, 2)
        warp = appearance.warp
        lens = np.stack([warp(undistorted + step) - warp(undistorted - step) for step in 0.5 * np.eye(2)], axis=-1)
        oval = np.diag([np.sqrt(appearance.oval), 1 / np.sqrt(appearance.oval)])
        shapes = lens @ gel @ oval
        curved = np.einsum("rcmij,rcia,rcjb->rcmab", _second_differences(now - rest), steps, steps)
        curved = oval @ curved.reshape(-1, 2, 2, 2) @ oval
        curvatures = appearance.radius / 2 * np.einsum("dnm,dmab->dnab", np.linalg.inv(shapes) @ lens, curved)
        return warp(undistorted + self._print.offset), shapes, curvatures


def _derivative(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Derivative by row (0) or column (1), in units of the grid: of fourth order, near the border of second order."""
    along = np.moveaxis(values, axis, 0)
    result = np.gradient(along, axis=0, edge_order=2 if len(along) > 2 else 1)
    if len(along) > 4:
        result[2:-2] = (8 * (along[3:-1] - along[1:-3]) - (along[4:] - along[:-4])) / 12
    return np.moveaxis(result, 0, axis)


def _second_differences(displacement: Points) -> NDArray[np.float64]:
    """Second differences by row and column, shape (rows, cols, 2, 2, 2), 0 where a neighbour is missing."""
    second = np.zeros((*displacement.shape, 2, 2))
    second[1:-1, :, :, 0, 0] = np.diff(displacement, 2, axis=0)
    second[:, 1:-1, :, 1, 1] = np.diff(displacement, 2, axis=1)
    second[..., 0, 1] = second[..., 1, 0] = _derivative(_derivative(displacement, 0), 1)
    return second


def _encode_jpeg(image: Image, quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return data.tobytes()
