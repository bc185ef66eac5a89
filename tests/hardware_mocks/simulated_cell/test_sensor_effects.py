"""Displacements of gels that are not ideal."""

from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.gel.creep import deformation
from gelflow.hardware_mocks.simulated_cell.sensor_effects import DeviatingGel
from gelflow.hardware_mocks.simulated_cell.world import SensorEffects, World, load_world, plain_world, world_from_tables
from gelflow.observation import Grid

POSITIONS = Grid(5, 4, 1.0).positions()
PUSH = np.random.default_rng(0).normal(size=POSITIONS.shape)


def gel(**effects: float) -> DeviatingGel:
    return DeviatingGel(SensorEffects(**effects), POSITIONS, 3)


def test_an_ideal_gel_changes_nothing() -> None:
    made = gel()
    for stamp in (0.0, 5.0):
        np.testing.assert_array_equal(made.apply(PUSH, stamp), PUSH)
    assert SensorEffects(creep_time=2.0, noise_mm=0.5).ideal


def test_creep_follows_the_force_like_a_standard_linear_solid() -> None:
    made, stamps = gel(creep=0.3, creep_time=0.2), np.array([0.0, 0.03, 0.06, 0.5, 3.0])
    scale = np.array([0.0, 1.0, 1.0, 1.0, 1.0])
    found = np.stack([made.apply(factor * PUSH, stamp) for factor, stamp in zip(scale, stamps, strict=True)])
    expected = deformation(scale, stamps, 0.3, 0.2)
    np.testing.assert_allclose(found, expected[:, None, None] * PUSH, atol=1e-12)
    assert expected[1] < 0.8 and expected[-1] == pytest.approx(1.0, abs=1e-5)


def test_crosstalk_is_the_mean_of_the_four_nearest_markers() -> None:
    inner = 1 * 4 + 1  # row 1, column 1
    neighbours = [inner - 4, inner + 4, inner - 1, inner + 1]
    shown = gel(crosstalk=0.25).apply(PUSH, 0.0)
    np.testing.assert_allclose(shown[inner], 0.75 * PUSH[inner] + 0.25 * PUSH[neighbours].mean(axis=0))
    equal = np.tile([[0.1, -0.2]], (len(POSITIONS), 1))
    np.testing.assert_allclose(gel(crosstalk=0.8).apply(equal, 0.0), equal)


def test_gains_are_constant_and_noise_is_not() -> None:
    made = gel(gain_spread=0.1)
    first = made.apply(PUSH, 0.0)
    np.testing.assert_array_equal(made.apply(PUSH, 1.0), first)
    gains = (first / PUSH)[:, 0]
    assert np.ptp(gains) > 0.1 and abs(np.log(gains).mean()) < 0.1
    noisy = gel(noisy=0.3, noise_mm=0.05)
    difference = noisy.apply(PUSH, 0.0) - noisy.apply(PUSH, 1.0)
    moved = (difference != 0).all(axis=1)
    assert 1 <= moved.sum() < len(POSITIONS)
    assert 0.01 < difference[moved].std() < 0.2


def test_drift_is_common_to_a_pad_and_grows_with_time() -> None:
    made = gel(drift_mm=0.6)
    np.testing.assert_array_equal(made.apply(PUSH, 10.0), PUSH)
    shift = made.apply(PUSH, 40.0) - PUSH
    np.testing.assert_allclose(shift, np.tile(shift[:1], (len(shift), 1)), atol=1e-12)
    assert np.linalg.norm(shift[0]) == pytest.approx(0.3)


def test_world_files_name_the_effects(tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text("[sensor]\ncreep = 0.2\ncrosstalk = 0.1\n")
    world = load_world(path)
    assert world.sensor == SensorEffects(creep=0.2, crosstalk=0.1)
    assert world_from_tables(plain_world(world), "again") == world
    assert plain_world(World()) == {"format": 1}
    for text, message in (("creep = 1.5", "creep must be within 0 to 1"), ("lag = 1", "lag")):
        path.write_text(f"[sensor]\n{text}\n")
        with pytest.raises(UsageError, match=message):
            load_world(path)
