"""Supervisor: invalid targets are refused, never clamped; latches persist."""

import math
from pathlib import Path

import numpy as np
import pytest

import gelflow.real
from gelflow.errors import SafetyError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.protocols import ArmState
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.phases import with_advice
from gelflow.real.runner.supervisor import Supervisor, TargetBound, not_ready_reason

LAB: Lab = load_lab(Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml")


def gripper(x: float = 0.0, y: float = 0.0, height: float = 0.03, yaw: float = 0.0) -> Pose:
    above = np.array([x, y, height + LAB.part.grasp_height])
    return LAB.hole.pose @ Pose(above, yaw_quaternion(yaw))


def check(target: Pose, previous: Pose | None = None, *, speed: float = 0.01, turn_speed: float = 0.1) -> Pose:
    before = gripper() if previous is None else previous
    return Supervisor(LAB).check(target, before, speed=speed, turn_speed=turn_speed)


def test_valid_target_is_not_changed() -> None:
    target = gripper(0.015, -0.015, 0.026, math.radians(15))
    tool = check(target)
    back = LAB.gripper_pose(tool.position, tool.quaternion)
    assert back.position == pytest.approx(target.position, abs=1e-12)
    assert back.yaw == pytest.approx(target.yaw)


def test_a_measured_pose_just_beyond_the_workspace_may_be_raised() -> None:
    beyond = gripper(x=0.01605, y=-0.01609, yaw=math.radians(-16.05))
    supervisor = Supervisor(LAB)
    back = supervisor.within_workspace(beyond)
    x, y, yaw, height = supervisor.hole_coordinates(back)
    assert (x, y, math.degrees(yaw), height) == pytest.approx((0.016, -0.016, -16.0, 0.03), abs=1e-9)
    check(back @ Pose(np.array([0.0, 0.0, 5e-3]), yaw_quaternion(0.0)), beyond)
    for pose in (gripper(x=0.0162), gripper(x=0.01)):
        assert supervisor.within_workspace(pose).position == pytest.approx(pose.position, abs=1e-12)


@pytest.mark.parametrize(
    ("target", "named"),
    [
        (gripper(x=0.0161), r"x 16\.1 mm is outside -16 to 16 mm"),
        (gripper(x=-0.05), r"x -50 mm"),
        (gripper(y=0.0161), r"refused: y 16\.1 mm"),
        (gripper(yaw=math.radians(-16.1)), r"yaw -16\.1 °"),
        (gripper(height=0.0005), r"height 0\.5 mm is outside 1 to 60 mm"),
        (gripper(height=0.061), "height"),
        (gripper(x=math.nan), "not finite"),
        (gripper(height=math.inf), "not finite"),
        (Pose(gripper().position, np.array([1.0, 0.1, 0.0, 0.0])), "length 1"),
        (Pose(gripper().position, np.array([math.cos(0.01), math.sin(0.01), 0.0, 0.0])), "tilt"),
    ],
)
def test_target_outside_the_workspace_is_refused(target: Pose, named: str) -> None:
    with pytest.raises(SafetyError, match=named):
        check(target)


def test_large_steps_and_high_speeds_are_refused() -> None:
    with pytest.raises(SafetyError, match=r"step 57 mm is outside 0 to 50 mm"):
        check(gripper(height=0.059), gripper(height=0.002))
    with pytest.raises(SafetyError, match=r"speed 21 mm/s is outside 0 to 20 mm/s"):
        check(gripper(), speed=0.021)
    with pytest.raises(SafetyError, match=r"turning speed 11\.46 °/s is outside 0 to 10 °/s"):
        check(gripper(), turn_speed=0.2)
    for speed in (0.0, -1.0, math.nan):
        with pytest.raises(SafetyError, match="speed"):
            check(gripper(), speed=speed)


def test_bounds_of_the_last_target_are_known_also_when_it_is_refused() -> None:
    supervisor = Supervisor(LAB)
    supervisor.check(gripper(x=0.003), gripper(), speed=0.01, turn_speed=0.1)
    assert all(bound.ok for bound in supervisor.last_bounds)
    assert supervisor.last_bounds[0].text == "3 mm, allowed -16 to 16 mm"
    assert TargetBound("turn", 1.4e-14, 0.0, 35.0, "°").text == "0 °, allowed 0 to 35 °"
    with pytest.raises(SafetyError):
        supervisor.check(gripper(y=0.02, height=0.07), gripper(), speed=0.01, turn_speed=0.1)
    assert [bound.name for bound in supervisor.last_bounds if not bound.ok] == ["y", "height"]


def test_latch_keeps_its_first_reason() -> None:
    supervisor = Supervisor(LAB)
    supervisor.latch("emergency stop")
    supervisor.latch("something later")
    with pytest.raises(SafetyError, match="latched: emergency stop"):
        supervisor.check(gripper(), gripper(), speed=0.01, turn_speed=0.1)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({}, ""),
        ({"motors_on": False}, "motors are off"),
        ({"running": False}, "not running"),
        ({"fault": "EGM was restarted"}, "EGM was restarted"),
        ({"operating_mode": "manual full"}, "manual full"),
    ],
)
def test_arm_states_that_forbid_motion(values: dict[str, object], reason: str) -> None:
    good = {"motors_on": True, "running": True, "operating_mode": "auto", "fault": ""}
    state = ArmState(np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(6), 0.0, **{**good, **values})  # type: ignore[arg-type]
    assert reason in not_ready_reason(state) and bool(not_ready_reason(state)) == bool(reason)
    supervisor = Supervisor(LAB)
    if reason:
        with pytest.raises(SafetyError):
            supervisor.watch(state)
        assert supervisor.latched
    else:
        supervisor.watch(state)


def test_the_advice_after_a_stop_is_given_once() -> None:
    text = "stopped: a button; inspect the robot, then start a new run"
    assert with_advice(text) == with_advice("stopped: a button") == text
