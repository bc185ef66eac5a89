"""Parameters of synthetic gel images, and the image classes that tests and benchmarks use.

`make_appearance("typical", blur=2.5)` is the class "typical" with one parameter changed.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid

GELSLIM_GRID = Grid(rows=18, cols=14, pitch=1.4, center=(2.0, 0.0))  # printed markers on the pad [mm]

_RADIUS = 0.18  # dot radius / marker spacing
_MARGIN = 1.0  # distance from the outer markers to the image border / marker spacing
_PITCH = 1.4  # marker spacing [mm]

# Parameter → (smallest, largest value)
_GEL_LIMITS: dict[str, tuple[float, float]] = {
    "pixels_per_mm": (0.1, 1000.0),
    "radius": (0.5, 100.0),
    "contrast": (0.0, 1.0),
    "blur": (0.1, 20.0),
    "noise": (0.0, 40.0),
    "light": (1.0, 255.0),
    "colour": (0.0, 1.0),
    "missing": (0.0, 1.0),
    "quality": (1, 100),
}
_DEGRADATION_LIMITS: dict[str, tuple[float, float]] = {
    "gradient": (0.0, 0.9),
    "shading": (0.0, 1.0),
    "ridges": (0.0, 1.0),
    "highlights": (0, 20),
    "shot": (0.0, 1.0),
    "damaged": (0.0, 1.0),
    "bridges": (0, 1000),
    "dust": (0, 1000),
    "occluders": (0, 20),
    "motion_blur": (0.0, 20.0),
    "keystone": (0.0, 0.5),
    "barrel": (0.0, 0.2),
    "oval": (1.0, 3.0),
    "radius_spread": (0.0, 0.2),
    "ragged": (0.0, 0.2),
    "print_offset": (0.0, 0.1),
    "blur": (0.5, 20.0),  # an edge sharper than a pixel has no exact centre
}


@dataclass(frozen=True)
class GelAppearance:
    """Parameters of the image of an undamaged gel. The defaults follow published images of a GelSlim 3.0."""

    grid: Grid = GELSLIM_GRID
    width: int = 320  # of the image [px]
    height: int = 427  # of the image [px]
    pixels_per_mm: float = 15.7
    rotation: Literal[0, 90, 180, 270] = 0  # clockwise [deg]; at 0 the fingertip is at the bottom of the image
    mirrored: bool = True  # the camera views the gel from behind
    radius: float = 4.4  # of a dot [px]
    contrast: float = 0.62  # 1 − (dot brightness) / (gel brightness), 0 to 1
    blur: float = 1.0  # standard deviation of the optical blur [px]
    noise: float = 1.2  # standard deviation of the sensor noise [grey levels]
    light: float = 125.0  # mean brightness of the gel [grey levels]
    colour: float = 0.35  # strength of the coloured illumination gradients, 0 (uniform grey) to 1
    missing: float = 0.0  # fraction of the markers that are not printed, 0 to 1
    bright: bool = False  # dots are brighter than the gel
    quality: int = 88  # JPEG quality, 1 to 100
    seed: int = 0  # of the random illumination, print and noise

    def __post_init__(self) -> None:
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096):
            raise UsageError(f"a gel image is 16 to 4096 px wide and high, got {self.width} × {self.height}")
        if self.rotation not in (0, 90, 180, 270):
            raise UsageError(f"rotation must be 0, 90, 180 or 270 degrees, got {self.rotation}")
        self._check_limits(_GEL_LIMITS)

    def _check_limits(self, limits: dict[str, tuple[float, float]]) -> None:
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"{name} of a gel appearance must be within {low} to {high}, got {value}")

    def positions_mm(self) -> NDArray[np.float64]:
        """Marker positions at rest in the pad frame (x base to tip, y = z × x) [mm], shape (markers, 2), row by row."""
        return self.grid.positions()

    def to_pixels(self, positions_mm: ArrayLike) -> NDArray[np.float64]:
        """Image positions (right, down) [px] of pad positions [mm], both of shape (n, 2)."""
        offset = np.asarray(positions_mm, dtype=float) - self.grid.center
        # Viewed from outside with the tip at the bottom, x points down and y right; from behind, y points left.
        right, down = (-offset[:, 1] if self.mirrored else offset[:, 1]), offset[:, 0]
        for _ in range(self.rotation // 90):
            right, down = -down, right
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.stack([right, down], axis=1) * self.pixels_per_mm + middle


@dataclass(frozen=True)
class DegradedGelAppearance(GelAppearance):
    """Parameters of a gel with imperfect print, illumination, lens and contact; the defaults add no imperfection.

    `missing`, `damaged`, `bridges`, `radius_spread`, `ragged` and `print_offset` belong to the print and move with the
    gel; illumination, `dust` and `occluders` are fixed to the camera; `shading`, `ridges` and `highlights` move with
    the contact. `noise` is the noise of the grey image.
    """

    gradient: float = 0.0  # relative brightness difference from the mean at opposite borders, 0 to 0.9
    shading: float = 0.0  # strength of the shading by the slopes of a contact, 0 to 1
    ridges: float = 0.0  # strength of specular wrinkles inside a contact and of the highlight along its rim, 0 to 1
    highlights: int = 0  # saturated reflections inside a contact, about as large as a dot
    shot: float = 0.0  # variance of the shot noise per grey level [grey levels], 0 to 1
    damaged: float = 0.0  # fraction of the markers that are cut, scratched, worn or have a hole, 0 to 1
    bridges: int = 0  # pairs of neighbouring dots that are joined by ink
    dust: int = 0  # dark specks on the lens
    occluders: int = 0  # opaque blobs that cross the image between the first and the last image of a sequence
    motion_blur: float = 0.0  # motion blur length of the fastest dot of a sequence [px]
    keystone: float = 0.0  # 1 − (scale at the bottom) / (scale at the top of the image), 0 to 0.5
    barrel: float = 0.0  # relative inward shift of the image corners by barrel distortion, 0 to 0.2
    oval: float = 1.0  # width / height of a dot, 1 to 3
    radius_spread: float = 0.0  # standard deviation of the dots' radii / `radius`, 0 to 0.2
    ragged: float = 0.0  # standard deviation of a dot's outline from its ellipse / radius, 0 to 0.2
    print_offset: float = 0.0  # standard deviation of a dot from the grid along each axis / marker spacing, 0 to 0.1
    cut_row: bool = False  # adds a row of dots above the first, cut by the image border; its dots are no markers

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_limits(_DEGRADATION_LIMITS)
        if min(self.grid.rows, self.grid.cols) < 2:
            raise UsageError(
                f"a degraded gel appearance needs at least 2 × 2 markers, got {self.grid.rows} × {self.grid.cols}"
            )

    def warp(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Applies keystone and lens distortion to positions in the undistorted image [px], shape (..., 2)."""
        middle = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        at = positions - middle
        narrowing = self.keystone / (2 - self.keystone)  # (1 - narrowing) / (1 + narrowing) = bottom / top scale
        at = at * (1 - narrowing) / (1 + narrowing * at[..., 1:] / middle[1])
        corner = (middle**2).sum()
        at = at * (1 - self.barrel * (at**2).sum(axis=-1, keepdims=True) / corner)
        return np.asarray(at + middle)

    @property
    def spacing(self) -> float:
        """Marker spacing at the centre of the undistorted image [px]."""
        return self.grid.pitch * self.pixels_per_mm


# Parameters of each image class. With `colour` 0.55 the channels differ by ±30 % at opposite borders.
PRESETS: dict[str, dict[str, Any]] = {
    "clean": {"blur": 0.8, "noise": 1.0, "colour": 0.0, "quality": 100},
    "typical": {
        **{"blur": 1.0, "noise": 1.5, "shot": 0.02, "quality": 90, "gradient": 0.3, "colour": 0.55},
        **{"shading": 0.35, "barrel": 0.02, "dust": 2, "radius_spread": 0.03, "ragged": 0.03},
        "print_offset": 0.005,
    },
    "hard": {
        **{"blur": 1.4, "noise": 2.5, "shot": 0.02, "quality": 75, "gradient": 0.45, "colour": 0.8},
        **{"shading": 0.7, "ridges": 0.5, "barrel": 0.02, "dust": 2, "contrast": 0.6, "missing": 0.03},
        **{"damaged": 0.06, "bridges": 2, "occluders": 1, "motion_blur": 0.5},
        **{"radius_spread": 0.05, "ragged": 0.04, "print_offset": 0.005},
    },
    # The most uneven of ten published prints: a hand-made one.
    "print": {
        **{"blur": 1.0, "noise": 1.5, "shot": 0.02, "quality": 90, "gradient": 0.3, "colour": 0.55},
        **{"shading": 0.35, "barrel": 0.02, "dust": 2, "radius_spread": 0.095, "ragged": 0.06},
        "print_offset": 0.01,
    },
}

# Changes of one parameter of the class "typical".
FACTORS: dict[str, dict[str, Any]] = {
    "noise 6": {"noise": 6.0},
    "blur 2.5 px": {"blur": 2.5},
    "JPEG 40": {"quality": 40},
    "5 % missing": {"missing": 0.05},
    "15 % damaged": {"damaged": 0.15},
    "four bridges": {"bridges": 4},
    "two occluders": {"occluders": 2},
    "contrast 0.3": {"contrast": 0.3},
    "keystone 15 %": {"keystone": 0.15},
    "oval 1.8:1": {"oval": 1.8},
    "bright dots": {"bright": True},
    "two highlights": {"highlights": 2},
    "cut row": {"cut_row": True},
    "uneven dots": {"radius_spread": 0.06, "ragged": 0.04},
    "radii 12 %": {"radius_spread": 0.12, "ragged": 0.04},
}

# Number of markers → (rows, columns)
SIZES: dict[int, tuple[int, int]] = {35: (5, 7), 63: (7, 9), 130: (10, 13), 154: (11, 14), 252: (14, 18)}


def make_appearance(
    preset: str = "typical",
    *,
    markers: int = 130,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    **changed: Any,
) -> DegradedGelAppearance:
    """The appearance of an image class.

    Parameters
    ----------
    preset: image class, a key of `PRESETS`
    markers: number of markers, a key of `SIZES`; the grid fills the image, markers run row by row from the top left
    width, height: image size [px]
    seed: seed of the random illumination, print and noise
    changed: fields of `DegradedGelAppearance` that replace those of the image class

    Raises UsageError for unknown names and values out of range.
    """
    if preset not in PRESETS:
        raise UsageError(f"image class must be one of {', '.join(PRESETS)}, got {preset!r}")
    if markers not in SIZES:
        raise UsageError(f"markers must be one of {', '.join(map(str, SIZES))}, got {markers}")
    known = {field.name for field in dataclasses.fields(DegradedGelAppearance)}
    for name in changed:
        if name not in known:
            raise UsageError(f"a gel appearance has no field {name!r}; fields are {', '.join(sorted(known))}")
    rows, cols = SIZES[markers]
    spacing = min(height / (rows - 1 + 2 * _MARGIN), width / (cols - 1 + 2 * _MARGIN))
    print_ = {"grid": Grid(rows, cols, _PITCH), "pixels_per_mm": spacing / _PITCH, "radius": _RADIUS * spacing}
    camera = {"width": width, "height": height, "mirrored": False, "light": 115.0, "seed": seed}
    return DegradedGelAppearance(**{**print_, **camera, **PRESETS[preset], **changed})
