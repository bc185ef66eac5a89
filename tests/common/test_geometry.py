"""Poses, against SciPy's rotations."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gelflow.geometry import Pose, angle_between, yaw_quaternion


def random_pose(rng: np.random.Generator) -> Pose:
    q = rng.normal(size=4)
    return Pose(rng.normal(size=3), q / np.linalg.norm(q))


def rotation(pose: Pose) -> Rotation:
    w, x, y, z = pose.quaternion
    return Rotation.from_quat([x, y, z, w])


@pytest.mark.parametrize("seed", range(5))
def test_composition_inverse_and_angles(seed: int) -> None:
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


def test_yaw_and_nearness() -> None:
    pose = Pose(np.array([1.0, 2.0, 3.0]), yaw_quaternion(-0.3))
    assert pose.yaw == pytest.approx(-0.3) and pose.tilt == 0
    other = Pose(np.array([1.0, 2.0, 3.001]), yaw_quaternion(-0.31))
    assert pose.near(other, 2e-3, 0.02)
    assert not pose.near(other, 0.5e-3, 0.02) and not pose.near(other, 2e-3, 0.005)
