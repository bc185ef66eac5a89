"""Viscoelastic lag of a gel: a standard linear solid.

Of the deformation x, a part c follows the force f with the time constant τ: x = (1 − c) f + c y, τ dy/dt = f − y, in
units in which x = f in the long run. The formulas are exact for forces that change linearly between samples: with the
slope r, y − f + r τ decays as exp(−t/τ).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def deformation(force: Array, stamps: Array, creep: float, time: float) -> Array:
    """x at `stamps` [s], shape (n,), of a gel at rest before the first one; `time` is τ [s]."""
    gel = CreepLag(creep, time)
    return np.array(
        [float(gel.follow(np.asarray(value), float(stamp))) for value, stamp in zip(force, stamps, strict=True)]
    )


def _delayed(force: Array, force_before: Array, delayed: Array, step: float, time: float) -> Array:
    """y after a step [s] in which the force changed linearly from `force_before` to `force`."""
    ramp = (force - force_before) * time / step
    return np.asarray(force - ramp + (delayed - force_before + ramp) * np.exp(-step / time))


class CreepLag:
    """The deformations of a gel that follow a sequence of forces."""

    def __init__(self, creep: float, time: float) -> None:
        self._creep, self._time = creep, time
        self._last: tuple[float, Array, Array] | None = None  # stamp, f, y

    def follow(self, force: Array, stamp: float) -> Array:
        """x for the force f at `stamp` [s]; the gel is at rest before the first one. Equal shapes."""
        if self._last is None:
            self._last = stamp, force, force
            return force
        before, force_before, delayed = self._last
        step = max(stamp - before, 1e-9)
        delayed = _delayed(force, force_before, delayed, step, self._time)
        self._last = stamp, force, delayed
        return np.asarray(force + self._creep * (delayed - force))


class CreepCorrection:
    """Undoes the lag of a sequence of deformations."""

    def __init__(self, creep: float, time: float) -> None:
        self._creep, self._time = creep, time
        self._last: tuple[float, Array, Array] | None = None  # stamp, f, y

    def reset(self) -> None:
        """The gel has rested: the next deformation has no lag."""
        self._last = None

    def undo(self, deformation: Array, known: NDArray[np.bool_], stamp: float) -> Array:
        """f for the deformation x at `stamp` [s]; where x is not `known`, the last f. Equal shapes."""
        if self._last is None:
            force = np.where(known, deformation, 0.0)
            self._last = stamp, force, force
            return force
        before, force_before, delayed = self._last
        step = max(stamp - before, 1e-9)
        decay = np.exp(-step / self._time)
        slope = self._time / step * (decay - 1)
        lag = self._creep * (decay * (delayed - force_before) - slope * force_before)
        force = np.where(known, (deformation - lag) / (1 + self._creep * slope), force_before)
        self._last = stamp, force, _delayed(force, force_before, delayed, step, self._time)
        return np.asarray(force)
