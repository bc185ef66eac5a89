"""Marker displacements of a gel that is not ideal: lag, crosstalk, gain per marker, noisy markers, drift."""

import numpy as np
from numpy.typing import NDArray

from gelflow.gel.creep import CreepLag
from gelflow.hardware_mocks.simulated_cell.world import SensorEffects
from gelflow.sim.tasks.sensor_model import nearest_markers

Array = NDArray[np.float64]
_NEIGHBOURS = 4  # of a marker, in crosstalk


class DeviatingGel:
    """The effects on one pad.

    Parameters
    ----------
    effects: their levels
    positions: of the markers [mm], shape (markers, 2)
    seed: of gains, noisy markers, noise and the direction of the drift
    """

    def __init__(self, effects: SensorEffects, positions: Array, seed: int) -> None:
        self._effects = effects
        self._rng = rng = np.random.default_rng((seed, 0x5E5))
        count = len(positions)
        self._lag = CreepLag(effects.creep, effects.creep_time)
        self._gain = np.exp(effects.gain_spread * rng.standard_normal((count, 1)))
        self._noise = np.where(rng.random((count, 1)) < effects.noisy, effects.noise_mm, 0.0)
        direction = rng.uniform(0, 2 * np.pi)
        self._drift = effects.drift_mm / 60 * np.array([np.cos(direction), np.sin(direction)])  # [mm/s]
        self._near = nearest_markers([positions])[0][:, :_NEIGHBOURS] if effects.crosstalk else None
        self._start: float | None = None

    def apply(self, displacement: Array, stamp: float) -> Array:
        """The displacements [mm] that the sensor shows at a robot time [s], shape (markers, 2).

        Call it in order of time.
        """
        if self._effects.ideal:
            return displacement
        if self._start is None:
            self._start = stamp
        shown = self._lag.follow(displacement, stamp) if self._effects.creep else displacement
        if self._near is not None:
            shown = shown + self._effects.crosstalk * (shown[self._near].mean(axis=1) - shown)
        noise = self._noise * self._rng.standard_normal(shown.shape) if self._effects.noisy else 0.0
        return np.asarray(self._gain * shown + noise + self._drift * (stamp - self._start))
