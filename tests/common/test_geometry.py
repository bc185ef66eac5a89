"""Poses and plain-float transforms agree with SciPy's rotations."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gelflow.geometry import (
    Pose,
    angle_between,
    angles_between,
    apply_planar,
    columns_quaternion,
    compose,
    compose_planar,
    invert,
    rotated,
    rotation_columns,
    rotation_matrices,
    yaw_quaternion,
)


def random_pose(rng: np.random.Generator) -> Pose:
    q = rng.normal(size=4)
    return Pose(rng.normal(size=3), q / np.linalg.norm(q))


def rotation(pose: Pose) -> Rotation:
    w, x, y, z = pose.quaternion
    return Rotation.from_quat([x, y, z, w])


@pytest.mark.parametrize("seed", range(5))
def test_composition_inverse_and_angles_agree_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_pose(rng), random_pose(rng)
    both = a @ b
    assert both.position == pytest.approx(a.position + rotation(a).apply(b.position))
    assert (rotation(both) * (rotation(a) * rotation(b)).inv()).magnitude() < 1e-12
    back = a @ a.inverse()
    assert back.position == pytest.approx(np.zeros(3), abs=1e-12)
    turn = (rotation(a).inv() * rotation(b)).magnitude()
    assert angle_between(a.quaternion, b.quaternion) == pytest.approx(turn)
    assert a.tilt == pytest.approx(math.acos(rotation(a).as_matrix()[2, 2]))


@pytest.mark.parametrize("seed", range(5))
def test_plain_floats_and_arrays_agree(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_pose(rng), random_pose(rng)
    one, other = ((tuple(p.position.tolist()), tuple(p.quaternion.tolist())) for p in (a, b))
    position, turn = compose(one, other)
    assert position == pytest.approx((a @ b).position) and turn == pytest.approx((a @ b).quaternion)
    position, turn = invert(one)
    assert position == pytest.approx(a.inverse().position) and turn == pytest.approx(a.inverse().quaternion)
    both = np.stack([a.quaternion, b.quaternion])
    np.testing.assert_allclose(rotation_matrices(both), [rotation(a).as_matrix(), rotation(b).as_matrix()], atol=1e-14)
    np.testing.assert_allclose(a.apply(b.position[None]), [a.position + rotation(a).apply(b.position)], atol=1e-14)
    assert angle_between(columns_quaternion(rotation_columns(a.quaternion.tolist())), a.quaternion) < 1e-7
    assert angles_between(both[0], both[1]) == pytest.approx(angle_between(both[0], both[1]))


def test_yaw_and_is_near() -> None:
    pose = Pose(np.array([1.0, 2.0, 3.0]), yaw_quaternion(-0.3))
    assert pose.yaw == pytest.approx(-0.3) and pose.tilt == 0
    other = Pose(np.array([1.0, 2.0, 3.001]), yaw_quaternion(-0.31))
    assert pose.is_near(other, 2e-3, 0.02)
    assert not pose.is_near(other, 0.5e-3, 0.02) and not pose.is_near(other, 2e-3, 0.005)


@pytest.mark.filterwarnings("error")
def test_a_pose_that_is_not_finite_gives_no_warning() -> None:
    far = Pose(np.array([0.0, np.inf, np.nan]), np.array([1.0, 0.0, 0.0, 0.0]))
    turned = Pose(np.zeros(3), yaw_quaternion(0.3))
    assert not np.isfinite((turned @ far).position).any()


def test_planar_poses_agree_with_poses_in_space() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(2, 20, 3))
    composed = compose_planar(a, b)
    assert composed.shape == (20, 3)
    assert apply_planar(a, b[:, :2]) == pytest.approx(composed[:, :2])
    assert a[:, :2] + rotated(b[:, :2], a[:, 2]) == pytest.approx(composed[:, :2])
    for row in range(20):
        both = in_space(a[row]) @ in_space(b[row])
        assert both.is_near(in_space(composed[row]), 1e-12, 1e-7)
    assert compose_planar(a[0], b) == pytest.approx(compose_planar(np.tile(a[0], (20, 1)), b))  # broadcast


def in_space(planar: NDArray[np.float64]) -> Pose:
    return Pose(np.array([*planar[:2], 0.0]), yaw_quaternion(float(planar[2])))
