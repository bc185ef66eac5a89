"""Search of the misalignment of each insertion with given parameters: a global search, then a local one."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.policies.calibration.ensemble import rough_problem, search_globally
from gelflow.policies.calibration.poses import costs_of_insertions, draw_poses, refined_poses
from gelflow.policies.calibration.problem import Problem

Array = NDArray[np.float64]

_EXPLAINED = 1.0  # root mean square of the whitened residuals up to which a search explains the flow maps
_SPREADS = (0.3, 0.1, 0.03)  # of the ensembles after the first one


def find_poses(
    problem: Problem,
    parameters: Array,
    rng: np.random.Generator,
    progress: Callable[[int], None] = lambda done: None,
    *,
    members: int = 64,
    count: int = 32,
    starts: int = 2,
    threads: int | None = None,
) -> tuple[Array, Array]:
    """Search poses (insertions, 3) and start heights for given whitened parameters; returns the unknowns and the poses.

    Where an insertion cannot be simulated with these parameters, its pose is drawn from the prior. `progress` gets the
    number of finished insertions. `members` are those of the first ensemble of a search, `count` the random poses at
    each size of the local search. An insertion is searched from `starts` independent starts, until one explains its
    flow maps; the best one counts.
    """
    point, poses = np.zeros(problem.size), np.zeros((problem.insertions, 3))
    point[: len(parameters)] = parameters
    rough = rough_problem(problem.recordings, threads=threads)
    rough.allow_for(drift=problem.errors.drift)
    for i in range(problem.insertions):
        found = _search(problem.of(i), rough.of(i), parameters, rng, members, count, starts)
        point[len(parameters) :][problem.recordings.insertion == i] = found[0][len(parameters) :]
        poses[i] = found[1][0]
        progress(i + 1)
    return point, poses


def better_poses(
    problem: Problem, point: Array, poses: Array, rng: np.random.Generator, *, members: int, count: int
) -> tuple[Array, Array]:
    """Repeat `find_poses`, and replace pose and start heights of the insertions whose cost becomes lower.

    Returns the point and the poses (insertions, 3). One thread is used, as in a fit.
    """
    n = len(problem.fitted)
    other, found = find_poses(problem, point[:n], rng, members=members, count=count, threads=1)
    better = costs_of_insertions(problem, other, found) < costs_of_insertions(problem, point, poses)
    heights = np.where(better[problem.recordings.insertion], other[n:], point[n:])
    return np.concatenate([point[:n], heights]), np.where(better[:, None], found, poses)


def _search(
    problem: Problem,
    rough: Problem,
    parameters: Array,
    rng: np.random.Generator,
    members: int,
    count: int,
    starts: int,
) -> tuple[Array, Array]:
    """Unknowns and pose (1, 3) of one insertion."""
    lowest = np.inf
    best = np.concatenate([parameters, np.zeros(len(problem.recordings))]), draw_poses(problem, 0, 1, rng)
    for _ in range(starts):
        try:
            start = search_globally(rough, members, rng, parameters=parameters, spreads=_SPREADS)
        except SimulationError:
            return best
        cost, *found = refined_poses(problem, *start, rng, count=count)
        if cost < lowest:
            lowest, best = cost, (found[0], found[1])
        if problem.errors.chi(problem.residuals(*best)[0]) <= _EXPLAINED:
            break
    return best
