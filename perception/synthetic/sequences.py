"""Image sequences with ground truth: a contact presses, shears, twists or slips on a gel."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer, Frame
from gelflow.perception.synthetic.appearance import DegradedGelAppearance
from gelflow.perception.synthetic.image_layers import Contact

Field = Literal["press", "shear", "twist", "slip"]
Motion = Literal["smooth", "jump", "rest"]
FIELDS: tuple[Field, ...] = get_args(Field)
MOTIONS: tuple[Motion, ...] = get_args(Motion)

REST = 3  # images of every sequence before anything moves
_CONTACT = 0.4  # radius of the contact, as a share of the grid's shorter side
_WANDER = 0.6  # how far the contact's centre moves about, in spacings
_SLIP_RIM = 3.0  # width in spacings over which a slipping patch drags the gel along

Points = NDArray[np.float64]


@dataclass(frozen=True)
class GelSequence:
    """Images of a gel under a moving contact, drawn one by one; iterating again gives the same ones.

    It starts at rest for three images. "smooth" then goes up to the peak and back to rest once every `period` images;
    "jump" is at the peak from one image to the next and stays there; "rest" stays at rest.
    """

    appearance: DegradedGelAppearance
    field: Field = "shear"
    frames: int = 64
    peak: float = 0.4  # largest displacement of the gel, as a share of the spacing
    motion: Motion = "smooth"
    period: int = 60  # images of one "smooth" motion

    def __post_init__(self) -> None:
        if self.field not in FIELDS or self.motion not in MOTIONS:
            raise UsageError(
                f"expected a field out of {', '.join(FIELDS)} and a motion out of {', '.join(MOTIONS)}, "
                f"got {self.field!r} and {self.motion!r}"
            )
        if self.frames < 1 or self.period < 2 or not 0 <= self.peak <= 2:
            raise UsageError(
                "a sequence has at least 1 frame, a period of at least 2 and a peak of 0 to 2 spacings, "
                f"got {self.frames}, {self.period} and {self.peak}"
            )

    def __len__(self) -> int:
        return self.frames

    def __iter__(self) -> Iterator[Frame]:
        renderer = AccurateGelRenderer(self.appearance)
        for number in range(self.frames):
            yield renderer.render(self.displacement(number), number=number, **self.surroundings(number))

    def surroundings(self, number: int) -> dict[str, Any]:
        """Contact, motion blur and occluder progress of image `number`: arguments of `AccurateGelRenderer.expose`."""
        depth, radius = self._strength(number), self._radius() * self.appearance.spacing
        return {
            "contact": Contact(self._in_image(self._center(number)), radius, depth) if depth else None,
            "smear": self._smear(number),
            "progress": number / max(self.frames - 1, 1),
        }

    def _strength(self, number: int) -> float:
        """Of the motion, 0 to 1."""
        if self.motion == "rest" or number < REST:
            return 0.0
        if self.motion == "jump":
            return 1.0
        phase = (number - REST) % self.period / self.period
        if self.field == "slip":  # rises slowly, comes loose quickly
            phase = phase**1.7
        return float(np.sin(np.pi * phase) ** 2)

    def _center(self, number: float) -> Points:
        """Of the contact, from the grid's middle in spacings (right, down)."""
        turn = 2 * np.pi * number / 97 + self.appearance.seed if self.motion == "smooth" else self.appearance.seed
        return np.array([_WANDER * np.cos(turn), _WANDER * np.sin(2 * turn)])

    def _radius(self) -> float:
        """Of the contact in spacings."""
        return _CONTACT * (min(self.appearance.grid.rows, self.appearance.grid.cols) - 1)

    def _in_image(self, center: Points) -> tuple[float, float]:
        middle = np.array([(self.appearance.width - 1) / 2, (self.appearance.height - 1) / 2])
        right, down = self.appearance.warp((center * self.appearance.spacing + middle)[None])[0]
        return float(right), float(down)

    def displacement(self, number: float) -> Points:
        """Of the markers along the pad's x and y [mm], shape (markers, 2)."""
        appearance = self.appearance
        x, y = ((appearance.positions_mm() - appearance.grid.center) / appearance.grid.pitch).T
        right, down = (-y if appearance.mirrored else y), x
        at = np.stack([right, down], axis=1) - self._center(number)
        moved = self.peak * self._strength(int(number)) * _unit_field(self.field, at, self._radius(), appearance.seed)
        return np.asarray(
            np.stack([moved[:, 1], -moved[:, 0] if appearance.mirrored else moved[:, 0]], axis=1)
            * appearance.grid.pitch
        )

    def _smear(self, number: int) -> Points:
        """Way of each marker during the exposure [px], shape (markers, 2)."""
        step = self.displacement(number + 1) - self.displacement(number - 1)
        fastest = np.pi * self.peak / self.period * self.appearance.grid.pitch
        if self.motion != "smooth" or fastest == 0:
            return np.zeros_like(step)
        plain = self.appearance.to_pixels(self.appearance.positions_mm() + step) - self.appearance.to_pixels(
            self.appearance.positions_mm()
        )
        return np.asarray(self.appearance.motion_blur * plain / (2 * fastest * self.appearance.pixels_per_mm))


def _unit_field(field: Field, at: Points, radius: float, seed: int) -> Points:
    """Displacement at places around the contact's centre, at most 1 long; `at` and `radius` in the same unit."""
    far = np.linalg.norm(at, axis=1, keepdims=True) / radius
    if field in ("press", "twist"):
        # Grows from the middle to the contact's rim, where it is 1, and dies away outside.
        around = at / radius * np.exp((1 - far**2) / 2)
        return around if field == "press" else np.stack([-around[:, 1], around[:, 0]], axis=1)
    turn = 2.4 * seed  # the golden angle: other seeds go elsewhere
    way = np.array([np.cos(turn), np.sin(turn)])
    if field == "shear":
        return np.asarray(np.exp(-(far**2) / 3) * way)
    ease = np.clip((1 - far) * radius / _SLIP_RIM + 0.5, 0, 1)
    return np.asarray(ease**2 * (3 - 2 * ease) * way)
