"""Image sequences with ground truth: a contact presses, shears, twists or slips on a gel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer, RenderedImage
from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.image_layers import Contact

Field = Literal["press", "shear", "twist", "slip"]
Motion = Literal["smooth", "jump", "rest"]
FIELDS: tuple[Field, ...] = get_args(Field)
MOTIONS: tuple[Motion, ...] = get_args(Motion)

INITIAL_REST = 3  # images at rest at the start of each sequence
_CONTACT = 0.4  # radius of the contact / shorter side of the grid
_CENTER_AMPLITUDE = 0.6  # amplitude of the motion of the contact centre / marker spacing
_SLIP_RIM = 3.0  # width of the transition zone around a slipping patch / marker spacing

Points = NDArray[np.float64]


@dataclass(frozen=True)
class GelSequence:
    """Images of a gel under a moving contact. Each iteration renders the same images.

    The first three images are at rest. Motion "smooth" then rises to the peak and returns to rest once per `period`
    images, "jump" reaches the peak within one image and stays there, "rest" stays at rest.
    """

    appearance: DegradedGelAppearance
    field: Field = "shear"
    frames: int = 64
    peak: float = 0.4  # largest marker displacement / marker spacing
    motion: Motion = "smooth"
    period: int = 60  # images per cycle of the motion "smooth"

    def __post_init__(self) -> None:
        if self.field not in FIELDS or self.motion not in MOTIONS:
            raise UsageError(
                f"field must be one of {', '.join(FIELDS)} and motion one of {', '.join(MOTIONS)}, "
                f"got {self.field!r} and {self.motion!r}"
            )
        if self.frames < 1 or self.period < 2 or not 0 <= self.peak <= 2:
            raise UsageError(
                "a sequence has at least 1 frame, a period of at least 2 and a peak of 0 to 2 spacings, "
                f"got {self.frames}, {self.period} and {self.peak}"
            )

    def __len__(self) -> int:
        return self.frames

    def __iter__(self) -> Iterator[RenderedImage]:
        renderer = AccurateGelRenderer(self.appearance)
        for number in range(self.frames):
            yield renderer.render(self.displacement(number), number=number, **self.render_arguments(number))

    def render_arguments(self, number: int) -> dict[str, Any]:
        """Contact, motion blur and occluder progress of image `number`: arguments of `AccurateGelRenderer.render`."""
        depth, radius = self._strength(number), self._radius() * self.appearance.spacing
        return {
            "contact": Contact(self._in_image(self._center(number)), radius, depth) if depth else None,
            "motion_blur": self._motion_blur(number),
            "progress": number / max(self.frames - 1, 1),
        }

    def _strength(self, number: int) -> float:
        """Amplitude of the motion, 0 to 1."""
        if self.motion == "rest" or number < INITIAL_REST:
            return 0.0
        if self.motion == "jump":
            return 1.0
        phase = (number - INITIAL_REST) % self.period / self.period
        if self.field == "slip":  # slow rise, quick release
            phase = phase**1.7
        return float(np.sin(np.pi * phase) ** 2)

    def _center(self, number: float) -> Points:
        """Centre of the contact (right, down) relative to the grid centre, in spacings."""
        turn = 2 * np.pi * number / 97 + self.appearance.seed if self.motion == "smooth" else self.appearance.seed
        return np.array([_CENTER_AMPLITUDE * np.cos(turn), _CENTER_AMPLITUDE * np.sin(2 * turn)])

    def _radius(self) -> float:
        """Radius of the contact in spacings."""
        return _CONTACT * (min(self.appearance.grid.rows, self.appearance.grid.cols) - 1)

    def _in_image(self, center: Points) -> tuple[float, float]:
        middle = np.array([(self.appearance.width - 1) / 2, (self.appearance.height - 1) / 2])
        right, down = self.appearance.warp((center * self.appearance.spacing + middle)[None])[0]
        return float(right), float(down)

    def displacement(self, number: float) -> Points:
        """Marker displacement along the pad's x and y axes in image `number` [mm], shape (markers, 2)."""
        appearance = self.appearance
        x, y = ((appearance.positions_mm() - appearance.grid.center) / appearance.grid.pitch).T
        right, down = (-y if appearance.mirrored else y), x
        at = np.stack([right, down], axis=1) - self._center(number)
        moved = self.peak * self._strength(int(number)) * _unit_field(self.field, at, self._radius(), appearance.seed)
        return np.asarray(
            np.stack([moved[:, 1], -moved[:, 0] if appearance.mirrored else moved[:, 0]], axis=1)
            * appearance.grid.pitch
        )

    def _motion_blur(self, number: int) -> Points:
        """Motion of each marker during the exposure [px], shape (markers, 2)."""
        step = self.displacement(number + 1) - self.displacement(number - 1)
        fastest = np.pi * self.peak / self.period * self.appearance.grid.pitch
        if self.motion != "smooth" or fastest == 0:
            return np.zeros_like(step)
        appearance, rest = self.appearance, self.appearance.positions_mm()
        step_px = appearance.to_pixels(rest + step) - appearance.to_pixels(rest)
        return np.asarray(appearance.motion_blur * step_px / (2 * fastest * appearance.pixels_per_mm))


def _unit_field(field: Field, at: Points, radius: float, seed: int) -> Points:
    """Displacement field of length up to 1 at positions `at` relative to the contact centre, shape (n, 2).

    `at` and `radius` have the same unit.
    """
    distance = np.linalg.norm(at, axis=1, keepdims=True) / radius
    if field in ("press", "twist"):
        # Grows from the centre to the rim of the contact, where it is 1, and decays outside.
        around = at / radius * np.exp((1 - distance**2) / 2)
        return around if field == "press" else np.stack([-around[:, 1], around[:, 0]], axis=1)
    turn = 2.4 * seed  # the golden angle [rad] spreads the directions of successive seeds
    direction = np.array([np.cos(turn), np.sin(turn)])
    if field == "shear":
        return np.asarray(np.exp(-(distance**2) / 3) * direction)
    ease = np.clip((1 - distance) * radius / _SLIP_RIM + 0.5, 0, 1)
    return np.asarray(ease**2 * (3 - 2 * ease) * direction)
