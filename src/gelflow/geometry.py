"""Rigid transforms: quaternions w x y z and poses.

The functions of one quaternion or vector take sequences or arrays and return tuples of plain floats: the EGM process
calls them in every 4 ms cycle, where arrays of four numbers cost much more. `Pose` holds arrays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w x y z, unit length
PoseTuple = tuple[Vector, Quaternion]  # position [m] and orientation, for loops of real-time threads
Columns = tuple[Vector, Vector, Vector]  # a rotation matrix by its columns: the directions of x, y and z


def multiply(a: Sequence[float] | Array, b: Sequence[float] | Array) -> Quaternion:
    """Hamilton product of two quaternions w x y z."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Sequence[float] | Array) -> Quaternion:
    """Conjugate of a quaternion w x y z: the inverse rotation of a unit quaternion."""
    w, x, y, z = q
    return (w, -x, -y, -z)


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def rotate(q: Sequence[float] | Array, v: Sequence[float] | Array) -> Vector:
    """The vector `v` [any unit] rotated by the unit quaternion `q`."""
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx)


def yaw_quaternion(yaw: float) -> Array:
    """Rotation by `yaw` [rad] about z, shape (4,)."""
    return np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])


def rotation_columns(q: Sequence[float] | Array) -> Columns:
    """The rotation matrix of a unit quaternion, by columns."""
    w, x, y, z = q
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return (
        (ww + xx - yy - zz, 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), ww - xx + yy - zz, 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), ww - xx - yy + zz),
    )


def columns_quaternion(columns: Columns) -> Quaternion:
    """The unit quaternion with w ≥ 0 of a rotation matrix, given by columns.

    Divides by the largest component, so that no accuracy is lost near half turns (Shepperd 1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = columns
    w, x, y, z = 1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz
    largest = max(w, x, y, z)
    scale = 0.5 / math.sqrt(largest)
    if largest == w:
        q = (w * scale, (yz - zy) * scale, (zx - xz) * scale, (xy - yx) * scale)
    elif largest == x:
        q = ((yz - zy) * scale, x * scale, (xy + yx) * scale, (zx + xz) * scale)
    elif largest == y:
        q = ((zx - xz) * scale, (xy + yx) * scale, y * scale, (yz + zy) * scale)
    else:
        q = ((xy - yx) * scale, (zx + xz) * scale, (yz + zy) * scale, z * scale)
    return q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])


def rotation_matrices(q: Array) -> Array:
    """Rotation matrices (…, 3, 3) of unit quaternions (…, 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotated(vectors: Array, angle: Array | float) -> Array:
    """Vectors (…, 2) in a plane, rotated by `angle` (…) [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def apply_planar(pose: Array, points: Array) -> Array:
    """Points (…, 2) of planar frames (…, 3: x, y, yaw), in the parent frame."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = points[..., 0], points[..., 1]
    return np.stack([pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y], axis=-1)


def compose_planar(a: Array, b: Array) -> Array:
    """The planar poses `b` (…, 3: x, y, yaw), given relative to `a` (…, 3), in the parent frame of `a`."""
    return np.concatenate([apply_planar(a, b[..., :2]), (a[..., 2] + b[..., 2])[..., None]], axis=-1)


def turned_about_z(q: Array, angle: Array) -> Array:
    """Unit quaternions (N, 4) turned by `angle` (N,) [rad] about the z axis of the parent frame."""
    cos, sin = np.cos(angle / 2), np.sin(angle / 2)
    w, x, y, z = q.T
    return np.column_stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])


def angle_between(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Angle of the rotation between two unit quaternions [rad], 0 to π."""
    w, x, y, z = multiply(conjugate(a), b)
    return 2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def angles_between(a: Array, b: Array) -> Array:
    """Angles between unit quaternions [rad], shapes (…, 4) → (…); independent of sign, accurate for tiny angles."""
    apart = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.asarray(4 * np.arcsin(np.minimum(apart / 2, 1)))


def compose(a: PoseTuple, b: PoseTuple) -> PoseTuple:
    """The pose `b`, given relative to the pose `a`, in the parent frame of `a`."""
    (px, py, pz), q = a
    x, y, z = rotate(q, b[0])
    return (px + x, py + y, pz + z), multiply(q, b[1])


def invert(a: PoseTuple) -> PoseTuple:
    """The inverse of a pose: the parent frame relative to `a`."""
    (px, py, pz), q = a
    back = conjugate(q)
    return rotate(back, (-px, -py, -pz)), back


@dataclass(frozen=True)
class Pose:
    """A frame relative to its parent frame: x_parent = position + R(quaternion) x."""

    position: Array = field(default_factory=lambda: np.zeros(3))  # [m], shape (3,)
    quaternion: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))  # w x y z, shape (4,), unit

    def matrix(self) -> Array:
        """The rotation matrix, shape (3, 3)."""
        return np.array(list(zip(*rotation_columns(self.quaternion.tolist()), strict=True)))

    def apply(self, points: Array) -> Array:
        """Points of this frame, expressed in the parent frame [m], shape (n, 3); not finite where an input is not."""
        with np.errstate(invalid="ignore"):  # the product of 0 and an infinite coordinate, which the caller refuses
            return np.asarray(points @ self.matrix().T + self.position)

    def __matmul__(self, other: "Pose") -> "Pose":
        quaternion = multiply(self.quaternion.tolist(), other.quaternion.tolist())
        return Pose(self.apply(other.position[None])[0], np.array(quaternion))

    def inverse(self) -> "Pose":
        """The parent frame relative to this one."""
        back = conjugate(self.quaternion.tolist())
        return Pose(-np.array(rotate(back, self.position.tolist())), np.array(back))

    def is_near(self, other: "Pose", distance: float, angle: float) -> bool:
        """Whether another pose is within a distance [m] and an angle [rad]."""
        apart = math.dist(self.position.tolist(), other.position.tolist())
        return apart < distance and angle_between(self.quaternion.tolist(), other.quaternion.tolist()) < angle

    @property
    def yaw(self) -> float:
        """Rotation about z [rad], −π to π, of a frame whose z is near the parent's z."""
        w, x, y, z = self.quaternion.tolist()
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def tilt(self) -> float:
        """Angle between the z axes of this frame and its parent [rad]."""
        _, x, y, _ = self.quaternion.tolist()
        return 2 * math.atan2(math.hypot(x, y), math.sqrt(max(0.0, 1 - x * x - y * y)))
