"""Kinematic plants against closed forms."""

import math

import numpy as np
import pytest
from tests.common.manual_clock import ManualClock

from gelflow.errors import UsageError
from gelflow.hardware_mocks.plant import ArmPlant, GripperPlant, KinematicArm, KinematicGripper


def test_fingers_move_at_their_speed_and_stop_at_target_part_and_end() -> None:
    clock = ManualClock()
    gripper = KinematicGripper(clock, width=0.050)
    plant: GripperPlant = gripper
    plant.command_gripper(width=0.040, speed=0.020, force=30)
    clock.sleep(0.25)
    assert plant.gripper_state() == pytest.approx((0.045, -0.020, 0.0))
    clock.sleep(1.0)
    assert plant.gripper_state() == pytest.approx((0.040, 0.0, 0.0))
    gripper.set_part(0.025)
    plant.command_gripper(width=0.020, speed=0.020, force=30)
    clock.sleep(5.0)
    assert plant.gripper_state() == pytest.approx((0.025, 0.0, 30.0))
    gripper.set_part(None)
    clock.sleep(5.0)
    assert plant.gripper_state() == pytest.approx((0.020, 0.0, 0.0))
    plant.command_gripper(width=0.200, speed=0.100, force=10)
    clock.sleep(5.0)
    assert plant.gripper_state() == pytest.approx((KinematicGripper.STROKE, 0.0, 10.0))


def test_parts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match="part_width"):
        KinematicGripper(ManualClock(), width=0.02, part_width=0.03)
    with pytest.raises(UsageError, match="width"):
        KinematicGripper(ManualClock(), width=0.12)
    with pytest.raises(UsageError, match="fit"):
        KinematicGripper(ManualClock(), width=0.02).set_part(0.03)


def test_arm_follows_with_exponential_lag_for_any_steps() -> None:
    clock = ManualClock()
    upright = np.array([0.0, 1.0, 0.0, 0.0])
    arm: ArmPlant = KinematicArm(clock, position=np.zeros(3), quaternion=upright, lag=0.1)
    turned = np.array([0.0, math.cos(0.1), math.sin(0.1), 0.0])
    arm.command_arm(np.array([0.01, 0.0, -0.02]), -turned)  # the same rotation as +turned
    for _ in range(4):
        clock.sleep(0.05)
        arm.arm_pose()
    position, quaternion = arm.arm_pose()
    assert position == pytest.approx(np.array([0.01, 0.0, -0.02]) * (1 - math.exp(-2.0)))
    clock.sleep(2.0)
    position, quaternion = arm.arm_pose()
    assert position == pytest.approx([0.01, 0.0, -0.02], abs=1e-9)
    assert abs(quaternion @ turned) == pytest.approx(1.0) and np.linalg.norm(quaternion) == pytest.approx(1.0)


def test_invalid_poses_are_refused() -> None:
    arm = KinematicArm(ManualClock(), position=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0]))
    for position, quaternion in (
        (np.array([0, 0, math.nan]), np.array([1.0, 0, 0, 0])),
        (np.zeros(2), np.array([1.0, 0, 0, 0])),
        (np.zeros(3), np.zeros(4)),
    ):
        with pytest.raises(UsageError):
            arm.command_arm(position, quaternion)
    with pytest.raises(UsageError, match="lag"):
        KinematicArm(ManualClock(), position=np.zeros(3), quaternion=np.array([1.0, 0, 0, 0]), lag=0.0)
