"""Rigid poses: position [m] and unit quaternion w x y z.

The arithmetic is in plain floats: these run hundreds of times a second, where arrays of four numbers cost much more.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of two quaternions w x y z."""
    aw, ax, ay, az = a.tolist()
    bw, bx, by, bz = b.tolist()
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(q: Array) -> Array:
    conjugated: Array = q * np.array([1.0, -1.0, -1.0, -1.0])
    return conjugated


def rotate(q: Array, v: Array) -> Array:
    """The vector `v` [any unit], shape (3,), turned by the unit quaternion `q`."""
    w, x, y, z = q.tolist()
    vx, vy, vz = v.tolist()
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return np.array([vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx])


def yaw_quaternion(yaw: float) -> Array:
    """A turn by `yaw` [rad] about z."""
    return np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])


def angle_between(a: Array, b: Array) -> float:
    """The angle of the turn from one unit quaternion to another [rad], 0 to π."""
    difference = multiply(conjugate(a), b)
    w, x, y, z = difference.tolist()
    return 2 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def angles_between(a: Array, b: Array) -> Array:
    """The same for arrays of unit quaternions (…, 4), whatever their signs; exact for tiny angles too."""
    apart = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.asarray(4 * np.arcsin(np.minimum(apart / 2, 1)))


@dataclass(frozen=True)
class Pose:
    """A frame in another frame."""

    position: Array  # [m], shape (3,)
    quaternion: Array  # w x y z, shape (4,), unit length

    def __matmul__(self, other: "Pose") -> "Pose":
        q = multiply(self.quaternion, other.quaternion)
        return Pose(self.position + rotate(self.quaternion, other.position), q / math.sqrt(q @ q))

    def inverse(self) -> "Pose":
        back = conjugate(self.quaternion)
        return Pose(-rotate(back, self.position), back)

    def near(self, other: "Pose", distance: float, angle: float) -> bool:
        """Whether another pose is within a distance [m] and an angle [rad]."""
        apart = math.dist(self.position.tolist(), other.position.tolist())
        return apart < distance and angle_between(self.quaternion, other.quaternion) < angle

    @property
    def yaw(self) -> float:
        """The turn about z [rad], −π to π, of a frame whose z is near the parent's z."""
        w, x, y, z = self.quaternion.tolist()
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def tilt(self) -> float:
        """The angle between the two frames' z axes [rad]."""
        _, x, y, _ = self.quaternion.tolist()
        return 2 * math.atan2(math.hypot(x, y), math.sqrt(max(0.0, 1 - x * x - y * y)))
