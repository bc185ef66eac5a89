"""Global search of a fit: ensemble Kalman inversion of parameters, start heights and poses together.

Each member is a guess of all unknowns with simulated flow maps of its own. Covariances over the ensemble take the place
of derivatives: where contact points cross edges of the hole, forces jump with a pose, and the spread of the ensemble
smooths the jumps. An ensemble takes the recordings into account in parts, each as large as the present residuals allow
(Iglesias and Yang, Adaptive regularisation for ensemble Kalman inversion, Inverse Problems 37, 2021). The first one is
drawn from the prior, the later ones around the best member so far.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.policies.calibration.model.fidelity import ROUGH
from gelflow.policies.calibration.model.parameters import FARTHEST
from gelflow.policies.calibration.poses import INSERTED_POSE_SPREAD, draw_poses, prior_cost_of_all
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.recordings import Recordings

Array = NDArray[np.float64]

_ROUNDS = 20  # of one ensemble, at most
_LATER_ROUNDS = 10
_SPREADS = (0.5, 0.3)  # of the ensembles around the best member, relative to the prior
_FIRST = 1.7  # largest initial value of a whitened parameter
_FACTORS = (1.0, 1 / 4, 1 / 16, 1 / 64)  # of the share of an update: each is tried where the one before went too far
_MODEL_ERROR = 0.04  # that residuals allow for, relative to the flow maps


def rough_problem(recordings: Recordings, *, threads: int | None = None) -> Problem:
    """The problem of a global search, in the rough simulation.

    Most of its flow maps differ by less than the error that is allowed for. The few guesses that need many iterations
    would take most of the time, so they fail, until more than half of an ensemble need them.
    """
    problem = Problem(recordings, threads=threads, fidelity=ROUGH)
    problem.allow_for(model_error=_MODEL_ERROR)
    return problem


def search_globally(
    problem: Problem,
    members: int,
    rng: np.random.Generator,
    *,
    parameters: Array | None = None,
    spreads: Sequence[float] = _SPREADS,
) -> tuple[Array, Array]:
    """Unknowns and poses (insertions, 3) of the best of all members.

    `parameters` are whitened and stay fixed; None: they are unknown. `spreads`: of the ensembles after the first one,
    relative to the prior. Raises SimulationError when the recorded descents cannot be simulated with three quarters of
    the members.
    """
    count, insertions = len(problem.fitted), problem.insertions
    points = rng.normal(size=(members, problem.size))
    points[:, :count] = np.clip(points[:, :count], -_FIRST, _FIRST) if parameters is None else parameters
    poses = np.stack([draw_poses(problem, i, members, rng) for i in range(insertions)], axis=1)
    found = _invert(problem, points, poses, _ROUNDS, rng)
    for spread in spreads:
        found = search_nearby(problem, *found, spread, 2 * members // 3, rng, fixed=parameters is not None)
    return found


def search_nearby(
    problem: Problem,
    point: Array,
    poses: Array,
    spread: float,
    members: int,
    rng: np.random.Generator,
    *,
    fixed: bool = False,
) -> tuple[Array, Array]:
    """Unknowns and poses of the best member of an ensemble around `point` and `poses`, which are one of its members.

    `spread` is relative to the prior. With `fixed` all members have the parameters of `point`.
    """
    points = point + spread * rng.normal(size=(members, problem.size))
    if fixed:
        points[:, : len(problem.fitted)] = point[: len(problem.fitted)]
    members_poses = poses + spread * INSERTED_POSE_SPREAD * rng.normal(size=(members, *poses.shape))
    points[0], members_poses[0] = point, poses
    return _invert(problem, points, members_poses, _LATER_ROUNDS, rng)


@dataclass(frozen=True)
class _Ensemble:
    """Guesses of the unknowns (members, size) and poses (members, insertions, 3), and what they predict."""

    points: Array
    poses: Array
    residuals: Array  # (members, data); their half squares add up to the robust cost
    ok: NDArray[np.bool_]  # which members could be simulated, (members,)

    @property
    def most_fail(self) -> bool:
        """Whether half of the members or more could not be simulated."""
        return int(self.ok.sum()) <= len(self.ok) // 2

    def without_failed(self, rng: np.random.Generator) -> "_Ensemble":
        """The ensemble with random other members in the place of those that could not be simulated."""
        members = len(self.ok)
        kept = np.where(self.ok, np.arange(members), rng.choice(np.flatnonzero(self.ok), members))
        return _Ensemble(self.points[kept], self.poses[kept], self.residuals[kept], self.ok[kept])


def _invert(
    problem: Problem, points: Array, poses: Array, rounds: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Unknowns and poses of the best member of all rounds."""
    lowest, best = np.inf, (points[0], poses[0])
    ensemble = _without_limit(problem, _simulated(problem, points, poses))
    left = 1.0  # share of the recordings that is not yet taken into account
    for number in range(rounds):
        if ensemble.ok.sum() <= len(points) // 4:
            raise SimulationError("the recorded descents cannot be simulated with most guesses of the parameters")
        costs = np.where(ensemble.ok, _costs(problem, ensemble), np.inf)
        k = int(costs.argmin())
        if costs[k] < lowest:
            lowest, best = float(costs[k]), (ensemble.points[k], ensemble.poses[k])
        if left <= 0 or number == rounds - 1:
            break
        ensemble = ensemble.without_failed(rng)
        share = min(left, _share(ensemble.residuals, float(problem.errors.num_independent.sum())))
        ensemble, share = _moved(problem, ensemble, share, rng)
        left = left - share if share < left else 0.0
    return best


def _simulated(problem: Problem, points: Array, poses: Array) -> _Ensemble:
    whitened, ok = problem.residuals_of(points, poses)
    robust = problem.errors.robust(whitened)
    return _Ensemble(points, poses, robust.reshape(len(points), -1), np.asarray(ok.all(axis=1)))


def _without_limit(problem: Problem, ensemble: _Ensemble) -> _Ensemble:
    """The ensemble; simulated without the iteration limit, from now on, where most members fail with it."""
    if ensemble.most_fail and problem.readings.forces.lift_iteration_limit():
        return _simulated(problem, ensemble.points, ensemble.poses)
    return ensemble


def _moved(problem: Problem, ensemble: _Ensemble, share: float, rng: np.random.Generator) -> tuple[_Ensemble, float]:
    """The ensemble after an update, and the share of the recordings that it took into account.

    An update that leads most members to where descents cannot be simulated, or only slowly, went too far: it is
    repeated with a smaller share. Where that does not help, the iteration limit is lifted.
    """
    members, insertions = ensemble.poses.shape[:2]
    scale = np.tile(INSERTED_POSE_SPREAD, insertions)
    before = np.hstack([ensemble.points, ensemble.poses.reshape(members, -1) / scale])
    for factor in _FACTORS:
        unknowns = _updated(before, ensemble.residuals, factor * share, rng)
        points = np.clip(unknowns[:, : problem.size], -FARTHEST, FARTHEST)
        poses = (unknowns[:, problem.size :] * scale).reshape(ensemble.poses.shape)
        moved = _simulated(problem, points, poses)
        if not moved.most_fail:
            break
    return _without_limit(problem, moved), factor * share


def _costs(problem: Problem, ensemble: _Ensemble) -> Array:
    """Robust negative log posterior of each member."""
    prior = 0.5 * (ensemble.points**2).sum(1) + prior_cost_of_all(problem, ensemble.poses)
    return np.asarray(0.5 * (ensemble.residuals**2).sum(1) + prior)


def _share(residuals: Array, independent: float) -> float:
    """Share of the recordings that the next update takes into account: the larger, the smaller the residuals are.

    `independent` is the number of independent residuals.
    """
    half_squares = 0.5 * (residuals**2).sum(1)
    by_mean = independent / (2 * half_squares.mean())
    by_spread = np.sqrt(independent / (2 * half_squares.var() + 1e-12))
    return float(max(by_mean, by_spread))


def _updated(unknowns: Array, residuals: Array, share: float, rng: np.random.Generator) -> Array:
    """Members after an update by a `share` of the recordings, with perturbed observations."""
    members = len(unknowns)
    spread = (residuals - residuals.mean(0)) / np.sqrt(members - 1)
    change = (unknowns - unknowns.mean(0)) / np.sqrt(members - 1)
    noise = 1 / share
    wanted = np.sqrt(noise) * rng.normal(size=residuals.shape) - residuals
    weights = np.linalg.solve(spread @ spread.T + noise * np.eye(members), spread @ wanted.T)
    return np.asarray(unknowns + (change.T @ weights).T)
