"""Least squares without negative values."""

import numpy as np
import pytest
from scipy.optimize import nnls

from gelflow.perception.force._contact_fit import solve_nonnegative


@pytest.mark.parametrize("seed", range(8))
def test_solution_is_that_of_an_independent_solver(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, right = rng.normal(size=(60, 40)), rng.normal(size=60)
    start = rng.uniform(size=40) < 0.5
    found = solve_nonnegative(matrix.T @ matrix, matrix.T @ right, start)
    np.testing.assert_allclose(found, nnls(matrix, right)[0], atol=1e-9)


def test_solution_does_not_depend_on_the_first_set() -> None:
    rng = np.random.default_rng(1)
    matrix, right = rng.normal(size=(60, 40)), rng.normal(size=60)
    hessian, linear = matrix.T @ matrix, matrix.T @ right
    cold = solve_nonnegative(hessian, linear, np.zeros(40, bool))
    for start in (cold > 0, cold == 0, np.ones(40, bool)):
        np.testing.assert_allclose(solve_nonnegative(hessian, linear, start), cold, atol=1e-12)


def test_an_ill_conditioned_problem_is_solved_too() -> None:
    distance = np.abs(np.arange(50)[:, None] - np.arange(50))
    matrix = np.exp(-((distance / 3.0) ** 2)) + 1e-6 * np.eye(50)
    linear = matrix @ np.where(np.arange(50) % 10 < 5, 1.0, 0.0) + 1e-3 * np.cos(np.arange(50))
    found = solve_nonnegative(matrix, linear, np.zeros(50, bool))
    slope = matrix @ found - linear
    assert found.min() >= 0
    assert np.abs(slope[found > 0]).max() < 1e-9
    assert slope[found == 0].min() > -1e-6


def test_nothing_pushes_and_nothing_moves() -> None:
    assert not solve_nonnegative(np.eye(4), -np.ones(4), np.ones(4, bool)).any()
