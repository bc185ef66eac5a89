"""Tilt and lens distortion of a camera, as a mapping of the positions in its ideal image."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic.appearance import GelAppearance

Points = NDArray[np.float64]

_MAX_TILT = 30.0  # [deg]
_DISTORTION = (-0.3, 0.3)
_INVERSE_STEPS = 50  # of the fixed-point iteration, which converges linearly
_INVERSE_ERROR = 1e-3  # [px]


@dataclass(frozen=True)
class Lens:
    """A camera that views the gel's centre from `distance_mm`, tilted, through a lens with radial distortion.

    The scale at the image centre does not change. Raises UsageError for values out of range.
    """

    tilt_deg: tuple[float, float] = (0.0, 0.0)  # of the camera about the image's right and down axes [deg]
    distance_mm: float = 40.0  # of the camera from the gel's centre along the optical axis [mm]
    barrel: float = 0.0  # relative inward shift of the image corners; negative: pincushion, which moves them outwards

    def __post_init__(self) -> None:
        if not all(abs(angle) <= _MAX_TILT for angle in self.tilt_deg):
            raise UsageError(f"tilt_deg of a lens must be within ±{_MAX_TILT:g}°, got {self.tilt_deg}")
        if not 5 <= self.distance_mm <= 1e4:
            raise UsageError(f"distance_mm of a lens must be 5 to 10000 mm, got {self.distance_mm}")
        low, high = _DISTORTION
        if not low <= self.barrel <= high:
            raise UsageError(f"barrel of a lens must be within {low} to {high}, got {self.barrel}")

    @property
    def ideal(self) -> bool:
        """Whether the image is not changed."""
        return self.barrel == 0 and self.tilt_deg == (0.0, 0.0)

    def apply(self, positions: Points, appearance: GelAppearance) -> Points:
        """Image positions [px] of positions in the ideal image of `appearance` [px], shape (..., 2)."""
        middle = np.array([(appearance.width - 1) / 2, (appearance.height - 1) / 2])
        right, down = np.moveaxis((positions - middle) / appearance.pixels_per_mm, -1, 0)  # on the gel [mm]
        about_right, about_down = map(math.radians, self.tilt_deg)
        # Rotation of the gel about the image's right axis, then about its down axis; z is the optical axis.
        y, z = math.cos(about_right) * down, math.sin(about_right) * down
        cos, sin = math.cos(about_down), math.sin(about_down)
        x, z = cos * right + sin * z, cos * z - sin * right
        scale = appearance.pixels_per_mm * self.distance_mm / (self.distance_mm + z)
        at = np.stack([x * scale, y * scale], axis=-1)
        at = at * (1 - self.barrel * (at**2).sum(axis=-1, keepdims=True) / (middle**2).sum())
        return np.asarray(at + middle)

    def sources(self, appearance: GelAppearance) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """For each pixel of the image its position in the ideal image, right and down [px], shape (height, width).

        Raises UsageError when the distortion is so strong that the mapping has no inverse.
        """
        right, down = np.meshgrid(np.arange(appearance.width, dtype=float), np.arange(appearance.height, dtype=float))
        pixels = np.stack([right, down], axis=-1)
        at = pixels.copy()
        for _ in range(_INVERSE_STEPS):
            error = pixels - self.apply(at, appearance)
            if np.abs(error).max() < _INVERSE_ERROR:
                return at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
            at += error
        raise UsageError(f"{self} is too strong for an image of {appearance.width} × {appearance.height} px")
