"""Kinematics of the IRB 120: home pose, DH parameters against matrix products, inverse against forward."""

import math

import numpy as np
import pytest

from gelflow import geometry
from gelflow.errors import SafetyError
from gelflow.real import kinematics as k


def matrix(joints: k.Joints) -> np.ndarray:
    """The product of 4 × 4 DH matrices, as an independent computation."""
    total = np.eye(4)
    table = [
        (0, 0.29, 0, -90),
        (-90, 0, 0.27, 0),
        (0, 0, 0.07, -90),
        (0, 0.302, 0, 90),
        (0, 0, 0, -90),
        (180, 0.072, 0, 0),
    ]
    for angle, (offset, d, a, alpha) in zip(joints, table, strict=True):
        t, u = angle + math.radians(offset), math.radians(alpha)
        ct, st, cu, su = math.cos(t), math.sin(t), math.cos(u), math.sin(u)
        total = total @ np.array(
            [[ct, -st * cu, st * su, a * ct], [st, ct * cu, -ct * su, a * st], [0, su, cu, d], [0, 0, 0, 1]]
        )
    return total


def random_joints(rng: np.random.Generator, share: float = 0.98) -> k.Joints:
    low, high = np.array(k.JOINT_RANGES).T
    return tuple(float(v) for v in rng.uniform(low * share, high * share))  # type: ignore[return-value]


def test_flange_pose_at_home() -> None:
    position, quaternion = k.forward(k.HOME)
    assert position == pytest.approx((0.374, 0.0, 0.630), abs=1e-12)
    # The z axis of the flange points along the x axis of the base.
    assert geometry.rotate(quaternion, (0.0, 0.0, 1.0)) == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)


def test_forward_kinematics_equals_the_product_of_dh_matrices() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        joints = random_joints(rng)
        expected = matrix(joints)
        position, quaternion = k.forward(joints)
        assert np.allclose(position, expected[:3, 3], atol=1e-12)
        assert np.allclose(np.array(geometry.rotation_columns(quaternion)).T, expected[:3, :3], atol=1e-12)


def test_inverse_kinematics_reproduces_pose_and_joint_angles() -> None:
    rng = np.random.default_rng(1)
    for _ in range(1000):
        joints = random_joints(rng)
        position, quaternion = k.forward(joints)
        again = k.inverse(position, quaternion, near=joints)
        assert np.allclose(again, joints, atol=1e-6)
        elsewhere = k.inverse(position, quaternion, near=random_joints(rng))
        reached, turned = k.forward(elsewhere)
        assert np.allclose(reached, position, atol=1e-9)
        assert geometry.angle_between(turned, quaternion) < 1e-8
        assert not k.range_violation(elsewhere)


def test_inverse_kinematics_is_continuous_along_a_path() -> None:
    """A straight motion with the flange pointing down gives a continuous path in joint space."""
    joints = k.inverse((0.40, -0.05, 0.30), (0.0, 0.0, 1.0, 0.0), near=k.HOME)
    for step in range(200):
        following = k.inverse((0.40, -0.05 + step * 5e-4, 0.30), (0.0, 0.0, 1.0, 0.0), near=joints)
        assert max(abs(a - b) for a, b in zip(joints, following, strict=True)) < 0.005
        joints = following


def test_inverse_kinematics_keeps_joint_4_at_the_wrist_singularity() -> None:
    joints = (0.3, 0.2, -0.4, 0.7, 0.0, -1.1)
    position, quaternion = k.forward(joints)
    assert np.allclose(k.inverse(position, quaternion, near=joints), joints, atol=1e-6)


def test_joint_6_uses_the_nearest_turn() -> None:
    position, quaternion = k.forward((0.1, 0.2, 0.1, 0.4, 0.8, 0.5))
    for turns in (-1, 0, 1):
        near = (0.1, 0.2, 0.1, 0.4, 0.8, 0.5 + 2 * math.pi * turns)
        assert k.inverse(position, quaternion, near=near)[5] == pytest.approx(near[5], abs=1e-6)


def test_quaternions_of_half_turns() -> None:
    for q in ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)):
        assert geometry.angle_between(geometry.columns_quaternion(geometry.rotation_columns(q)), q) < 1e-12


def test_poses_compose_and_invert() -> None:
    rng = np.random.default_rng(2)
    a, b = k.forward(random_joints(rng)), k.forward(random_joints(rng))
    position, quaternion = geometry.compose(geometry.invert(a), geometry.compose(a, b))
    assert np.allclose(position, b[0], atol=1e-12)
    assert geometry.angle_between(quaternion, b[1]) < 1e-8


def test_pose_out_of_reach_is_reported() -> None:
    with pytest.raises(SafetyError, match=r"out of reach: its wrist is 1\.\d+ m from the shoulder"):
        k.inverse((1.2, 0.0, 0.3), (0.0, 0.0, 1.0, 0.0), near=k.HOME)


def test_pose_out_of_joint_range_names_the_joint() -> None:
    """A flange far in front that points back at the arm exceeds the range of joint 5."""
    back = geometry.columns_quaternion(((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)))
    with pytest.raises(SafetyError, match=r"joint \d would be at -?\d+\.\d°, its range is"):
        k.inverse((0.45, 0.0, 0.30), back, near=k.HOME)


def test_joint_ranges_of_the_robot() -> None:
    assert k.range_violation((0.0, 0.0, math.radians(69.9), 0.0, 0.0, math.radians(-399))) == ""
    assert k.range_violation((0.0, 0.0, math.radians(70.5), 0.0, 0.0, 0.0)).startswith("joint 3 would be at 70.5°")
