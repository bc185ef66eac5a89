"""Motion plans on the mock robot: poses, touch stop, the recording, and refusals before anything moves."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from tests.real.runner.harness import plan_for

from gelflow.cli.main import main
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.observation import FlowMap
from gelflow.policies.calibration.planning.motions import STOP_SHEAR_MM
from gelflow.policies.calibration.session_recordings import read_recordings
from gelflow.real.runner import PlanPolicy
from gelflow.real.runner.insertion.planned_motions import check_motions
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import run_insertions
from gelflow.session.motion_plan import PlannedMotion, save_motion_plan
from gelflow.session.reader import SessionReader
from gelflow.task import INSERTION

EXAMPLE = Path(__file__).parents[3] / "real" / "runner" / "lab_example.toml"
MOTIONS = (PlannedMotion(9e-3, 3e-3, math.radians(5), 1.1e-3), PlannedMotion(2e-3, -9e-3, math.radians(-4), 1.1e-3))


def test_the_corrections_of_a_plan_lead_from_pose_to_pose() -> None:
    policy = PlanPolicy(MOTIONS)
    image = np.zeros(INSERTION.observation_shape, np.float32)
    seen = FlowMap(image, 1.0, "mm", np.zeros((2, 1, 1), bool))
    policy.reset()
    moved = INSERTION.corrected(np.array(MOTIONS[0].planar_pose), policy.act(seen))
    np.testing.assert_allclose(moved, MOTIONS[1].planar_pose, atol=1e-12)
    np.testing.assert_array_equal(policy.act(seen), 0)  # the last motion


def test_a_plan_is_made_and_recorded_for_a_calibration(robot: MockRobot, tmp_path: Path) -> None:
    plan = plan_for(robot, tmp_path, PlanPolicy(MOTIONS))
    (result,) = run_insertions(plan)
    assert result.outcome == "plan complete" and result.successful and not result.inserted
    assert len(result.attempts) == len(MOTIONS)
    for attempt, motion in zip(result.attempts, MOTIONS, strict=True):
        assert attempt.planar_pose == pytest.approx(motion.planar_pose, abs=1e-9)
        assert attempt.contact and attempt.stopped_by_contact and attempt.depth < motion.depth  # the touch stop holds
    read = read_recordings([plan.session])
    np.testing.assert_allclose(read.planar_pose, [motion.planar_pose for motion in MOTIONS], atol=1e-9)
    assert read.insertion.tolist() == [0, 0] and not read.inserted
    with SessionReader(plan.session) as session:
        assert session.description()["checkpoint"] is None


def test_contact_stops_a_planned_descent_at_its_own_shear(robot: MockRobot, tmp_path: Path) -> None:
    x, y, yaw = MOTIONS[0].planar_pose
    motions = tuple(PlannedMotion(x, y, yaw, INSERTION.descent, shear) for shear in (None, 0.2))
    (result,) = run_insertions(plan_for(robot, tmp_path, PlanPolicy(motions)))
    assert result.outcome == "plan complete"
    usual, firm = result.attempts
    assert usual.stopped_by_contact and firm.stopped_by_contact and not firm.slipped
    assert usual.shear < 0.2 < firm.shear and usual.depth < firm.depth < INSERTION.descent


def test_a_lab_with_a_larger_stop_shear_needs_no_limit_of_plans(tmp_path: Path) -> None:
    lab = tmp_path / "lab.toml"
    text = EXAMPLE.read_text().replace("# stop_shear_mm = 0.12", "stop_shear_mm = 0.5")
    lab.write_text(text.replace("# contact_shear_mm = 0.04", "contact_shear_mm = 0.3"))
    read = load_lab(lab)
    assert read.descent.largest_stop_shear_mm == 0.5
    check_motions((PlannedMotion(0.0, 0.0, 0.0, 1e-3, 0.5), PlannedMotion(0.0, 0.0, 0.0, 1e-3)), read, INSERTION)
    assert load_lab(EXAMPLE).descent.largest_stop_shear_mm == STOP_SHEAR_MM == 0.25


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (PlannedMotion(0.02, 0.0, 0.0, 1e-3), r"motion 1 of the plan: \|x\| is 20, at most 15 mm"),
        (PlannedMotion(0.0, 0.0, 0.4, 1e-3), r"\|yaw\| is 22.92, at most 15 °"),
        (PlannedMotion(0.0, 0.0, 0.0, 5e-3), "depth is 5, must be above 0 and at most 4.1 mm"),
        (PlannedMotion(0.0, 0.0, 0.0, 0.0), "depth is 0, must be above 0"),
        (PlannedMotion(0.0, 0.0, 0.0, 1e-3, 0.5), "stop_shear_mm is 0.5, must be above 0.04 and at most 0.25 mm"),
        (PlannedMotion(0.0, 0.0, 0.0, 1e-3, 0.01), "stop_shear_mm is 0.01, must be above 0.04"),
    ],
)
def test_plans_beyond_the_limits_are_refused(
    tmp_path: Path, motion: PlannedMotion, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_motion_plan((motion,), tmp_path / "plan.toml", title="a test")
    words = ["run", "insertion", "--lab", str(EXAMPLE), "--plan", str(tmp_path / "plan.toml")]
    assert main([*words, "--out", str(tmp_path / "session")]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert len(error.strip().splitlines()) == 1 and not (tmp_path / "session").exists()


def test_a_plan_has_no_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "insertion", "--lab", str(EXAMPLE), "--plan", "p.toml", "--checkpoint", "c.safetensors"]
    assert main(words) == 2
    assert "--plan replaces the policy of --checkpoint" in capsys.readouterr().err
