import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.observation import Grid, resampling_weights
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.model.pad_model import SIDES, PadModel
from gelflow.task import INSERTION

GRID = INSERTION.grid
PRINTED = Grid(18, 14, 1.4, (2.0, 0.0))
VALUES = {"gain_left": 1.2, "gain_right": 0.7, "turn_left": 0.1, "turn_right": -0.05, "crosstalk": 0.2}
IDEAL = {f"gain_{side}": 1.0 for side in SIDES} | {f"turn_{side}": 0.0 for side in SIDES} | {"crosstalk": 0.0}


def pads(printed: Grid | None) -> PadModel:
    return PadModel([GRID, GRID], [GRID.positions()] * 2, printed=printed)


def read(model: PadModel, shear: NDArray[np.float64], values: dict[str, float]) -> NDArray[np.float64]:
    return model.read(shear, {name: np.asarray(value) for name, value in values.items()})


def test_a_print_on_the_grid_changes_nothing() -> None:
    shear = np.random.default_rng(0).normal(size=(2 * len(GRID.positions()), 2))
    assert np.array_equal(read(pads(GRID), shear, VALUES), read(pads(None), shear, VALUES))
    assert np.array_equal(read(pads(GRID), shear, IDEAL), shear)
    assert pads(GRID).crosstalk_on_grid(np.array([0.0, 0.3])) == pytest.approx([0.0, 0.3])


@pytest.mark.parametrize("printed", [PRINTED, Grid(9, 7, 2.4, (2.0, 0.0))])
def test_resampling_keeps_linear_fields_and_smooths_edges(printed: Grid) -> None:
    x, y = np.tile(GRID.positions(), (2, 1)).T
    linear = np.column_stack([0.3 * x - 0.1 * y, y + 2])
    inside = np.tile(np.abs(GRID.positions() - GRID.center) < [7.5, 5.3], (2, 1)).all(1)
    np.testing.assert_allclose(read(pads(printed), linear, IDEAL)[inside], linear[inside], atol=1e-9)
    edge = np.column_stack([np.where(x > 2, 1.0, 0.0), np.zeros_like(x)])
    seen = read(pads(printed), edge, IDEAL)
    assert 0.05 < np.abs(seen - edge)[inside].max() < 0.95
    assert seen.min() > -1e-9 and seen.max() < 1 + 1e-9


def test_derivatives_on_other_printed_markers_agree_with_finite_differences() -> None:
    model, shear = pads(PRINTED), np.random.default_rng(0).normal(size=(3, 2 * len(GRID.positions()), 2))
    for name, slope in model.derivatives(shear, VALUES).items():
        up, down = (read(model, shear, {**VALUES, name: VALUES[name] + step}) for step in (1e-5, -1e-5))
        np.testing.assert_allclose(slope, (up - down) / 2e-5, rtol=1e-6, atol=1e-8)


# Exact without crosstalk and with full crosstalk; between them, medians of the changes are not quite linear.
@pytest.mark.parametrize(("printed", "error"), [(0.0, 1e-9), (0.3, 0.02), (1.0, 1e-9)])
def test_crosstalk_of_the_print_is_converted_to_that_of_the_grid(printed: float, error: float) -> None:
    field = np.tile((GRID.positions() ** 2).sum(1)[:, None], (2, 2))
    converted = float(pads(PRINTED).crosstalk_on_grid(np.asarray(printed)))
    changes = [
        np.median(read(pads(grid), field, {**IDEAL, "crosstalk": level}) - field)
        for grid, level in ((PRINTED, printed), (None, converted))
    ]
    assert changes[0] == pytest.approx(changes[1], rel=error)


def test_the_noise_of_interpolated_markers_is_that_of_one_marker(world: RecordedWorld) -> None:
    weights = resampling_weights(PRINTED.positions(), GRID)
    noise = 0.01 * np.random.default_rng(0).normal(size=(20, 2, len(PRINTED.positions()), 2))
    flow = np.einsum("gm,npmc->npgc", weights, noise).reshape(20, 2, GRID.rows, GRID.cols, 2)
    recordings = dataclasses.replace(world.recordings, flow=flow, printed=PRINTED)
    assert recordings.noise() == pytest.approx(flow.std(), rel=0.1)
