import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.observation import (
    Grid,
    TactileFrame,
    flow_map,
    interpolation_weights,
    normalize,
    resampling_weights,
)

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


@pytest.mark.parametrize(
    ("sensor", "policy"),
    [
        (Grid(9, 7, 2.8, (2.0, 0.0)), Grid(17, 13, 1.4, (2.0, 0.0))),
        (Grid(10, 7, 1.4, (2.0, 0.0)), Grid(19, 13, 0.7, (2.0, 0.0))),
        (Grid(5, 5, 2.04), Grid(9, 9, 1.02)),
    ],
)
def test_the_border_of_a_grid_in_single_precision_is_interpolated_linearly(sensor: Grid, policy: Grid) -> None:
    positions = sensor.positions().astype(np.float32)
    weights = resampling_weights(positions, policy)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(1), 1.0)
    np.testing.assert_allclose(weights @ positions, policy.positions(), atol=1e-4)


@pytest.mark.parametrize("line", [Grid(1, 10, 1.4), Grid(10, 1, 1.4)])
def test_markers_on_one_line_cannot_be_interpolated(line: Grid) -> None:
    with pytest.raises(UsageError, match="lie on one line"):
        resampling_weights(line.positions(), Grid(1, 5, 2.0, (0.3, 0.0)))
    np.testing.assert_array_equal(resampling_weights(line.positions(), line), np.eye(10))


def frame(shear: float = 0.1, valid: str = "bool") -> TactileFrame:
    values = np.zeros((1, 20, 2), np.float32)
    values[0, 3, 0] = shear
    return TactileFrame(values, np.ones((1, 20), valid), GRID.positions().astype(np.float32), 0.0, "mm")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_valid_marker_that_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(UsageError, match="sensor 0 has a valid marker whose shear is not finite"):
        flow_map([frame(value)], frame(), grid=GRID)


def test_flags_that_are_not_bool_are_refused() -> None:
    with pytest.raises(UsageError, match="valid must be an array of bool"):
        frame(valid="uint8")


@pytest.mark.parametrize("divisor", [0.0, -1.0, float("nan")])
def test_a_divisor_must_be_above_zero(divisor: float) -> None:
    shear = np.zeros((1, 1, 3, 3, 2))
    with pytest.raises(UsageError, match="min_divisor must be above 0"):
        normalize(shear, shear[0], min_divisor=divisor)
