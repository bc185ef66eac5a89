"""Errors that a fit allows for: noisy markers are found, and residuals have the covariance that they should."""

import dataclasses

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import LITTLE

from gelflow.errors import UsageError
from gelflow.policies.calibration.calibration import calibrate
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.model.error_model import ErrorModel
from gelflow.policies.calibration.pose_search import find_poses
from gelflow.policies.calibration.poses import prior_cost_of_all, refined_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.recordings import Recordings
from gelflow.policies.calibration.report import error_lines, plain_report

NOISE = 1e-3
DEFECTIVE = np.array([0, 77, 140, 201])  # a corner, and others of both pads


def with_noise(recordings: Recordings, factor: float) -> Recordings:
    """Recordings with noise, and with `factor` times the noise at the defective markers."""
    rng = np.random.default_rng(0)
    level = np.full(recordings.flow.shape[1:-1], NOISE)
    level.reshape(-1)[DEFECTIVE] *= factor
    noise = level[..., None] * rng.normal(size=recordings.flow.shape)
    return dataclasses.replace(recordings, flow=recordings.flow + noise, used=np.zeros(0, dtype=bool))


def test_noisy_markers_are_found(world: RecordedWorld) -> None:
    np.testing.assert_array_equal(np.flatnonzero(~with_noise(world.recordings, 10.0).used), DEFECTIVE)
    assert with_noise(world.recordings, 1.0).used.all()


def test_contacts_have_no_noisy_markers(world: RecordedWorld) -> None:
    assert world.recordings.used.all()
    for insertion in range(5):
        flow = world.recordings.of(np.array([insertion])).flow[:1]
        alone = dataclasses.replace(world.recordings, flow=flow, used=np.zeros(0, dtype=bool))
        assert alone.used.mean() > 0.98, insertion


def test_a_pad_with_much_more_noise_is_compared(world: RecordedWorld) -> None:
    flow = world.recordings.flow.copy()
    flow[:, 1] += 30 * NOISE * np.random.default_rng(0).normal(size=flow[:, 1].shape)
    noisy = dataclasses.replace(world.recordings, flow=flow, used=np.zeros(0, dtype=bool))
    assert noisy.used.reshape(2, -1).mean(1).min() > 0.9


def test_noisy_markers_are_those_of_all_insertions(world: RecordedWorld) -> None:
    recordings = with_noise(world.recordings, 10.0)
    part = recordings.of(np.array([4]))
    np.testing.assert_array_equal(part.used, recordings.used)


@pytest.mark.parametrize("pad", [0, 1])
def test_a_pad_without_a_compared_marker_is_an_error(world: RecordedWorld, pad: int) -> None:
    used = np.ones((2, 130), dtype=bool)
    used[pad] = False
    recordings = dataclasses.replace(world.recordings, used=used.reshape(-1))
    with pytest.raises(UsageError, match="no marker of a pad can be compared: its camera shows too few lines"):
        Problem(recordings, threads=1)


@pytest.mark.slow
def test_noisy_markers_do_not_count_and_are_reported(world: RecordedWorld) -> None:
    recordings = with_noise(world.recordings.of(np.array([0, 1])), 1e4)
    result = calibrate(recordings, settings=LITTLE)
    flow_maps = plain_report(result, [])["flow_maps"]
    assert flow_maps["unused_markers"] == len(DEFECTIVE)
    for key in ("before", "after", "rms"):
        assert flow_maps["fitted"][key] < 0.1  # [N]; the defective markers deviate by 10 N
    assert Problem(recordings).errors.rms.max() < 0.1
    assert any("4 of 260 markers are too noisy" in line for line in error_lines(result))


def errors(size: float, **changes: float) -> ErrorModel:
    used = np.ones(260, dtype=bool)
    used[DEFECTIVE] = False
    return ErrorModel(NOISE, np.full(4000, size), used, **changes)


def test_residuals_of_noise_and_drift_are_independent() -> None:
    model, rng = errors(0.0, drift=2e-3), np.random.default_rng(0)
    shift = np.repeat(model.drift * rng.normal(size=(4000, 2, 1, 2)), 130, axis=2)
    difference = shift.reshape(4000, 260, 2) + NOISE * rng.normal(size=(4000, 260, 2))
    residuals = model.whiten(difference, np.arange(4000))
    assert residuals.shape == (4000, 2 * 256)
    assert abs((residuals**2).mean() - 1) < 0.01
    left = residuals[:, : 2 * 128 : 2]
    assert abs(left.mean(1).var() * 128 - 1) < 0.1  # the mean of 128 independent residuals
    assert abs(residuals[:, 2 * 128 :: 2].mean(1).var() * 128 - 1) < 0.1
    np.testing.assert_allclose(0.5 * (model.robust(residuals) ** 2).sum(1), model.misfit(residuals))


def test_only_the_error_of_the_model_is_shared_by_neighbours() -> None:
    np.testing.assert_allclose(errors(0.0).num_independent, 2 * 256, rtol=1e-4)
    np.testing.assert_allclose(errors(1e3 * NOISE, model_error=0.02).num_independent, 2 * 256 / 9, rtol=0.03)


def test_the_drift_is_estimated_from_the_differences() -> None:
    model, rng = errors(0.0), np.random.default_rng(0)
    for drift in (3e-4, 1e-3):
        shift = np.repeat(drift * rng.normal(size=(8, 2, 1, 2)), 130, axis=2).reshape(8, 260, 2)
        estimated = model.estimated_drift(shift + NOISE * rng.normal(size=(8, 260, 2)))
        assert drift < estimated < 2 * drift
    assert model.estimated_drift(np.ones((8, 260, 2))) < 5e-3


def test_a_search_of_poses_has_the_cost_of_its_result(world: RecordedWorld) -> None:
    problem = Problem(with_noise(world.recordings.of(np.array([0])), 10.0), threads=1)
    problem.allow_for(drift=1e-3)
    start = find_poses(problem, problem.scene_point(), np.random.default_rng(0))
    cost, point, poses = refined_poses(problem, *start, np.random.default_rng(1), count=8)
    residuals, _ = problem.residuals(point, poses)
    assert cost == pytest.approx(problem.cost(residuals, point) + prior_cost_of_all(problem, poses[None])[0])
