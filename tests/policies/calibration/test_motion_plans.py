"""Plans of attempts: files, the information of attempts, and the covariance that plans and intervals rest on."""

import dataclasses
import functools
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import WORLD

from gelflow.cli.commands.calibrate import _run_command
from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.calibration.experiment.planned import expected_widths
from gelflow.policies.calibration.experiment.worlds import RecordedWorld, record_world
from gelflow.policies.calibration.fit import FitResult, StartResult
from gelflow.policies.calibration.model.parameters import FARTHEST
from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.model.shear_model import Descents
from gelflow.policies.calibration.planning.information import Attempts, Known, information, pose_prior, without_pose
from gelflow.policies.calibration.planning.motions import STOP_SHEAR_MM, plan_motions
from gelflow.policies.calibration.planning.suggestions import suggest
from gelflow.policies.calibration.problem import POSE_STEP, Problem, in_hole
from gelflow.policies.calibration.session_recordings import nothing_recorded
from gelflow.policies.calibration.uncertainty import covariance
from gelflow.session.motion_plan import PlannedMotion, load_motion_plan, save_motion_plan
from gelflow.sim.tasks.parts import load_part
from gelflow.task import INSERTION

LAB = nothing_recorded(INSERTION, grasp_force=12.0, grasp_height=0.0)
NEAR = (4e-3, 4e-3, 0.0)  # a workspace with few candidates
MOTIONS = (PlannedMotion(3e-3, -2e-3, 0.1, 1.1e-3), PlannedMotion(-6e-3, 0.0, -0.14, 0.9e-3, 0.25))


def test_a_plan_file_has_the_motions_that_were_written(tmp_path: Path) -> None:
    save_motion_plan(MOTIONS, tmp_path / "plan.toml", title="a test")
    read = load_motion_plan(tmp_path / "plan.toml")
    for motion, expected in zip(read, MOTIONS, strict=True):
        assert (*motion.planar_pose, motion.depth) == pytest.approx((*expected.planar_pose, expected.depth), abs=1e-6)
        assert motion.stop_shear_mm == expected.stop_shear_mm
    with pytest.raises(UsageError, match="exists; name a new file"):
        save_motion_plan(MOTIONS, tmp_path / "plan.toml", title="a test")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("format = 2", "motion plan format 2; this gelflow reads format 1"),
        ("format = 1", "the plan has no motions"),
        ("format = 1\n[[motions]]\nx = 0.0\ny = 0.0\nyaw = 5\ndepth = 1e-3", "unknown key 'yaw'; did you mean"),
        ("format = 1\n[[motions]]\nx = 0.0\ny = 0.0\nyaw_deg = 5", "motion 1: depth is missing"),
    ],
)
def test_files_that_are_no_plan_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(UsageError, match=message):
        load_motion_plan(tmp_path / "plan.toml")


def test_attempts_without_contact_have_no_information(world: RecordedWorld) -> None:
    readings = ReadingModel(world.recordings, threads=1)
    count = len(readings.fitted)
    pose = np.array([[8e-3, 0.0, 0.0], [8e-3, 0.0, 0.0]])
    attempts = Attempts(np.zeros((2, 3)), pose, np.zeros(2), np.array([0.9e-3, 0.1e-3]))
    touching, free = information(readings, np.zeros(count), attempts, 1e-4, used=LAB.used)
    for matrix in (touching, free):
        assert np.linalg.eigvalsh(matrix).min() > -1e-8 * np.abs(touching).max()
    assert np.trace(touching) > 1e3 * np.trace(free)
    known = without_pose(touching, pose_prior(INSERTION))
    assert (np.diag(known) <= np.diag(touching[:count, :count]) * (1 + 1e-9)).all()


def test_the_information_is_that_about_the_misalignment_of_the_part(world: RecordedWorld) -> None:
    """An error of the taught yaw also displaces a gripper that is beside the hole."""
    readings = ReadingModel(world.recordings, threads=1)
    point, count = np.zeros(len(readings.fitted)), len(readings.fitted)
    n, (dx, dy) = 8, 9e-3 * np.array([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)])
    misalignment, planar = np.tile((1e-3, -2e-3, 0.05), (n, 1)), np.column_stack([dx, dy, np.full(n, 0.1)])
    attempts = Attempts(misalignment, planar, np.zeros(n), np.full(n, 0.9e-3))
    found = information(readings, point, attempts, 1e-4, used=LAB.used, drift=0.0)[:, count + 2, count + 2]

    def reading(yaw: float) -> np.ndarray:
        values = {name: np.full(n, value) for name, value in readings.values(point).items()}
        pose = in_hole(misalignment + np.array([0.0, 0.0, yaw]), planar)
        return readings.read(values, Descents(pose, attempts.z, attempts.depth))[0]

    slope = (reading(POSE_STEP[2]) - reading(-POSE_STEP[2])) / 2
    bound = (slope**2).sum((1, 2)) / 1e-8  # without errors of the model and of the height
    assert (found <= bound + 1e-9).all() and found.max() > 0.01 * bound.max() > 0.1


@pytest.mark.slow
def test_a_plan_has_its_most_informative_motions_first_and_keeps_to_the_workspace() -> None:
    plan = plan_motions(LAB, count=4, workspace=NEAR, scenarios=2)
    assert len(set(plan.motions)) == len(plan.motions) == 4
    assert not any(motion.beyond(NEAR, INSERTION.descent, (0.04, STOP_SHEAR_MM)) for motion in plan.motions)
    assert plan.gains[0] == max(plan.gains) and min(plan.gains) > 0
    assert all(after <= before for before, after in plan.widths.values())
    assert plan_motions(LAB, count=1, workspace=NEAR, scenarios=2).motions == plan.motions[:1]
    with pytest.raises(UsageError, match="no motion to plan within the workspace of 1 mm"):
        plan_motions(LAB, workspace=(1e-3, 1e-3, 0.0))


def test_a_plan_without_contact_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gelflow.policies.calibration.planning.motions._CONTACT_SHEAR_MM", 1e6)
    with pytest.raises(UsageError, match="none within the workspace is expected to touch the rim"):
        plan_motions(LAB, count=2, workspace=NEAR, scenarios=1)


@pytest.mark.slow
def test_a_plan_depends_on_what_is_known_already() -> None:
    count = len(ReadingModel(LAB).fitted)
    known = Known(np.zeros(count), 1e-4 * np.eye(count), 1e-3)
    plan = plan_motions(LAB, known=known, count=2, workspace=NEAR, scenarios=3)
    unknown = plan_motions(LAB, count=2, workspace=NEAR, scenarios=3)  # in the first, no attempt has contact
    assert plan.gains[0] < 0.5 * unknown.gains[0]
    assert all(after <= before < 0.1 for before, after in plan.widths.values())


def test_no_direction_of_a_fit_is_wider_than_its_prior(world: RecordedWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    count = len(ReadingModel(LAB).fitted)
    points: list[np.ndarray] = []

    def stops(readings: ReadingModel, point: np.ndarray, poses: np.ndarray, shear: float) -> tuple[np.ndarray, ...]:
        points.append(point)
        return np.full(len(poses), 1e-3), np.ones(len(poses))

    def informed(
        readings: ReadingModel, point: np.ndarray, attempts: Attempts, *errors: object, **options: object
    ) -> np.ndarray:
        return np.tile(4.0 * np.eye(count + 3), (len(attempts.depth), 1, 1))

    monkeypatch.setattr("gelflow.policies.calibration.planning.motions._stops", stops)
    monkeypatch.setattr("gelflow.policies.calibration.planning.motions.information", informed)
    monkeypatch.setattr("gelflow.policies.calibration.planning.suggestions.information", informed)
    end = StartResult(np.full(count, 3.9), np.zeros((1, 3)), 9.0 * np.eye(count), 0.0, 1.0, 1e-3)
    known = Known(*FitResult((end,), count).joint_distribution, end.drift)
    plan = plan_motions(LAB, known=known, count=1, workspace=NEAR)
    assert 3.9 < np.max(points) <= FARTHEST
    expected = 0.5 * count * np.log(5)  # of four times the information of the prior
    assert plan.gains[0] == pytest.approx(expected)
    assert list(plan.widths.values()) == [pytest.approx((1.0, 1 / np.sqrt(5)))] * count
    suggestions = suggest(Problem(world.recordings.of(np.array([0])), threads=1), known)
    assert [s.gain for s in suggestions] == pytest.approx([expected] * 3)


def test_markers_that_no_camera_shows_have_no_information(world: RecordedWorld) -> None:
    recordings = world.recordings
    readings, count = ReadingModel(recordings), len(ReadingModel(recordings).fitted)
    attempts = Attempts(np.zeros(3), np.array([[3e-3, 0, 0]]), np.zeros(1), np.array([1e-3]))
    half = recordings.used & (np.arange(len(recordings.used)) % 2 == 0)
    whole, part = (
        information(readings, np.zeros(count), attempts, 1e-4, used=used, drift=0.0)[0]
        for used in (recordings.used, half)
    )
    assert 0 < np.trace(part) < 0.8 * np.trace(whole)


def test_planned_attempts_are_made_on_one_part_of_the_same_world(world: RecordedWorld) -> None:
    planned = record_world(WORLD, plan=[PlannedMotion(9e-3, 0.0, 0.0, 1.1e-3), PlannedMotion(0.0, 9e-3, 0.0, 1.1e-3)])
    assert planned.truth == world.truth
    assert planned.recordings.insertion.tolist() == [0, 0] and not planned.recordings.inserted
    np.testing.assert_allclose(planned.recordings.planar_pose, [[9e-3, 0, 0], [0, 9e-3, 0]])
    np.testing.assert_array_equal(planned.misalignment, world.misalignment[:1])
    more, fewer = expected_widths(world), expected_widths(world, attempts=1)
    assert all(more[name] <= fewer[name] * (1 + 1e-9) for name in more)


def test_a_planned_attempt_presses_up_to_its_own_shear() -> None:
    gentle, firm = (
        record_world(WORLD, plan=[PlannedMotion(9e-3, 0.0, 0.0, INSERTION.descent, shear)]).recordings
        for shear in (0.05, 0.2)
    )
    along = [np.abs(r.flow[0, ..., 0].mean((1, 2))).max() for r in (gentle, firm)]
    assert firm.depth[0] > gentle.depth[0] and along[1] > 2 * along[0]


@pytest.mark.slow
def test_unknown_poses_widen_the_intervals(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.array([0, 1])), threads=1)
    point = np.zeros(problem.size)
    count = len(problem.fitted)
    point[:count] = [float(p.whitened(np.array(world.truth[p.name]))) for p in problem.fitted]
    poses = world.misalignment[:2]
    line = problem.linearize(point, poses)
    chi = max(1.0, float(np.sqrt((line.residuals**2).mean())))
    residuals = line.residuals.reshape(-1)
    jacobian = line.jacobian.reshape(len(residuals), -1)
    fixed = np.linalg.inv(problem.normal_equations(residuals / chi, jacobian / chi, point)[0])
    free = covariance(problem, point, poses, chi)
    np.testing.assert_allclose(free, free.T)
    assert np.linalg.eigvalsh(free - fixed).min() > -1e-9
    assert np.trace(free[:count, :count]) > 1.01 * np.trace(fixed[:count, :count])


def test_the_command_of_a_plan_names_only_parts_that_come_with_gelflow() -> None:
    peg = load_part("peg").part
    args = Namespace(lab=None, plan=Path("plan.toml"), part=None)
    longer = dataclasses.replace(peg, size=(*peg.size[:2], peg.size[2] + 1e-3))
    for part, words in (
        (INSERTION.part, ""),
        (peg, "--part peg "),
        (dataclasses.replace(peg, name="bolt"), "--part PART.toml "),
        (longer, "--part PART.toml "),
    ):
        command = f"gelflow run insertion --lab LAB {words}--plan plan.toml --insertions 2"
        assert _run_command(args, part) == command


def test_calibrate_refuses_contradicting_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = tmp_path / "plan.toml"
    for words, message in (
        ([], "name a recorded session, or a new plan file with --plan"),
        (["--lab", "lab.toml", "a.mcap"], "--lab gives the limits of --plan"),
        (["--plan", str(plan), "--motions", "0"], "--motions must be at least 1"),
        (["a.mcap", "--motions", "3"], "--motions is the number of attempts of --plan"),
        (["--plan", str(plan), "--quick"], "--quick is for the fit of a SESSION"),
        (["a.mcap", "--seed", "-1"], "--seed must be at least 0"),
    ):
        assert main(["calibrate", *words]) == 2
        assert message in capsys.readouterr().err
    plan.write_text("mine")
    assert main(["calibrate", "--plan", str(plan)]) == 2
    assert "exists; name a new file with --plan" in capsys.readouterr().err
    assert plan.read_text() == "mine"


@pytest.mark.slow
def test_calibrate_writes_a_plan_within_the_workspace_of_the_lab(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gelflow.cli.commands.calibrate.plan_motions", functools.partial(plan_motions, scenarios=2))
    example = Path(__file__).parents[3] / "real" / "runner" / "lab_example.toml"
    lab, plan = tmp_path / "lab.toml", tmp_path / "plan.toml"
    lab.write_text(example.read_text().replace("# x = 0.016 ", "x = 0.004 ").replace("# y = 0.016 ", "y = 0.004 "))
    lab.write_text(lab.read_text().replace("# planned_stop_shear_mm = 0.25", "planned_stop_shear_mm = 0.2"))
    assert main(["calibrate", "--plan", str(plan), "--lab", str(lab), "--motions", "2"]) == 0
    command = f"gelflow run insertion --lab {lab} --plan {plan} --insertions 2"
    assert f"record it with: {command}" in capsys.readouterr().out
    motions = load_motion_plan(plan)
    assert len(motions) == 2
    assert not any(m.beyond((4e-3, 4e-3, 0.28), INSERTION.descent, (0.04, 0.2)) for m in motions)
    assert [m.stop_shear_mm for m in motions] == [0.2, 0.2]
