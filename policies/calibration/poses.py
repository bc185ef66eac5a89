"""Priors of the misalignment of each insertion, and a local search: random poses, compared with the flow maps."""

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import apply_planar
from gelflow.policies.calibration.problem import Problem, in_hole

Array = NDArray[np.float64]

# Standard deviation of the pose of an inserted part in its hole [m, m, rad].
INSERTED_POSE_SPREAD = np.array([1.3e-3, 1.3e-3, np.radians(2.5)])
_SIZES = (0.1, 0.05, 0.025, 0.012)  # spreads of new poses around the best ones / `INSERTED_POSE_SPREAD`, by round
_HEIGHTS = np.array([-1.5, -0.75, 0.0, 0.75, 1.5])  # start heights that are tried, in standard deviations
_SHORTLIST = 6
_PARENTS = 3  # best poses, around which new ones are drawn


def draw_poses(problem: Problem, insertion: int, count: int, rng: np.random.Generator) -> Array:
    """Misalignments (count, 3) of an insertion, drawn from their prior.

    The prior is that of the task. Of an inserted part, the pose at which it was inserted is normally distributed about
    the pose of the hole; misalignments beyond 1.2 times the limits of the task are drawn again where possible.
    """
    task = problem.recordings.task
    limit = np.maximum(np.asarray(task.misalignment), 1e-9)
    found = problem.recordings.inserted.get(insertion)
    if found is None:
        return task.draw_misalignment(rng, count)
    result = np.zeros((0, 3))
    while len(result) < count:
        # Solve in_hole(misalignment, found) = pose for the misalignment.
        pose = rng.normal(size=(8 * count, 3)) * INSERTED_POSE_SPREAD
        yaw = pose[:, 2] - found[2]
        drawn = np.column_stack([apply_planar(np.column_stack([pose[:, :2], yaw]), -found[:2]), yaw])
        inside = drawn[(np.abs(drawn) <= 1.2 * limit).all(1)]
        result = np.vstack([result, inside if len(inside) else drawn])
    return result[:count]


def prior_cost(problem: Problem, insertion: int, poses: Array) -> Array:
    """Negative log prior of misalignments (m, 3)."""
    found = problem.recordings.inserted.get(insertion)
    if found is None:
        return np.zeros(len(poses))
    return np.asarray(0.5 * ((in_hole(poses, found[None]) / INSERTED_POSE_SPREAD) ** 2).sum(1))


def prior_cost_of_all(problem: Problem, poses: Array) -> Array:
    """Negative log prior of the misalignments of all insertions (m, insertions, 3), shape (m,)."""
    return np.asarray(sum(prior_cost(problem, i, poses[:, i]) for i in range(problem.insertions)))


def costs_of_insertions(problem: Problem, point: Array, poses: Array) -> Array:
    """Part of the negative log posterior that depends on the pose and start heights of each insertion, (insertions,).

    Infinite where an attempt cannot be simulated.
    """
    residuals, ok = problem.residuals_of(point[None], poses[None])
    heights = point[len(problem.fitted) :]
    of_attempts = np.where(ok[0], problem.errors.misfit(residuals[0]) + 0.5 * heights**2, np.inf)
    of_poses = [float(prior_cost(problem, i, poses[i : i + 1])[0]) for i in range(problem.insertions)]
    return np.asarray(np.bincount(problem.recordings.insertion, of_attempts, problem.insertions) + of_poses)


def prior_information(problem: Problem, insertion: int) -> Array:
    """Information of the prior about the misalignment of an insertion, (3, 3) [1/m, 1/m, 1/rad each]."""
    found = problem.recordings.inserted.get(insertion)
    if found is None:
        spread = np.maximum(np.asarray(problem.recordings.task.misalignment), 1e-9) / np.sqrt(3)
    else:
        spread = INSERTED_POSE_SPREAD
    return np.diag(1 / spread**2)


def best_poses(
    problem: Problem, point: Array, candidates: list[Array], *, range_of_heights: float = 1.0
) -> tuple[list[Array], list[Array], Array]:
    """The best candidates of each insertion: poses (k, 3), their costs (k,), and the point with their start heights.

    First the candidates are ranked by the shape of their flow maps, because the size depends on the start height. The
    best ones are then simulated with several start heights: over the whole range if `range_of_heights` is 1, otherwise
    over this fraction of it around the heights of `point`.
    """
    short = [_by_shape(problem, point, i, poses, _SHORTLIST) for i, poses in enumerate(candidates)]
    poses, costs, heights = _with_heights(problem, point, short, range_of_heights)
    point = point.copy()
    for i, of_best in enumerate(heights):
        point[len(problem.fitted) + _rows(problem, i)] = of_best[0]
    return poses, costs, point


def _rows(problem: Problem, insertion: int) -> NDArray[np.int64]:
    return np.flatnonzero(problem.recordings.insertion == insertion)


def _simulate(
    problem: Problem, point: Array, rows: NDArray[np.int64], poses: Array, heights: Array
) -> tuple[Array, NDArray[np.bool_]]:
    values = {name: np.full(len(rows), value) for name, value in problem.values(point).items()}
    return problem.predicted(values, rows, poses, heights)


def _by_shape(problem: Problem, point: Array, insertion: int, poses: Array, keep: int) -> Array:
    """The `keep` poses whose flow maps, scaled to the size of the recorded ones, fit them best."""
    attempts, m = _rows(problem, insertion), len(poses)
    if not len(attempts):
        return poses[:keep]
    rows = np.repeat(attempts, m)
    z = np.repeat(problem.heights(point)[attempts], m)
    flow, ok = _simulate(problem, point, rows, np.tile(poses, (len(attempts), 1)), z)
    model = problem.errors.whiten(flow, rows)
    data = problem.errors.whiten(problem.data[rows], rows)
    scale = np.clip((model * data).sum(1) / np.maximum((model**2).sum(1), 1e-12), 0.2, 5.0)
    misfit = problem.errors.misfit(scale[:, None] * model - data, rows)
    cost = np.where(ok, misfit, 1e9).reshape(len(attempts), m).sum(0)
    return poses[np.argsort(cost + prior_cost(problem, insertion, poses))[:keep]]


def _with_heights(
    problem: Problem, point: Array, short: list[Array], range_of_heights: float
) -> tuple[list[Array], list[Array], list[Array]]:
    """Poses (k, 3) of each insertion, the best first, their costs (k,), and their start heights (k, attempts) [sd]."""
    count = len(problem.fitted)
    costs, heights = [], []
    for insertion, poses in enumerate(short):
        attempts, m, h = _rows(problem, insertion), len(poses), len(_HEIGHTS)
        rows = np.repeat(attempts, m * h)
        present = point[count:][rows]
        tried = np.tile(_HEIGHTS, len(attempts) * m)
        if range_of_heights < 1:
            tried = present + range_of_heights * tried
        tried = np.where(tried == 0, present, tried)
        flow, ok = _simulate(
            problem,
            point,
            rows,
            np.tile(np.repeat(poses, h, 0), (len(attempts), 1)),
            problem.recordings.height_spread * tried,
        )
        fit = problem.errors.misfit(problem.errors.whiten(flow - problem.data[rows], rows), rows) + 0.5 * tried**2
        cost = np.where(ok, fit, 1e9).reshape(len(attempts), m, h)
        best = cost.argmin(2)
        chosen = np.take_along_axis(tried.reshape(cost.shape), best[..., None], 2)[..., 0]
        total = cost.min(2).sum(0) + prior_cost(problem, insertion, poses)
        order = np.argsort(total)
        short[insertion] = poses[order]
        costs.append(total[order])
        heights.append(chosen.T[order])
    return short, costs, heights


def refined_poses(
    problem: Problem, point: Array, poses: Array, rng: np.random.Generator, *, count: int
) -> tuple[float, Array, Array]:
    """Random search of the poses (insertions, 3) and start heights with fixed parameters.

    Each round draws `count` poses of each insertion around the best ones so far, closer to them from round to round.
    Returns the cost, the point with the start heights, and the poses.
    """
    parameters, best = point[: len(problem.fitted)], [pose[None] for pose in poses]
    costs: list[Array] = []
    for size in _SIZES:
        candidates = []
        for present in best:
            parents = present[rng.integers(0, min(_PARENTS, len(present)), count)]
            drawn = parents + size * rng.normal(size=parents.shape) * INSERTED_POSE_SPREAD
            candidates.append(np.vstack([present, drawn]))
        best, costs, point = best_poses(problem, point, candidates, range_of_heights=size)
    fixed = 0.5 * float(parameters @ parameters) + problem.errors.log_determinant
    return float(sum(c[0] for c in costs)) + fixed, point, np.stack([p[0] for p in best])
