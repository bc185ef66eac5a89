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
    every = np.ones(len(shear), dtype=bool)
    assert pads(GRID).crosstalk_on_grid(np.array([0.0, 0.3]), shear[None], every) == pytest.approx([0.0, 0.3])


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


def contact_maps(world: RecordedWorld) -> NDArray[np.float64]:
    return world.recordings.flow.reshape(len(world.recordings), -1, 2)


@pytest.mark.parametrize("used", [1.0, 0.7])
@pytest.mark.parametrize("printed", [0.0, 0.3, 1.0])
def test_crosstalk_of_the_print_is_converted_to_that_of_the_grid(
    world: RecordedWorld, printed: float, used: float
) -> None:
    """No other crosstalk on the grid gives readings that are more like those of the printed markers."""
    flow, chosen = contact_maps(world), np.random.default_rng(0).random(2 * len(GRID.positions())) < used
    converted = float(pads(PRINTED).crosstalk_on_grid(np.asarray(printed), flow, chosen))
    shown = read(pads(PRINTED), flow, {**IDEAL, "crosstalk": printed})

    def error(crosstalk: float) -> float:
        return float(((read(pads(None), flow, {**IDEAL, "crosstalk": crosstalk}) - shown)[:, chosen] ** 2).sum())

    assert error(converted) < min(error(converted - 0.01), error(converted + 0.01))


@pytest.mark.parametrize(
    "printed", [Grid(9, 7, 2.0, (2.0, 0.0)), Grid(7, 5, 3.0, (2.0, 0.0)), Grid(9, 7, 2.8, (2.0, 0.0))]
)
def test_more_crosstalk_of_a_coarse_print_is_not_less_on_the_grid(world: RecordedWorld, printed: Grid) -> None:
    flow = contact_maps(world)
    converted = pads(printed).crosstalk_on_grid(np.array([0.0, 0.3, 0.6]), flow, np.ones(flow.shape[1], dtype=bool))
    assert (np.diff(converted) >= 0).all()
    assert converted.min() >= 0 and converted.max() <= 1


def test_the_noise_of_interpolated_markers_is_that_of_one_marker(world: RecordedWorld) -> None:
    weights = resampling_weights(PRINTED.positions(), GRID)
    noise = 0.01 * np.random.default_rng(0).normal(size=(20, 2, len(PRINTED.positions()), 2))
    flow = np.einsum("gm,npmc->npgc", weights, noise).reshape(20, 2, GRID.rows, GRID.cols, 2)
    recordings = dataclasses.replace(world.recordings, flow=flow, printed=PRINTED)
    assert recordings.noise() == pytest.approx(flow.std(), rel=0.1)


def test_the_noise_of_two_pads_is_their_root_mean_square(world: RecordedWorld) -> None:
    noise = 0.01 * np.random.default_rng(0).normal(size=(20, 2, GRID.rows, GRID.cols, 2))
    noise[:, 1] *= 3
    recordings = dataclasses.replace(world.recordings, flow=noise, printed=None)
    assert recordings.noise() == pytest.approx(0.01 * np.sqrt(5), rel=0.15)


def test_a_small_print_has_an_estimate_of_its_noise(world: RecordedWorld) -> None:
    """Most markers of the policy's grid are copies of the nearest printed one, so their second differences are 0."""
    small = Grid(4, 3, 2.0, (2.0, 0.0))
    printed = 0.01 * np.random.default_rng(0).normal(size=(20, 2, 12, 2))
    flow = np.einsum("gm,npmc->npgc", resampling_weights(small.positions(), GRID), printed)
    recordings = dataclasses.replace(world.recordings, flow=flow.reshape(20, 2, GRID.rows, GRID.cols, 2), printed=small)
    assert recordings.noise() == pytest.approx(flow.std(), rel=0.3)


@pytest.mark.parametrize("shown", [13, 8])
def test_the_noise_is_that_of_the_measured_markers(world: RecordedWorld, shown: int) -> None:
    """A runner fills rows that the camera does not show with means of their neighbours, which are smooth."""
    noise = 0.01 * np.random.default_rng(0).normal(size=(20, 2, GRID.rows, GRID.cols, 2))
    noise[:, :, shown:] = noise[:, :, shown - 6 : shown].mean(2, keepdims=True)
    measured = np.zeros((2, GRID.rows, GRID.cols), dtype=bool)
    measured[:, :shown] = True
    recordings = dataclasses.replace(
        world.recordings, flow=noise, measured=measured.reshape(-1), used=np.zeros(0, dtype=bool)
    )
    assert recordings.noise() == pytest.approx(0.01, rel=0.15)
    assert not recordings.used[~measured.reshape(-1)].any()
