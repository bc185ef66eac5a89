"""Deviations of real pads from the marker forces of the simulation: lag, crosstalk, defective markers, gain, drift.

The levels of all effects are quantities of a task's randomization table (`SENSOR_QUANTITIES`). Effects with level 0
cost no time and use no random numbers.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotated
from gelflow.sim.tasks.randomization import Fixed, LogUniform, Quantity, Uniform

Array = NDArray[np.float64]

# Quantities of the sensor model with the ranges of real pads. Gels: silicone elastomers creep by some percent within a
# second. Markers: up to one in twenty is not found or is tracked badly.
SENSOR_QUANTITIES: Mapping[str, Quantity] = {
    "noise": Quantity(LogUniform(1e-5, 1e-3), "N", "standard deviation of a marker's force"),
    "gel_creep": Quantity(Uniform(0.0, 0.3), "", "part of the gel's deformation that follows the force with a lag"),
    "gel_time": Quantity(LogUniform(0.02, 0.5), "s", "time constant of this lag"),
    "crosstalk": Quantity(Uniform(0.0, 0.3), "", "part of a marker's motion that is the mean of its neighbours"),
    "dead_markers": Quantity(Uniform(0.0, 0.05), "", "part of the markers that are not found"),
    "noisy_markers": Quantity(Uniform(0.0, 0.05), "", "part of the markers with ten times the noise"),
    "pad_gain": Quantity(Uniform(0.0, 0.1), "", "standard deviation of the logarithm of a pad's gain"),
    "pad_turn": Quantity(Uniform(0.0, 0.05), "rad", "standard deviation of a camera's rotation relative to its pad"),
    "pad_drift": Quantity(Uniform(0.0, 1e-3), "N", "standard deviation of a common shift of a pad, per reading"),
}
# Known differences between the two pads of a gripper, as a calibration finds them.
PAIR_QUANTITIES: Mapping[str, Quantity] = {
    "gain_ratio": Quantity(Fixed(1.0), "", "gain of the right pad relative to that of the left one"),
    "turn_left": Quantity(Fixed(0.0), "rad", "rotation of the left camera relative to its pad"),
    "turn_right": Quantity(Fixed(0.0), "rad", "rotation of the right camera relative to its pad"),
}
NO_SENSOR_EFFECTS: Mapping[str, Quantity] = {
    name: Quantity(Fixed(0.1 if name == "gel_time" else 0.0), row.unit, row.meaning)
    for name, row in SENSOR_QUANTITIES.items()
}

_NEIGHBOURS = 4  # of a marker, in crosstalk
_SUBSTITUTES = 6  # nearest found markers that replace one that is not found, as `gelflow.observation.fill_invalid`
_CANDIDATES = 16  # nearest markers among which the substitutes are searched
_NOISY = 10.0  # factor of the noise of a noisy marker


class SensorModel:
    """Readings of the pads of N environments, with the effects of real pads.

    Parameters
    ----------
    positions: marker positions of each pad, (markers, 2) or (markers, 3), in one unit of length
    num_envs: number of environments N

    `gain` and `turn` (N, pads) are the present factors and camera rotations [rad] of the pads.
    """

    def __init__(self, positions: Sequence[Array], num_envs: int) -> None:
        self._sizes = [len(pad) for pad in positions]
        total, pads = sum(self._sizes), len(positions)
        self._pad_of = np.repeat(np.arange(pads), self._sizes)
        self._positions = positions
        self._level = {name: np.zeros(num_envs) for name in SENSOR_QUANTITIES}
        self.gain = np.ones((num_envs, pads))
        self.turn = np.zeros((num_envs, pads))
        self._found = np.ones((num_envs, total), dtype=bool)
        self._noise_factor = np.ones((num_envs, total))
        self._input: Array | None = None  # forces of the last reading, (N, markers, k)
        self._delayed: Array | None = None  # delayed part of the gel's deformation, as a force
        self._at_rest = np.ones(num_envs, dtype=bool)  # no reading since `clear`

    @cached_property
    def _neighbours(self) -> tuple[NDArray[np.int64], Array]:
        """Nearest markers of each marker and their inverse distances; computed when an effect needs them."""
        return nearest_markers(self._positions)

    @property
    def ideal(self) -> bool:
        """True while no environment has an effect: readings are the marker forces."""
        effects = any(level.any() for name, level in self._level.items() if name != "gel_time")
        return not effects and bool((self.gain == 1).all()) and not self.turn.any()

    def draw(self, which: NDArray[np.bool_], sampled: Mapping[str, Array], rng: np.random.Generator) -> None:
        """New pads in the environments `which`.

        `sampled` has the levels of all effects, (n,) each, and may have `PAIR_QUANTITIES` of two pads.

        Raises UsageError for a negative or missing level, before anything is changed.
        """
        for name in self._level:
            if name not in sampled:
                raise UsageError(f"randomization: the quantity {name!r} is missing")
            if (np.asarray(sampled[name]) < 0).any():
                raise UsageError(f"randomization: {name} must not be negative, got {np.min(sampled[name]):g}")
        for name, level in self._level.items():
            level[which] = sampled[name]
        count, pads, total = int(which.sum()), self.gain.shape[1], len(self._pad_of)

        def spread(name: str, size: int) -> Array:
            level = sampled[name]
            return level[:, None] * rng.standard_normal((count, size)) if level.any() else np.zeros((count, size))

        def chosen(name: str) -> NDArray[np.bool_]:
            level = sampled[name]
            return rng.random((count, total)) < level[:, None] if level.any() else np.zeros((count, total), dtype=bool)

        self.gain[which] = np.exp(spread("pad_gain", pads))
        self.turn[which] = spread("pad_turn", pads)
        if "gain_ratio" in sampled:
            root = np.sqrt(sampled["gain_ratio"])[:, None]
            self.gain[which] *= np.hstack([1 / root, root])
            self.turn[which] += np.column_stack([sampled["turn_left"], sampled["turn_right"]])
        self._found[which] = ~chosen("dead_markers")
        self._noise_factor[which] = np.where(chosen("noisy_markers"), _NOISY, 1.0)
        self.clear(which)

    def clear(self, which: NDArray[np.bool_]) -> None:
        """Long rest of the gels of the environments `which`: their next reading has no lag."""
        self._at_rest[which] = True

    def copy(self, rows: NDArray[np.int64], other: "SensorModel", other_rows: NDArray[np.int64]) -> None:
        """Copy the pads of `other_rows` of another model to `rows`, with gels at rest."""
        for name, level in self._level.items():
            level[rows] = other._level[name][other_rows]
        for name in ("gain", "turn", "_found", "_noise_factor"):
            getattr(self, name)[rows] = getattr(other, name)[other_rows]
        self._at_rest[rows] = True

    def read(self, forces: Array, which: NDArray[np.bool_], rng: np.random.Generator, *, interval: float) -> Array:
        """Reading of the pads in the environments `which`.

        Parameters
        ----------
        forces: marker forces (n, markers, k) of these environments [N]; components 0 and 1 are shear x and y
        interval: time since the last reading [s], during which the forces changed linearly

        Returns a new array of the shape of `forces`.
        """
        rows = np.flatnonzero(which)
        reading = np.array(forces, dtype=float)
        if self._level["gel_creep"][rows].any():
            reading = self._lag(reading, rows, interval)
        if (crosstalk := self._level["crosstalk"][rows]).any():
            near = reading[:, self._neighbours[0][:, :_NEIGHBOURS]].mean(2)
            reading += crosstalk[:, None, None] * (near - reading)
        if not (self.gain[rows] == 1).all() or self.turn[rows].any():
            reading = self._transformed(reading, rows)
        if (drift := self._level["pad_drift"][rows]).any():
            shift = rng.standard_normal((len(rows), len(self._sizes), 2))
            reading[..., :2] += (drift[:, None, None] * shift)[:, self._pad_of]
        if (noise := self._level["noise"][rows]).any():
            level = noise[:, None] * self._noise_factor[rows]
            reading += level[..., None] * rng.standard_normal(reading.shape)
        return self._with_dead_filled(reading, rows)

    def _lag(self, forces: Array, rows: NDArray[np.int64], interval: float) -> Array:
        """The gel as a standard linear solid: force f, delayed part y with τ ẏ = f − y, deformation (1 − c) f + c y.

        Exact for forces that change linearly between readings: with the slope r, y(t) − f(t) + r τ decays as e^(−t/τ).
        """
        if self._input is None or self._input.shape[1:] != forces.shape[1:]:
            self._input = np.zeros((len(self._at_rest), *forces.shape[1:]))
            self._delayed = np.zeros_like(self._input)
            self._at_rest[:] = True
        assert self._delayed is not None
        rest = self._at_rest[rows]
        before, delayed = self._input[rows], self._delayed[rows]
        before[rest] = delayed[rest] = forces[rest]
        tau = self._level["gel_time"][rows, None, None]
        ramp = (forces - before) * (tau / interval) if interval > 0 else np.zeros_like(forces)
        decay = np.exp(-interval / np.maximum(tau, 1e-12))  # without a delay all of it has decayed
        delayed = forces - ramp + (delayed - before + ramp) * decay
        self._input[rows], self._delayed[rows] = forces, delayed
        self._at_rest[rows] = False
        creep = self._level["gel_creep"][rows, None, None]
        return forces + creep * (delayed - forces)

    def _transformed(self, reading: Array, rows: NDArray[np.int64]) -> Array:
        """The reading with each pad's gain and the rotation of its camera."""
        scaled = reading * self.gain[rows][:, self._pad_of, None]
        turn = self.turn[rows][:, self._pad_of]
        scaled[..., :2] = rotated(scaled[..., :2], turn)
        return scaled

    def _with_dead_filled(self, reading: Array, rows: NDArray[np.int64]) -> Array:
        """Markers that are not found replaced by the inverse-distance mean of the nearest found ones."""
        env, marker = np.nonzero(~self._found[rows])
        if not len(env):
            return reading
        nearest, closeness = self._neighbours
        near = nearest[marker]
        found = self._found[rows[env][:, None], near]
        found &= found.cumsum(1) <= _SUBSTITUTES
        weight = closeness[marker] * found
        total = weight.sum(1)
        mean = np.einsum("dc,dck->dk", weight, reading[env[:, None], near]) / np.where(total > 0, total, 1)[:, None]
        reading[env, marker] = mean
        return reading


def nearest_markers(positions: Sequence[Array]) -> tuple[NDArray[np.int64], Array]:
    """Nearest markers of each marker on its own pad, by distance: indices and inverse distances, (markers, candidates).

    A pad with fewer markers repeats its last one, with inverse distance 0.
    """
    indices, inverse, first = [], [], 0
    for pad in positions:
        distance = np.linalg.norm(pad[:, None] - pad[None], axis=-1)
        np.fill_diagonal(distance, np.inf)
        order = np.argsort(distance, axis=1, kind="stable")[:, : min(_CANDIDATES, max(len(pad) - 1, 1))]
        near = 1 / np.maximum(np.take_along_axis(distance, order, axis=1), 1e-12)
        missing = _CANDIDATES - order.shape[1]
        indices.append(first + np.pad(order, ((0, 0), (0, missing)), mode="edge"))
        inverse.append(np.pad(near, ((0, 0), (0, missing))))
        first += len(pad)
    return np.concatenate(indices), np.concatenate(inverse)
