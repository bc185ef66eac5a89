"""Forward and inverse kinematics of the ABB IRB 120, in plain floats: used every 4 ms, where arrays would cost more.

Poses are those of the flange (tool0) in the robot's base frame: position [m] and quaternion w x y z. Angles are the
controller's joint angles [rad]; all zero is the home pose with the flange at (0.374, 0, 0.630) m.
"""

import math
from collections.abc import Sequence

from gelflow.errors import SafetyError
from gelflow.geometry import Columns, PoseTuple, Quaternion, Vector, columns_quaternion, rotation_columns

Joints = tuple[float, float, float, float, float, float]  # [rad]

# Standard DH: offset of θ [rad], d [m], a [m], α [rad].
DH = (
    (0.0, 0.290, 0.0, -math.pi / 2),
    (-math.pi / 2, 0.0, 0.270, 0.0),
    (0.0, 0.0, 0.070, -math.pi / 2),
    (0.0, 0.302, 0.0, math.pi / 2),
    (0.0, 0.0, 0.0, -math.pi / 2),
    (math.pi, 0.072, 0.0, 0.0),
)
LIMITS = tuple(
    (math.radians(low), math.radians(high))
    for low, high in ((-165, 165), (-110, 110), (-110, 70), (-160, 160), (-120, 120), (-400, 400))
)
MAX_SPEEDS = tuple(math.radians(s) for s in (250, 250, 250, 320, 320, 420))  # [rad/s]
HOME: Joints = (0.0,) * 6

_SHOULDER = DH[0][1]
_UPPER = DH[1][2]
_FOREARM = math.hypot(DH[2][2], DH[3][1])
_ELBOW = math.atan2(DH[3][1], DH[2][2])  # the forearm is bent: from joint 3's x axis to the wrist's centre
_FLANGE = DH[5][1]
_TWIST = tuple((math.sin(row[3]), math.cos(row[3])) for row in DH)
# Below this the axes of joints 4 and 6 are one line, and only their sum is defined.
_SINGULAR = 1e-9
# A solution this close to where the arm is goes on with its motion: other solutions are further away [rad].
_SAME_BRANCH = 0.1
_BRANCHES = tuple((behind, elbow, flip) for behind in (False, True) for elbow in (1, -1) for flip in (1, -1))
_RANGE_SLACK = 1e-9  # rounding at the end of a range is not out of range [rad]


def _chain(joints: Sequence[float], count: int) -> tuple[Vector, Columns]:
    """Origin and axes of the frame behind the first `count` joints."""
    px = py = pz = 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for i in range(count):
        offset, d, a, _ = DH[i]
        sine, cosine = _TWIST[i]
        s, c = math.sin(joints[i] + offset), math.cos(joints[i] + offset)
        # x turns about z by θ; then y and z turn about the new x by α.
        nx, ny, nz = c * xx + s * yx, c * xy + s * yy, c * xz + s * yz
        hx, hy, hz = c * yx - s * xx, c * yy - s * xy, c * yz - s * xz
        px, py, pz = px + d * zx + a * nx, py + d * zy + a * ny, pz + d * zz + a * nz
        yx, yy, yz = cosine * hx + sine * zx, cosine * hy + sine * zy, cosine * hz + sine * zz
        zx, zy, zz = cosine * zx - sine * hx, cosine * zy - sine * hy, cosine * zz - sine * hz
        xx, xy, xz = nx, ny, nz
    return (px, py, pz), ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz))


def forward(joints: Sequence[float]) -> PoseTuple:
    """The flange in the base frame: position [m] and quaternion w x y z, of six joint angles [rad]."""
    position, matrix = _chain(joints, 6)
    return position, columns_quaternion(matrix)


def outside(joints: Sequence[float]) -> str:
    """Which joint is out of its range, in words; empty when none is."""
    for number, (angle, (low, high)) in enumerate(zip(joints, LIMITS, strict=True), start=1):
        if not low - _RANGE_SLACK <= angle <= high + _RANGE_SLACK:
            degrees = (round(math.degrees(value), 1) for value in (angle, low, high))
            return "joint {} would be at {}°, its range is {}° to {}°".format(number, *degrees)
    return ""


def inverse(position: Sequence[float], orientation: Quaternion, *, near: Sequence[float]) -> Joints:
    """Joint angles [rad] that bring the flange to a pose, in range, the solution closest to `near` [rad].

    Closed form for a spherical wrist: the wrist's centre gives joints 1 to 3 (shoulder before or behind, elbow up or
    down), what is left of the orientation gives 4 to 6 (wrist flipped or not); up to eight solutions.

    Raises SafetyError when the pose is out of reach, or when every solution has a joint out of its range.
    """
    matrix = rotation_columns(orientation)
    zx, zy, zz = matrix[2]
    px, py, pz = position
    wrist = (px - _FLANGE * zx, py - _FLANGE * zy, pz - _FLANGE * zz)
    likely = _likely_branch(wrist, near)
    best, best_distance, refused, refused_distance = None, math.inf, None, math.inf
    for branch in (likely, *(other for other in _BRANCHES if other != likely)):
        joints = _solution(wrist, matrix, branch, near)
        if joints is None:
            continue
        distance = math.dist(joints, near)
        if distance < best_distance and not outside(joints):
            best, best_distance = joints, distance
            if distance < _SAME_BRANCH:
                return joints
        elif distance < refused_distance:
            refused, refused_distance = joints, distance
    if best is not None:
        return best
    where = ", ".join(f"{p:.3f}" for p in position)
    if refused is not None:
        raise SafetyError(f"no joint angles in range reach the pose at ({where}) m: {outside(refused)}")
    reach = math.dist(wrist, (0.0, 0.0, _SHOULDER))
    raise SafetyError(
        f"the pose at ({where}) m is out of reach: its wrist is {reach:.3f} m from the shoulder, "
        f"possible is {_FOREARM - _UPPER:.3f} to {_FOREARM + _UPPER:.3f} m"
    )


def _likely_branch(wrist: Vector, near: Sequence[float]) -> tuple[bool, int, int]:
    """The branch that `near` is on: an arm in motion stays there, so it is tried first."""
    turned = _wrap(near[0] - math.atan2(wrist[1], wrist[0]))
    return abs(turned) > math.pi / 2, 1 if near[2] + _ELBOW >= 0 else -1, 1 if near[4] >= 0 else -1


def _solution(wrist: Vector, matrix: Columns, branch: tuple[bool, int, int], near: Sequence[float]) -> Joints | None:
    """Joint angles of one branch (shoulder behind, sign of the elbow's bend, sign of joint 5); None: out of reach."""
    behind, elbow, flip = branch
    x, y, z = wrist
    radius, height = math.hypot(x, y), z - _SHOULDER
    cosine = (radius * radius + height * height - _UPPER * _UPPER - _FOREARM * _FOREARM) / (2 * _UPPER * _FOREARM)
    # A stretched arm rounds to slightly more than 1.
    if not abs(cosine) <= 1 + 1e-12:
        return None
    bend = elbow * math.acos(max(-1.0, min(1.0, cosine)))
    first = math.atan2(y, x)
    if behind:
        first, radius = _wrap(first + math.pi), -radius
    lean = math.atan2(_FOREARM * math.sin(bend), _UPPER + _FOREARM * math.cos(bend))
    arm = (first, _wrap(math.atan2(radius, height) - lean), _wrap(bend - _ELBOW))
    _, (x3, y3, z3) = _chain(arm, 3)
    # The flange's axes in the frame of joint 3: z6 = (−s5 c4, −s5 s4, c5), and along z3: x6 = s5 c6, y6 = −s5 s6,
    # with the DH offset of 180° still in joint 6.
    tool_x, tool_y, tool_z = matrix
    zx, zy, zz = _dot(x3, tool_z), _dot(y3, tool_z), _dot(z3, tool_z)
    sine = math.hypot(zx, zy)
    if sine < _SINGULAR and zz > 0:
        total = math.atan2(_dot(y3, tool_x), _dot(x3, tool_x))
        fourth, fifth, sixth = near[3], 0.0, total - near[3]
    else:
        fourth, fifth = math.atan2(-flip * zy, -flip * zx), math.atan2(flip * sine, zz)
        sixth = math.atan2(-flip * _dot(z3, tool_y), flip * _dot(z3, tool_x))
    return (*arm, fourth, fifth, _closest_turn(_wrap(sixth - math.pi), near[5]))


def _closest_turn(angle: float, near: float) -> float:
    """Joint 6 can turn more than once: the turn closest to `near`, within its range [rad]."""
    low, high = LIMITS[5]
    angle += 2 * math.pi * round((near - angle) / (2 * math.pi))
    if angle > high:
        return angle - 2 * math.pi
    return angle + 2 * math.pi if angle < low else angle


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
