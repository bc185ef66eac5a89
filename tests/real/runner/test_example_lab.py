"""The speeds and thresholds of the example lab file, against a controller with MaxSpeedDeviation 1."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gelflow.real
from gelflow.geometry import Pose
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.kinematics import inverse
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.supervisor import Supervisor

EXAMPLE = load_lab(Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml")

ARM_PAGE = Path(__file__).parents[3] / "docs" / "guide" / "arm.md"


def test_rapid_program_of_the_arm_page_starts_above_the_hole_of_the_example() -> None:
    program = ARM_PAGE.read_text()
    assert "tFlange := [TRUE, [[0,0,0],[1,0,0,0]]" in program and r"EGMActPose egm \Tool:=tFlange" in program
    found = re.search(r"pAbove := \[\[(.*?)\],\[(.*?)\],\[(.*?)\]", program)
    assert found
    position, quaternion, configuration = (np.array(row.split(","), float) for row in found.groups())
    flange = Pose(position * 1e-3, quaternion)
    gripper = EXAMPLE.gripper_pose(flange.position, flange.quaternion)
    supervisor = Supervisor(EXAMPLE)
    supervisor.check(gripper, gripper, speed=1e-3, turn_speed=1e-3)
    expected = (0, 0, 0, EXAMPLE.part.load_height)
    assert supervisor.hole_coordinates(gripper) == pytest.approx(expected, abs=1e-9)
    joints = inverse(tuple(flange.position), tuple(flange.quaternion), near=(0.0,) * 6)
    quadrants = [math.floor(joints[joint] / (math.pi / 2) + 1e-9) for joint in (0, 3, 5)]
    assert quadrants == list(configuration[:3])


def test_the_mock_robot_runs_at_the_speeds_of_the_example(robot: MockRobot) -> None:
    """20 mm/s and 10°/s exceed what the controller follows: the first correction in yaw ended in a time-out."""
    lab = lab_for(robot)
    own = lab.arm
    assert (EXAMPLE.arm.max_speed, EXAMPLE.arm.max_turn_speed_deg, EXAMPLE.arm.joint_speed_deg) == (0.02, 10.0, 1.0)
    assert own == replace(EXAMPLE.arm, egm_port=own.egm_port, host=own.host, connect_timeout=own.connect_timeout)
    assert (lab.workspace, lab.descent) == (EXAMPLE.workspace, EXAMPLE.descent)
