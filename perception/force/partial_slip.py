"""The part of a contact that sticks, from the history of its load.

The contact is represented by parallel elements of equal area and stiffness (Iwan 1967). Each sticks up to a limit of
its own, relative to μ times the normal force, and slips at it. With the limits

    y(a) = (1 − a^((1 − β)/β)) / (1 − β),    a = area fraction from 0 to 1, mean of y = 1,

a load T that rises from 0 leaves the share (1 − T)^β in stick. Slip backwards and changes of direction follow from the
same elements.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ELEMENTS = 50
_ITERATIONS = 30
_TOLERANCE = 1e-4
_LARGEST_LOAD = 0.9999
_SLIPPING = 1e-3


class PartialSlip:
    """State of one contact; a new one begins without shear."""

    def __init__(self, exponent: float, noise: float) -> None:
        """`exponent` is β. A load that decreases by less than `noise` counts as constant."""
        area = (np.arange(_ELEMENTS) + 0.5) / _ELEMENTS
        limit = 1 - area ** ((1 - exponent) / exponent)
        self._limit = limit / limit.mean()
        self._noise = noise
        self._load = np.zeros(3)
        self._force = np.zeros((_ELEMENTS, 3))

    def follow(self, load: Array) -> float:
        """The share that sticks under `load`, shape (3,): shear and moment relative to those of gross slip."""
        change = load - self._load
        if change @ self._load < 0:
            change = change * max(0.0, 1 - self._noise / float(np.linalg.norm(change)))
        self._load = load = self._load + change
        wanted = load * min(1.0, _LARGEST_LOAD / max(float(np.linalg.norm(load)), 1e-12))
        motion = np.zeros(3)
        for _ in range(_ITERATIONS):
            trial = self._force + motion
            length = np.maximum(np.linalg.norm(trial, axis=1), 1e-12)
            part = np.minimum(1.0, self._limit / length)
            residual = wanted - (part[:, None] * trial).mean(0)
            if float(np.abs(residual).max()) < _TOLERANCE:
                break
            # A slipping element resists only across its force.
            slips = np.where(part < 1, part, 0.0) / _ELEMENTS
            along = trial / length[:, None]
            stiffness = part.mean() * np.eye(3) - (slips[:, None] * along).T @ along
            step = np.linalg.solve(stiffness + 1e-4 * np.eye(3), residual)
            motion = motion + step * min(1.0, 0.5 / max(float(np.linalg.norm(step)), 1e-12))
        trial = self._force + motion
        length = np.maximum(np.linalg.norm(trial, axis=1), 1e-12)
        self._force = trial * np.minimum(1.0, self._limit / length)[:, None]
        return float(np.mean(np.minimum(length, self._limit) < (1 - _SLIPPING) * self._limit))
