"""Cameras that repeat their images: a run that relies on them stops, and no part is called inserted."""

from pathlib import Path

import pytest
from tests.real.runner.harness import BackgroundRun, OraclePolicy, events, moving, plan_for, wait_for

from gelflow.errors import PeerTimeout
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.real.runner.run_plan import run_insertions


@pytest.mark.parametrize(("fingers", "loop"), [((0, 1), 1), ((1,), 3)])
def test_cameras_that_freeze_while_a_part_is_moved_end_the_run(
    robot: MockRobot, tmp_path: Path, fingers: tuple[int, ...], loop: int
) -> None:
    plan = plan_for(robot, tmp_path, OraclePolicy(robot))
    finish = BackgroundRun(lambda: run_insertions(plan))
    wait_for(lambda: moving(robot), during=finish)
    for finger in fingers:
        robot.cameras[finger].begin_fault(1, "freeze", {"loop": loop})
    begun, height = robot.clock.now(), robot.cell.truth()["part"]["height"]
    with pytest.raises(PeerTimeout, match=r"camera (left|right): repeats the same image \(\d+ times\).*frozen"):
        finish()
    truth = robot.cell.truth()["part"]
    assert truth["phase"] == "gripped" and not truth["inserted"]
    recorded = events(plan.session)
    stopped = next(values["at"] for name, values in recorded if name == "arm hold" and values["at"] > begun)
    print(f"held {stopped - begun:.2f} s after the freeze, {1e3 * (height - truth['height']):.2f} mm lower")
    # 250 ms of robot time, and the delay of this computer; the time limit of a silent camera is 12 s here.
    assert stopped - begun < 3.0
    assert height - truth["height"] < 3.0 * plan.lab.arm.max_speed
