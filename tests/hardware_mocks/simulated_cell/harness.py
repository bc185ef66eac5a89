"""Shared helpers of the tests of the simulated cell, which they step without a clock."""

from typing import Any

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig

PlanarPose = tuple[float, float, float]


def grasped(config: SimulatedCellConfig) -> SimulatedCell:
    """A cell whose gripper has grasped the first part."""
    cell = SimulatedCell(ScaledClock(), config)
    cell.advance(100)
    cell.command_gripper(width=0.032, speed=0.1, force=12.0)
    cell.advance(120)
    return cell


def go(cell: SimulatedCell, target: PlanarPose, height: float, *, steps: int) -> None:
    """Move the gripper at constant speed to a planar pose about the taught hole, the lower face at `height` [m]."""
    config = cell.config
    x, y, yaw = target
    goal = Pose(np.array([x, y, height + config.grasp_height]), yaw_quaternion(yaw))
    now = config.taught_hole.inverse() @ (Pose(*cell.arm_pose()) @ config.tool)
    for share in np.linspace(0, 1, steps + 1)[1:]:
        position = now.position + share * (goal.position - now.position)
        turned = yaw_quaternion(now.yaw + share * (yaw - now.yaw))
        pose = config.taught_hole @ Pose(position, turned) @ config.tool.inverse()
        cell.command_arm(pose.position, pose.quaternion)
        cell.advance(1)


def aligned_pose(part: dict[str, Any]) -> PlanarPose:
    """Planar pose relative to the taught hole at which the gripper is aligned with the true hole."""
    x, y, yaw = part["misalignment"]
    pose = Pose(np.array([x, y, 0.0]), yaw_quaternion(yaw)).inverse()
    return float(pose.position[0]), float(pose.position[1]), pose.yaw
