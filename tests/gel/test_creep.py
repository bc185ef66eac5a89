"""Lag of a viscoelastic gel."""

import numpy as np
import pytest

from gelflow.gel.creep import CreepCorrection, deformation


def test_a_sudden_force_deforms_in_two_parts() -> None:
    stamps = np.array([0.0, 1e-6, 0.1, 0.2, 3.0])
    found = deformation(np.array([0.0, 1.0, 1.0, 1.0, 1.0]), stamps, 0.3, 0.1)
    expected = [0.0, 0.7, 1 - 0.3 * np.exp(-1), 1 - 0.3 * np.exp(-2), 1.0]
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("time", [0.01, 0.1, 2.0])
def test_the_correction_undoes_the_lag(time: float) -> None:
    rng = np.random.default_rng(0)
    stamps, force = np.cumsum(rng.uniform(0.01, 0.08, 40)), np.cumsum(rng.normal(size=(40, 6, 2)), axis=0)
    lagging = np.stack([deformation(column, stamps, 0.25, time) for column in force.reshape(40, -1).T], axis=1).reshape(
        force.shape
    )
    correction = CreepCorrection(0.25, time)
    known = np.ones((6, 2), bool)
    for stamp, x, f in zip(stamps, lagging, force, strict=True):
        np.testing.assert_allclose(correction.undo(x, known, stamp), f, atol=1e-9)


def test_unknown_values_keep_the_last_force() -> None:
    correction = CreepCorrection(0.2, 0.1)
    correction.undo(np.array([1.0, 2.0]), np.array([True, True]), 0.0)
    found = correction.undo(np.array([1.0, np.nan]), np.array([True, False]), 0.04)
    np.testing.assert_allclose(found, [1.0, 2.0])
    assert np.isfinite(correction.undo(np.array([1.0, 2.0]), np.array([True, True]), 0.08)).all()
