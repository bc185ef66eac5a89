import numpy as np
import pytest

from gelflow.observation import Grid, interpolation_weights

GRID = Grid(5, 4, 1.5, (2.0, -1.0))


def test_a_grid_is_interpolated_to_itself_exactly() -> None:
    np.testing.assert_allclose(interpolation_weights(GRID, GRID.positions()), np.eye(20), atol=1e-12)


def test_linear_fields_continue_for_one_pitch_beyond_the_border() -> None:
    values = GRID.positions() @ [2.0, -3.0] + 1
    low, high = GRID.positions().min(0) - 1.5, GRID.positions().max(0) + 1.5
    positions = np.random.default_rng(0).uniform(low, high, (100, 2))
    weights = interpolation_weights(GRID, positions)
    np.testing.assert_allclose(weights @ values, positions @ [2.0, -3.0] + 1)
    np.testing.assert_allclose(interpolation_weights(GRID, [high + 7, high]) @ values, [high @ [2.0, -3.0] + 1] * 2)


@pytest.mark.parametrize("grid", [Grid(1, 4, 1.5), Grid(3, 1, 1.5), Grid(1, 1, 1.5)])
def test_a_single_line_is_constant_across(grid: Grid) -> None:
    positions = np.array([[0.0, 0.0], [5.0, -5.0], [-0.3, 0.4]])
    weights = interpolation_weights(grid, positions)
    assert weights.shape == (3, grid.rows * grid.cols)
    np.testing.assert_allclose(weights.sum(1), 1)
