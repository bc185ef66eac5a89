"""Which parameters a calibration calls known: those of a fit that reproduces the recordings and predicts others."""

import dataclasses
import math

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import LITTLE

from gelflow.policies.calibration import calibration
from gelflow.policies.calibration.calibrated_randomization import calibrated_randomization
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.fit import FitResult, StartResult
from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.policies.calibration.pose_search import find_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.report import error_lines, plain_report


def confirmed(result: Calibration) -> set[str]:
    return {estimate.parameter.name for estimate in result.estimates if estimate.confirmed}


def test_forces_count_only_if_the_held_out_insertion_is_predicted(
    world: RecordedWorld, calibrated: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "fit", lambda *args, **options: calibrated.fit)
    monkeypatch.setattr(calibration, "REPRODUCED", math.inf)
    monkeypatch.setattr(calibration, "PREDICTED", 0.0)
    fitted = Problem(world.recordings, threads=1).fitted
    once = calibrate(world.recordings.of(np.array([0, 1])), settings=LITTLE)

    def with_present_limits() -> Calibration:
        estimates = calibration._estimates(fitted, once.fit, predicted=once.predicted is not False)
        return dataclasses.replace(once, estimates=estimates)

    assert with_present_limits().estimates == once.estimates and confirmed(once)
    for limit in (0.0, math.inf):
        monkeypatch.setattr(calibration, "PREDICTED", limit)
        result = with_present_limits()
        every = {estimate.parameter.name for estimate in result.estimates}
        assert every > set(QUANTITIES)
        assert confirmed(result) == (every if limit else every - set(QUANTITIES)) and result.predicted is (limit > 0)
        assert any("does not predict the held-out insertion" in line for line in error_lines(result)) is (limit == 0)
        assert plain_report(result, [])["flow_maps"]["predicted"] is (limit > 0)
        # Plans start from what is confirmed, and from the priors of the rest.
        assert result.known is not None
        mean, covariance = result.fit.joint_distribution
        for i, parameter in enumerate(result.parameters):
            if limit or parameter.name not in QUANTITIES:
                assert (result.known.mean[i], result.known.covariance[i, i]) == (mean[i], covariance[i, i])
            else:
                assert result.known.mean[i] == 0
                np.testing.assert_array_equal(result.known.covariance[i], np.eye(len(mean))[i])
    monkeypatch.setattr(calibration, "REPRODUCED", 0.0)
    assert not confirmed(with_present_limits()) and with_present_limits().known is None


def test_starts_that_end_at_different_costs_widen_the_intervals() -> None:
    def width(*costs: float) -> float:
        starts = [StartResult(np.zeros(4), np.zeros((2, 3)), np.eye(4), cost, 1.0, 1e-3) for cost in costs]
        low, high = FitResult(tuple(starts), 2).interval(np.eye(2))
        return float((high - low)[0] / (2 * 1.96))

    assert width(7.0) == width(7.0, 7.0) == pytest.approx(1)
    assert width(7.0, 12.0) == width(7.0, 8.0, 12.0, 20.0) == pytest.approx(math.sqrt(2))


def test_nothing_counts_as_known_unless_more_than_half_of_the_starts_agree(
    calibrated: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "REPRODUCED", math.inf)
    fitted = calibrated.parameters
    for used, others in ((1, 0), (2, 1), (1, 1), (2, 2)):
        fit = dataclasses.replace(calibrated.fit, starts=used * (calibrated.fit.best,), others=others)
        estimates = calibration._estimates(fitted, fit, predicted=True)
        result = dataclasses.replace(calibrated, fit=fit, estimates=estimates)
        assert result.converged is bool(confirmed(result)) is bool(calibrated_randomization(result)["samples"])
        assert result.converged is (used > others) is plain_report(result, [])["flow_maps"]["converged"]
        assert (result.known is None) is not result.converged
        line = f"only {used} of {used + others} starts of the fit reached this residual"
        assert any(line in text for text in error_lines(result)) is not result.converged


def test_one_insertion_holds_nothing_out(
    world: RecordedWorld, calibrated: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The fit of the first insertion, whether or not another one is held out.
    monkeypatch.setattr(calibration, "fit", lambda *args, **options: calibrated.fit)
    result = calibrate(world.recordings.of(np.array([0])), settings=LITTLE)
    assert result.held_out_residual is None and result.predicted is None


@pytest.mark.slow
def test_the_held_out_residual_tells_the_true_parameters_from_others(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.array([4])), threads=1)
    truth = np.array([float(p.whitened(np.array(world.truth[p.name]))) for p in problem.fitted])
    others = truth + np.random.default_rng(0).choice([-1.0, 1.0], (3, len(truth)))
    rng = np.random.default_rng(1)
    right, *wrong = (problem.errors.chi(problem.residuals(*find_poses(problem, p, rng))[0]) for p in (truth, *others))
    assert right < 1 and min(wrong) > calibration.PREDICTED


def test_an_insertion_that_cannot_be_simulated_has_the_error_of_no_motion(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.array([4])), threads=1)
    parameters = np.zeros(len(problem.fitted))
    names = [parameter.name for parameter in problem.fitted]
    parameters[names.index("pad_kn")] = -6.0  # pads of 4 N/m do not hold the part
    found = find_poses(problem, parameters, np.random.default_rng(0))
    assert np.isfinite(found[0]).all() and np.isfinite(found[1]).all()
    np.testing.assert_array_equal(problem.flow(*found), 0.0)
