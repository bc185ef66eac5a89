"""Recorded flow maps beside those of the simulation."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.pose_search import find_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.recordings import Recordings

Array = NDArray[np.float64]

NOTHING_IN_COMMON = 0.5  # largest cosine of two flow maps that have nothing in common


@dataclass(frozen=True)
class SimulatedSession:
    """Recorded and simulated flow maps of n attempts, (n, markers, 2) each, in the unit of the recordings."""

    recorded: Array
    simulated: Array
    used: NDArray[np.bool_]  # markers that are compared (markers,)

    @property
    def error(self) -> float:
        """Root mean square difference of a component of a marker vector, over all attempts."""
        return error(self.recorded, self.simulated, self.used)

    @property
    def relative_error(self) -> Array:
        """Length of the difference of each attempt relative to that of its recorded flow map, (n,)."""
        recorded, simulated = self._compared
        return np.asarray(_length(simulated - recorded) / np.maximum(_length(recorded), 1e-30))

    @property
    def cosine(self) -> Array:
        """Cosine between recorded and simulated flow map of each attempt, (n,); 0 if there is no simulated contact."""
        recorded, simulated = self._compared
        product = _length(simulated) * _length(recorded)
        return np.asarray((simulated * recorded).sum((1, 2)) / np.maximum(product, 1e-30))

    @property
    def _compared(self) -> tuple[Array, Array]:
        """Recorded and simulated vectors of the markers that are compared."""
        return self.recorded[:, self.used], self.simulated[:, self.used]


def error(recorded: Array, simulated: Array, used: NDArray[np.bool_]) -> float:
    """Root mean square difference of a component of the marker vectors (n, markers, 2) that are compared."""
    return float(np.sqrt(((simulated - recorded)[:, used] ** 2).mean()))


def unused_markers_text(used: NDArray[np.bool_]) -> str:
    """One line about markers that are not compared; empty if all are."""
    unused = int((~used).sum())
    return (
        f"{unused} of {len(used)} markers are too noisy, or not in the images, and are not compared" if unused else ""
    )


def _length(flow: Array) -> Array:
    return np.asarray(np.sqrt((flow**2).sum((1, 2))))


def simulate(
    recordings: Recordings, *, seed: int = 0, progress: Callable[[int], None] = lambda done: None
) -> SimulatedSession:
    """Simulate the recorded attempts with the values of the scene; poses and start heights are searched.

    `progress` gets the number of finished insertions.
    """
    problem = Problem(recordings)
    point, poses = find_poses(problem, problem.scene_point(), np.random.default_rng(seed), progress)
    return SimulatedSession(problem.recorded_flow(), problem.flow(point, poses), problem.errors.used)
