"""Search of the misalignment of each insertion with given parameters: a global search, then a local one."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.ensemble import rough_problem, search_globally
from gelflow.policies.calibration.poses import refined_poses
from gelflow.policies.calibration.problem import Problem

Array = NDArray[np.float64]

_STARTS = 2  # independent searches of an insertion, until one explains the flow maps; the best one counts
_EXPLAINED = 1.0  # root mean square of the whitened residuals up to which a search explains the flow maps
_MEMBERS = 64  # of the first ensemble
_SPREADS = (0.3, 0.1, 0.03)  # of the ensembles after it
_SIZES = (0.1, 0.05, 0.025, 0.012)  # of the local search
_POSES = 32  # random poses at each of these sizes


def find_poses(
    problem: Problem,
    parameters: Array,
    rng: np.random.Generator,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Array, Array]:
    """Poses (insertions, 3) and start heights for given whitened parameters; returns the unknowns, then the poses.

    `progress` gets the number of finished insertions.
    """
    point, poses = np.zeros(problem.size), np.zeros((problem.insertions, 3))
    point[: len(parameters)] = parameters
    rough = rough_problem(problem.recordings)
    for i in range(problem.insertions):
        found = _search(problem.of(i), rough.of(i), parameters, rng)
        point[len(parameters) :][problem.recordings.insertion == i] = found[0][len(parameters) :]
        poses[i] = found[1][0]
        progress(i + 1)
    return point, poses


def _search(problem: Problem, rough: Problem, parameters: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Unknowns and pose (1, 3) of one insertion."""
    best: tuple[float, Array, Array] | None = None
    for _ in range(_STARTS):
        start = search_globally(rough, _MEMBERS, rng, parameters=parameters, spreads=_SPREADS)
        found = refined_poses(problem, *start, rng, sizes=_SIZES, count=_POSES)
        if best is None or found[0] < best[0]:
            best = found
        if problem.chi(problem.residuals(*best[1:])[0]) <= _EXPLAINED:
            break
    assert best is not None
    return best[1:]
