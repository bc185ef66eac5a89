"""Least squares with variables that must not be negative, for small dense problems."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, lapack

Array = NDArray[np.float64]

_MAX_ITERATIONS = 60
_FULL_EXCHANGES = 3  # without progress, before variables are exchanged one by one


def solve_nonnegative(hessian: Array, linear: Array, start: NDArray[np.bool_]) -> Array:
    """The x ≥ 0 with the smallest ½ xᵀ hessian x − linearᵀ x, shape (n,).

    Block principal pivoting after Portugal, Júdice and Vicente (1994): each iteration moves all infeasible variables
    into or out of the set of positive ones, or a single one if their number no longer decreases. `start` is the first
    set, for example that of a similar problem. `hessian` must be positive definite.
    """
    positive = start.copy()
    fewest, exchanges = len(linear) + 1, _FULL_EXCHANGES
    tolerance = 1e-9 * float(np.abs(linear).max(initial=0.0))
    for _ in range(_MAX_ITERATIONS):
        x = np.zeros(len(linear))
        indices = positive.nonzero()[0]
        if indices.size:
            x[indices] = solve_positive_definite(hessian[indices[:, None], indices], linear[indices])
        wrong = np.where(positive, x < 0, hessian @ x - linear < -tolerance)
        count = int(np.count_nonzero(wrong))
        if count == 0:
            break
        if count < fewest:
            fewest, exchanges = count, _FULL_EXCHANGES
        elif exchanges > 0:
            exchanges -= 1
        else:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        positive ^= wrong
    return np.maximum(x, 0.0)


def solve_positive_definite(matrix: Array, right: Array) -> Array:
    """Solution of a symmetric positive definite system. Raises LinAlgError for another matrix."""
    _, solution, info = lapack.dposv(matrix.T, right, lower=1)
    if info != 0:
        raise LinAlgError("the matrix is not positive definite")
    return np.asarray(solution).reshape(right.shape)
