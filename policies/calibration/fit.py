"""The fit: a global search, then searches of the poses and Levenberg-Marquardt steps in the parameters in turn.

In between, the pose of each insertion is searched globally with the parameters found so far, because a local search
does not leave a wrong pose that wrong parameters compensate.

The fit is repeated from several independent starts. The forces have kinks and steps where contact points cross edges
of the hole, so that starts can end in different minima; their spread is part of the intervals.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from gelflow.errors import SimulationError
from gelflow.helper_process import worker_pool
from gelflow.policies.calibration.ensemble import rough_problem, search_globally, search_nearby
from gelflow.policies.calibration.model.parameters import FARTHEST
from gelflow.policies.calibration.pose_search import better_poses
from gelflow.policies.calibration.poses import prior_cost_of_all, refined_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.recordings import MODEL_ERROR, Recordings
from gelflow.policies.calibration.uncertainty import covariance

Array = NDArray[np.float64]

# Ensembles and rounds of local searches, before and after the poses of all insertions are searched once more. Of an
# ensemble: the error of the model that it allows for, and its spread around the best member, relative to the prior.
_BEFORE = ((0.04, 0.2), (MODEL_ERROR, 0.1)), 1
_AFTER = ((MODEL_ERROR, 0.05),), 2
_SUFFICIENT = 1.0  # decrease of the cost in a round below which no other follows
_AS_GOOD = 1.3  # starts whose residuals are larger than the best ones by this factor do not count


@dataclass(frozen=True)
class FitSettings:
    """Effort of a fit."""

    starts: int = 4  # independent fits
    members: int = 192  # of the first ensemble of the global search
    nearby: int = 80  # members of the later ensembles
    poses: int = 32  # random poses of each insertion at each size of a search
    steps: int = 3  # of Levenberg-Marquardt in each round


@dataclass(frozen=True)
class StartResult:
    """The end of one start."""

    point: Array  # whitened unknowns, see `Problem`
    misalignment: Array  # (insertions, 3)
    covariance: Array  # of the unknowns, with unknown poses
    cost: float
    chi: float  # root mean square of the whitened residuals
    drift: float  # standard deviation of a common shift of all markers of a pad [N]


@dataclass(frozen=True)
class FitResult:
    """All starts that fit about equally well, the best first."""

    starts: tuple[StartResult, ...]
    count: int  # number of parameters; the other unknowns are start heights
    others: int = 0  # number of starts that ended in a worse fit, or could not be simulated

    @property
    def best(self) -> StartResult:
        """The start with the lowest cost."""
        return self.starts[0]

    @property
    def converged(self) -> bool:
        """Whether more than half of the starts fit about equally well; if not, a further start might fit better."""
        return len(self.starts) > self.others

    @property
    def covariance(self) -> Array:
        """Covariance of the whitened parameters, the mean of the starts."""
        return np.asarray(np.mean(self._covariances, axis=0))

    @property
    def joint_distribution(self) -> tuple[Array, Array]:
        """Mean and covariance of a joint normal distribution of the whitened parameters.

        The covariance of one start is too small in some combinations of the parameters, along which the ends of the
        starts differ. The covariance of these ends is added. No direction is wider than its prior.
        """
        points = np.stack([start.point[: self.count] for start in self.starts])
        between = points - points.mean(0)
        variances, axes = np.linalg.eigh(self.covariance + between.T @ between / max(1, len(points) - 1))
        return points.mean(0), np.asarray((axes * np.clip(variances, 0.0, 1.0)) @ axes.T)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Whitened parameters (count, parameters) from the joint distribution."""
        return rng.multivariate_normal(*self.joint_distribution, size=count, method="eigh")

    def interval(self, directions: Array) -> tuple[Array, Array]:
        """95 % intervals of linear combinations (k, count) of the whitened parameters.

        An interval reaches from the lowest limit of all starts to the highest one.
        """
        points = [directions @ start.point[: self.count] for start in self.starts]
        spread = [1.96 * np.sqrt(np.einsum("ki,ij,kj->k", directions, c, directions)) for c in self._covariances]
        low = np.min([p - s for p, s in zip(points, spread, strict=True)], axis=0)
        high = np.max([p + s for p, s in zip(points, spread, strict=True)], axis=0)
        return low, high

    @property
    def _covariances(self) -> list[Array]:
        factor = 1 + 2 * self._typical_excess / (self.best.point.size + self.best.misalignment.size)
        return [factor * start.covariance[: self.count, : self.count] for start in self.starts]

    @property
    def _typical_excess(self) -> float:
        """Median of the cost of the other starts above that of the best one: a typical error of the search.

        For comparison: a displacement of every unknown by one standard deviation costs half the number of unknowns.
        """
        return float(np.median([start.cost - self.best.cost for start in self.starts[1:]] or [0.0]))


def fit(
    recordings: Recordings,
    *,
    seed: int = 0,
    settings: FitSettings | None = None,
    processes: int = 1,
    progress: Callable[[int], None] = lambda done: None,
) -> FitResult:
    """Fit parameters, start heights and poses. Results do not depend on the number of `processes`.

    Raises UsageError without attempts, SimulationError when no start can be simulated.
    """
    settings = settings or FitSettings()
    count = len(Problem(recordings, threads=1).fitted)
    jobs = [(recordings, seed, k, settings) for k in range(settings.starts)]
    results: list[StartResult | None] = []
    if processes <= 1:
        for job in jobs:
            results.append(_fit_start(*job))
            progress(len(results))
    else:
        try:
            with worker_pool(min(processes, len(jobs))) as pool:
                futures = [pool.submit(_fit_start, *job) for job in jobs]
                for done, _ in enumerate(as_completed(futures)):
                    progress(done + 1)
                results = [future.result() for future in futures]
        except BrokenExecutor as error:
            raise SimulationError(
                "a process of the fit was killed, as the system does when memory is short; close other programs, or "
                'calibrate fewer sessions at a time. A script must call calibrate under if __name__ == "__main__"'
            ) from error
    ended = sorted((result for result in results if result is not None), key=lambda result: result.cost)
    if not ended:
        raise SimulationError("the recorded descents cannot be simulated with any start of the fit")
    limit = _AS_GOOD * ended[0].chi
    as_good = tuple(result for result in ended if result.chi <= limit)
    return FitResult(as_good, count, len(jobs) - len(as_good))


def _fit_start(recordings: Recordings, seed: int, index: int, settings: FitSettings) -> StartResult | None:
    """One start; None when it cannot be simulated."""
    # With several threads in each process, the processes would wait for one another in every matrix product.
    with threadpool_limits(1):
        try:
            return _searched(Problem(recordings, threads=1), np.random.default_rng((seed, index)), settings)
        except SimulationError:
            return None


def _searched(problem: Problem, rng: np.random.Generator, settings: FitSettings) -> StartResult:
    point, poses = search_globally(rough_problem(problem.recordings, threads=1), settings.members, rng)
    coarse = problem.coarse
    point, poses = _improve(coarse, point, poses, rng, settings, *_BEFORE)
    point, poses = better_poses(coarse, point, poses, rng, members=settings.nearby, count=settings.poses)
    problem.errors = coarse.errors
    point, poses = _improve(problem, point, poses, rng, settings, *_AFTER)
    chi = problem.errors.chi(problem.residuals(point, poses)[0])
    return StartResult(
        point, poses, covariance(problem, point, poses, chi), _cost(problem, point, poses), chi, problem.errors.drift
    )


def _improve(
    problem: Problem,
    point: Array,
    poses: Array,
    rng: np.random.Generator,
    settings: FitSettings,
    ensembles: Sequence[tuple[float, float]],
    rounds: int,
) -> tuple[Array, Array]:
    """Ensembles around the present guess, then local searches."""
    for error, spread in ensembles:
        problem.allow_for(model_error=error)
        point, poses = search_nearby(problem, point, poses, spread, settings.nearby, rng)
    problem.allow_for_present_drift(point, poses)
    return _descend(problem, point, poses, rng, settings, rounds)


def _descend(
    problem: Problem, point: Array, poses: Array, rng: np.random.Generator, settings: FitSettings, rounds: int
) -> tuple[Array, Array]:
    """Local searches of poses and start heights, and steps in parameters and start heights, in turn."""
    cost = _cost(problem, point, poses)
    for _ in range(rounds):
        before = cost
        better, moved, found = refined_poses(problem, point, poses, rng, count=settings.poses)
        if better < cost:
            point, poses = moved, found
        point = _levenberg_marquardt(problem, point, poses, settings.steps)
        cost = _cost(problem, point, poses)
        if before - cost < _SUFFICIENT:
            break
    return point, poses


def _cost(problem: Problem, point: Array, poses: Array) -> float:
    return problem.cost(problem.residuals(point, poses)[0], point) + float(prior_cost_of_all(problem, poses[None])[0])


def _levenberg_marquardt(problem: Problem, point: Array, poses: Array, steps: int) -> Array:
    """The point after up to `steps` Levenberg-Marquardt steps with fixed poses.

    The Jacobian is exact at the start, then follows the residuals (Broyden's update) until a step fails.
    """
    residuals, ok = problem.residuals(point, poses)
    if not ok:
        raise SimulationError("a recorded descent cannot be simulated at the start of the fit")
    cost = problem.cost(residuals, point)
    line = problem.linearize(point, poses)
    r = line.residuals.reshape(-1)
    jacobian = line.jacobian.reshape(len(r), -1)
    damping, fresh = 1e-2, True
    for _ in range(steps):
        normal, gradient = problem.normal_equations(r, jacobian, point)
        before = cost
        for _ in range(6):
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            step *= min(1.0, 1.5 / np.abs(step).max())
            trial = np.clip(point + step, -FARTHEST, FARTHEST)
            r_trial, ok = problem.residuals(trial, poses)
            trial_cost = problem.cost(r_trial, trial)
            if ok and trial_cost < cost:
                moved, changed = trial - point, r_trial.reshape(-1) - r
                jacobian = jacobian + np.outer(changed - jacobian @ moved, moved) / (moved @ moved)
                point, cost, damping, r = trial, trial_cost, max(damping / 5, 1e-8), r_trial.reshape(-1)
                fresh = False
                break
            damping = min(damping * 8, 1e8)
        if before - cost < 1e-3 * max(1.0, abs(cost)):
            if fresh:
                break
            line = problem.linearize(point, poses)
            jacobian, damping, fresh = line.jacobian.reshape(len(r), -1), 1e-2, True
    return point
