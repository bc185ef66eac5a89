"""The randomization of a training after a calibration: samples of the joint distribution in which the fit ends."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.calibration.calibrated_randomization import SAMPLES, calibrated_randomization, read_randomization
from gelflow.policies.calibration.calibration import Calibration
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.fit import FitResult, StartResult
from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.policies.calibration.report import plain_report
from gelflow.session.records import readable_json
from gelflow.sim.tasks.insertion_randomization import DEFAULT_RANDOMIZATION
from gelflow.sim.tasks.parts import load_part
from gelflow.sim.tasks.registry import make_task
from gelflow.task import INSERTION

SENSORS = {"gain_ratio", "turn_left", "turn_right", "crosstalk"}


def start(point: Any, covariance: Any, chi: float = 1.0) -> StartResult:
    return StartResult(np.asarray(point, float), np.zeros((2, 3)), np.asarray(covariance, float), 7.0, chi, 1e-3)


def confirmed(result: Calibration, *starts: StartResult, predicted: bool = True) -> Calibration:
    """The calibration as if it were good, with other ends of its starts; without `predicted` only for its sensors."""
    estimates = tuple(
        dataclasses.replace(e, confirmed=predicted or e.parameter.name not in QUANTITIES) for e in result.estimates
    )
    ends = starts or (dataclasses.replace(result.fit.best, chi=1.0),)
    return dataclasses.replace(result, estimates=estimates, fit=FitResult(ends, result.fit.count))


def test_the_joint_distribution_includes_what_starts_disagree_about() -> None:
    narrow = np.diag([0.01, 4.0, 0.01])
    fit = FitResult((start([0.5, 0, 0], narrow), start([-0.5, 0, 0], narrow)), 3)
    mean, covariance = fit.joint_distribution
    np.testing.assert_allclose(mean, 0)
    np.testing.assert_allclose(covariance, np.diag([0.51, 1, 0.01]), atol=1e-12)  # none is wider than its prior
    drawn = fit.draw(np.random.default_rng(0), 4000)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.05)


def test_parameters_that_only_their_combination_determines_are_drawn_together(calibrated: Calibration) -> None:
    n = calibrated.fit.count
    names = [e.parameter.name for e in calibrated.estimates]
    i, k = names.index("pad_ks"), names.index("grasp_force")
    covariance = 1e-6 * np.eye(n)
    covariance[np.ix_([i, k], [i, k])] += 0.5 * np.array([[1, -1], [-1, 1]])
    samples = calibrated_randomization(confirmed(calibrated, start(np.zeros(n), covariance)))["samples"]
    drawn = {name: np.log(samples[name]) for name in ("pad_ks", "grasp_force", "pad_kn")}
    assert np.corrcoef(drawn["pad_ks"], drawn["grasp_force"])[0, 1] < -0.999
    assert drawn["pad_ks"].std() > 100 * drawn["pad_kn"].std()
    table = make_task("insertion", 1, threads=1, samples=samples).attempts.randomization  # type: ignore[attr-defined]
    values = table.sample(np.random.default_rng(1), 50, friction="elastic")
    together = set(zip(samples["pad_ks"], samples["grasp_force"], strict=True))
    assert set(zip(values["pad_ks"], values["grasp_force"], strict=True)) <= together


def test_samples_stay_within_three_times_the_ranges(calibrated: Calibration) -> None:
    n = calibrated.fit.count
    wide = confirmed(calibrated, start(np.full(n, 1.5), np.eye(n)))
    samples = calibrated_randomization(wide)["samples"]
    assert set(samples) == {*QUANTITIES, *SENSORS} and len({len(values) for values in samples.values()}) == 1
    assert max(samples["pad_kn"]) == pytest.approx(3 * 1.4e4, rel=1e-4)
    assert min(samples["crosstalk"]) == 0


def test_limits_do_not_change_combinations_that_are_known(calibrated: Calibration) -> None:
    n = calibrated.fit.count
    names = [e.parameter.name for e in calibrated.estimates]
    i, k = names.index("pad_ks"), names.index("grasp_force")
    covariance = 1e-6 * np.eye(n)
    covariance[np.ix_([i, k], [i, k])] += np.array([[1, -1], [-1, 1]])
    mean = np.zeros(n)
    mean[i] = 1.5  # close to the limit of 3 ** 0.5: nearly half of the distribution is beyond
    samples = calibrated_randomization(confirmed(calibrated, start(mean, covariance)))["samples"]
    whitened = [calibrated.parameters[j].whitened(np.array(samples[names[j]])) for j in (i, k)]
    np.testing.assert_allclose(whitened[0] + whitened[1], 1.5, atol=0.01)
    assert len(samples["pad_ks"]) == SAMPLES and whitened[0].max() <= 3**0.5 + 1e-3


def test_the_gain_of_both_pads_multiplies_the_stiffness_of_the_markers(calibrated: Calibration) -> None:
    n, fitted = calibrated.fit.count, calibrated.parameters
    point = np.zeros(n)
    for i, p in enumerate(fitted):
        if p.name.startswith("gain"):
            point[i] = p.whitened(np.array(1.5 if p.name == "gain_left" else 1.2))
    samples = calibrated_randomization(confirmed(calibrated, start(point, 1e-12 * np.eye(n))))["samples"]
    center = {p.name: p.center for p in fitted}
    assert samples["marker_ks"][0] == pytest.approx(center["marker_ks"] * np.sqrt(1.5 * 1.2), rel=1e-3)
    assert samples["marker_kn"][0] == pytest.approx(center["marker_kn"] * np.sqrt(1.5 * 1.2), rel=1e-3)
    assert samples["gain_ratio"][0] == pytest.approx(1.2 / 1.5, rel=1e-3)


def test_what_a_calibration_does_not_confirm_is_not_drawn(calibrated: Calibration) -> None:
    assert set(calibrated_randomization(confirmed(calibrated, predicted=False))["samples"]) == SENSORS
    poor = dataclasses.replace(calibrated.fit.best, chi=2.0)
    assert calibrated_randomization(confirmed(calibrated, poor)) == {"ranges": {}, "samples": {}}


def test_noise_and_stop_shear_are_those_of_the_recordings(calibrated: Calibration, world: RecordedWorld) -> None:
    good = confirmed(calibrated)
    ranges = calibrated_randomization(good)["ranges"]
    low, high = ranges["noise"]
    assert low < world.noise / np.sqrt(2) < high < 5 * low
    low, high = ranges["stop_shear"]
    along = np.abs(calibrated.recordings.flow[..., 0].mean((2, 3))).max(1)
    assert 0 < low <= high == pytest.approx(along.max(), rel=1e-3)
    planned = dataclasses.replace(calibrated.recordings, planned=np.ones(len(calibrated.recordings), dtype=bool))
    assert "stop_shear" not in calibrated_randomization(dataclasses.replace(good, recordings=planned))["ranges"]
    some = planned.planned.copy()
    some[along.argmin()] = False
    one = dataclasses.replace(planned, planned=some)
    assert one.stop_shear() == pytest.approx((along.min(), along.min()))
    assert one.of(np.array([0])).planned.tolist() == some[one.insertion == 0].tolist()


def written(path: Path, **changes: Any) -> Path:
    """A report with little in it."""
    samples = {"arm_stiffness": [8e3, 9e3], "grasp_height": [-1e-3, 2e-3]}
    randomization = {"ranges": {"noise": [1e-4, 2e-4]}, "samples": samples, **changes}
    values = {"format": 2, "part": INSERTION.part.to_json(), "randomization": randomization}
    path.write_text(json.dumps(values))
    return path


def test_training_draws_what_a_report_contains(tmp_path: Path, calibrated: Calibration) -> None:
    file = tmp_path / "report.json"
    good = confirmed(calibrated)
    file.write_text(readable_json(plain_report(good, [])))
    assert all(len(line) < 4000 for line in file.read_text().splitlines()) and len(file.read_text().splitlines()) < 500
    options = read_randomization(file, INSERTION)
    assert options == calibrated_randomization(good)
    table = make_task("insertion", 1, threads=1, **options).attempts.randomization  # type: ignore[attr-defined]
    drawn = table.sample(np.random.default_rng(0), 100, friction="elastic")
    assert set(drawn["pad_kn"]) <= set(options["samples"]["pad_kn"])
    assert (
        options["ranges"]["noise"][0] <= drawn["noise"].min() <= drawn["noise"].max() <= options["ranges"]["noise"][1]
    )
    assert table["marker_kd"] == DEFAULT_RANDOMIZATION["marker_kd"]
    rows = {row["quantity"]: row for row in table.rows()}
    assert rows["pad_kn"]["distribution"] == "Samples" and rows["pad_kn"]["low"] == min(options["samples"]["pad_kn"])


def test_the_grasp_height_of_another_part_is_not_taken(tmp_path: Path) -> None:
    file = written(tmp_path / "report.json")
    assert set(read_randomization(file, INSERTION)["samples"]) == {"arm_stiffness", "grasp_height"}
    assert set(read_randomization(file, load_part("peg"))["samples"]) == {"arm_stiffness"}
    moved = dataclasses.replace(INSERTION, part=dataclasses.replace(INSERTION.part, mesh_file="/elsewhere/part.stl"))
    assert set(read_randomization(file, moved)["samples"]) == {"arm_stiffness", "grasp_height"}


@pytest.mark.slow
def test_training_with_a_calibration_stores_what_it_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = written(tmp_path / "report.json"), tmp_path / "run"
    options = ["--attempts", "256", "--envs", "64", "--out", str(out)]
    assert main(["train", "insertion", "--calibration", str(file), *options]) == 0
    stored = json.loads((out / "run.json").read_text())
    chosen = stored["configuration"]["options"]
    assert chosen["ranges"] == {"noise": [1e-4, 2e-4]} and chosen["samples"]["arm_stiffness"] == [8e3, 9e3]
    assert str(file) in stored["command"]
    capsys.readouterr()
    written(file, samples={"arm_stiffness": [8e3] * 20})
    assert main(["train", "insertion", "--calibration", str(file), *options]) == 2
    assert len(capsys.readouterr().err) < 500


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": {}}, "determine nothing about the randomization"),
        ({"ranges": {"arm": [1, 2]}}, "no quantity 'arm'"),
        ({"ranges": {"pad_mu": [2, 1]}}, "pad_mu: a range must be"),
        ({"samples": {"pad_my": [1.0]}}, "no quantity 'pad_my'"),
        ({"samples": {"pad_mu": [1.0, 2.0], "pad_kn": [5e3]}}, "equally many samples"),
        ({"samples": {"arm_stiffness": [8e3, -9e3]}}, "samples of arm_stiffness must be positive, got -9000"),
        ({"samples": {"gain_ratio": [1.0, 0.0]}}, "samples of gain_ratio must be positive, got 0"),
        ({"samples": {"crosstalk": [0.0, -0.1]}}, "samples of crosstalk must be positive"),
        ({"samples": {"pad_mu": "123"}}, "is not the report.json of gelflow calibrate"),
        ({"samples": {"pad_mu": [10**400]}}, "is not the report.json of gelflow calibrate"),
        ({"samples": {"pad_mu": []}}, "pad_mu: samples must be finite numbers"),
        ({"samples": {"pad_mu": "abc"}}, "is not the report.json of gelflow calibrate"),
        ({"samples": [1.0]}, "is not the report.json of gelflow calibrate"),
    ],
)
def test_invalid_samples_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read_randomization(written(tmp_path / "report.json", **changes), INSERTION)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "is not the report.json of gelflow calibrate"),
        ("[]", "is not the report.json of gelflow calibrate"),
        ('{"format": 1, "randomization": {}}', "format must be 2, got 1; repeat gelflow calibrate"),
    ],
)
def test_files_that_are_no_calibration_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(UsageError, match=message):
        read_randomization(tmp_path / "report.json", INSERTION)
    with pytest.raises(UsageError, match="cannot read the calibration"):
        read_randomization(tmp_path / "missing.json", INSERTION)
