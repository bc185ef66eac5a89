"""Covariance of the parameters at the end of a fit, with the uncertainty of the poses and the roughness of the cost.

Poses are fitted as well, so they are unknowns of the covariance. The cost has steps where contact points cross edges of
the hole or the pads; its curvature at one point can be far larger than over the width of an interval. The Gauss-Newton
covariance is therefore compared with the cost itself: along each of its principal axes the deviation is enlarged until
the cost has risen as a normal distribution predicts (a likelihood-ratio interval along that axis).
"""

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.model.parameters import FARTHEST
from gelflow.policies.calibration.poses import prior_cost_of_all, prior_information
from gelflow.policies.calibration.problem import POSE_STEP, Problem

Array = NDArray[np.float64]

_DEVIATIONS = 1.96  # at which the rise of the cost is measured
_FACTORS = np.array([1.0, 2.0, 4.0, 8.0, 16.0])  # of a deviation that are tried, until the rise is sufficient


def covariance(problem: Problem, point: Array, poses: Array, chi: float) -> Array:
    """Covariance of the whitened unknowns (size, size).

    `chi` is the root mean square of the residuals, which are divided by it where it exceeds 1.
    """
    joint = _gauss_newton(problem, point, poses, max(1.0, chi))
    variances, axes = np.linalg.eigh(joint)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    wider = deviations * _factors(problem, point, poses, axes * deviations, max(1.0, chi))
    full = (axes * wider**2) @ axes.T
    return np.asarray(full[: problem.size, : problem.size])


def _gauss_newton(problem: Problem, point: Array, poses: Array, scale: float) -> Array:
    """Covariance of the unknowns and of the poses of all insertions, in units of `POSE_STEP`."""
    line = problem.linearize(point, poses)
    weights = problem.errors.weights(line.residuals / scale).reshape(-1)
    columns = np.concatenate([line.jacobian, _pose_columns(problem, point, poses)], -1)
    jacobian = columns.reshape(len(weights), -1) / scale
    information = jacobian.T @ (weights[:, None] * jacobian)
    information[np.arange(problem.size), np.arange(problem.size)] += 1.0
    for i in range(len(poses)):
        rows = problem.size + 3 * i + np.arange(3)
        information[np.ix_(rows, rows)] += POSE_STEP[:, None] * prior_information(problem, i) * POSE_STEP
    return np.asarray(np.linalg.inv(information))


def _pose_columns(problem: Problem, point: Array, poses: Array) -> Array:
    """Changes of the whitened residuals per `POSE_STEP` of each insertion's pose, (n, 2 * markers, 3 * insertions).

    Zero where a simulation fails: the prior of the pose then counts alone.
    """
    n, rows = len(problem.recordings), np.arange(len(problem.recordings))
    result = np.zeros((n, 2 * problem.errors.markers, 3 * len(poses)))
    for axis in range(3):
        sides = [_residuals(problem, point[None], (poses + s * np.diag(POSE_STEP)[axis])[None])[0] for s in (1, -1)]
        result[rows, :, 3 * problem.recordings.insertion + axis] = np.nan_to_num((sides[0] - sides[1]) / 2)
    return result


def _residuals(problem: Problem, points: Array, poses: Array) -> Array:
    """Whitened residuals (m, n, 2 * markers) at points (m, size) with poses (m, insertions, 3); nan where they fail."""
    residuals, ok = problem.residuals_of(points, poses)
    residuals[~ok] = np.nan
    return residuals


def _costs(problem: Problem, points: Array, poses: Array, scale: float) -> Array:
    """Negative log posterior (m,) with residuals divided by `scale`; inf where a simulation fails."""
    residuals = _residuals(problem, points, poses) / scale
    fit = problem.errors.misfit(residuals).sum(1)
    prior = 0.5 * (points**2).sum(1) + prior_cost_of_all(problem, poses)
    return np.asarray(np.nan_to_num(fit + prior, nan=np.inf))


def _factors(problem: Problem, point: Array, poses: Array, axes: Array, scale: float) -> Array:
    """Factor by which each column of `axes` has to be enlarged; a column is one standard deviation along an axis."""
    size, count = problem.size, axes.shape[1]
    base = _costs(problem, point[None], poses[None], scale)[0]
    factors = np.full((2, count), _FACTORS[-1])
    for side, sign in enumerate((1.0, -1.0)):
        open_ = np.arange(count)
        for factor in _FACTORS:
            moved = sign * factor * _DEVIATIONS * axes[:, open_].T
            points = np.clip(point + moved[:, :size], -FARTHEST, FARTHEST)
            other = poses + moved[:, size:].reshape(len(open_), -1, 3) * POSE_STEP
            risen = _costs(problem, points, other, scale) - base >= 0.5 * _DEVIATIONS**2
            factors[side, open_[risen]] = factor
            open_ = open_[~risen]
            if not len(open_):
                break
    return np.asarray(factors.max(0))
