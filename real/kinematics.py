"""Forward and inverse kinematics of the ABB IRB 120 in plain floats, because the EGM process calls them every 4 ms.

Poses are poses of the flange (tool0) in the robot's base frame: position [m] and quaternion w x y z. Joint angles are
those of the controller [rad]; at zero angles the flange is at (0.374, 0, 0.630) m.
"""

import math
from collections.abc import Sequence

from gelflow.errors import SafetyError
from gelflow.geometry import Columns, PoseTuple, Quaternion, Vector, columns_quaternion, dot, rotation_columns
from gelflow.real.limits import LIMITS

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
JOINT_RANGES = tuple((math.radians(low), math.radians(high)) for low, high in LIMITS.joint_ranges_deg)  # [rad]
HOME: Joints = (0.0,) * 6

_SHOULDER = DH[0][1]
_UPPER = DH[1][2]
_FOREARM = math.hypot(DH[2][2], DH[3][1])
_ELBOW = math.atan2(DH[3][1], DH[2][2])  # angle of the forearm from joint 3's x axis to the wrist centre
_FLANGE = DH[5][1]
_TWIST = tuple((math.sin(row[3]), math.cos(row[3])) for row in DH)
# Below this sine the axes of joints 4 and 6 are collinear (wrist singularity), and only the sum of their angles is
# defined.
_SINGULAR = 1e-9
# A solution this close to the present joint angles continues the motion: all other solutions are farther away [rad].
_SAME_BRANCH = 0.1
_BRANCHES = tuple((behind, elbow, flip) for behind in (False, True) for elbow in (1, -1) for flip in (1, -1))
_RANGE_TOLERANCE = 1e-9  # rounding at the end of a joint range [rad]


def _chain(joints: Sequence[float], count: int) -> tuple[Vector, Columns]:
    """Origin and axes of the frame after the first `count` joints."""
    px = py = pz = 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    for i in range(count):
        offset, d, a, _ = DH[i]
        sine, cosine = _TWIST[i]
        s, c = math.sin(joints[i] + offset), math.cos(joints[i] + offset)
        # Rotate x about z by θ, then y and z about the new x by α.
        nx, ny, nz = c * xx + s * yx, c * xy + s * yy, c * xz + s * yz
        hx, hy, hz = c * yx - s * xx, c * yy - s * xy, c * yz - s * xz
        px, py, pz = px + d * zx + a * nx, py + d * zy + a * ny, pz + d * zz + a * nz
        yx, yy, yz = cosine * hx + sine * zx, cosine * hy + sine * zy, cosine * hz + sine * zz
        zx, zy, zz = cosine * zx - sine * hx, cosine * zy - sine * hy, cosine * zz - sine * hz
        xx, xy, xz = nx, ny, nz
    return (px, py, pz), ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz))


def forward(joints: Sequence[float]) -> PoseTuple:
    """Flange pose in the base frame from six joint angles [rad]: position [m] and quaternion w x y z."""
    position, matrix = _chain(joints, 6)
    return position, columns_quaternion(matrix)


def link_frames(joints: Sequence[float]) -> tuple[PoseTuple, ...]:
    """Frames after each of the six joints in the base frame, by DH: position [m] and quaternion w x y z."""
    chains = (_chain(joints, count) for count in range(1, 7))
    return tuple((position, columns_quaternion(matrix)) for position, matrix in chains)


def range_violation(joints: Sequence[float]) -> str:
    """Message that names the first joint outside its range; empty when all are within their ranges."""
    for number, (angle, (low, high)) in enumerate(zip(joints, JOINT_RANGES, strict=True), start=1):
        if not low - _RANGE_TOLERANCE <= angle <= high + _RANGE_TOLERANCE:
            degrees = (round(math.degrees(value), 1) for value in (angle, low, high))
            return "joint {} would be at {}°, its range is {}° to {}°".format(number, *degrees)
    return ""


def inverse(position: Sequence[float], orientation: Quaternion, *, near: Sequence[float]) -> Joints:
    """Joint angles [rad] of a flange pose: the solution within the joint ranges that is closest to `near` [rad].

    Closed form for a spherical wrist (Pieper 1968): the wrist centre determines joints 1 to 3 (shoulder front or
    back, elbow up or down), the remaining rotation joints 4 to 6 (wrist flipped or not); up to eight solutions.

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
        if distance < best_distance and not range_violation(joints):
            best, best_distance = joints, distance
            if distance < _SAME_BRANCH:
                return joints
        elif distance < refused_distance:
            refused, refused_distance = joints, distance
    if best is not None:
        return best
    where = ", ".join(f"{p:.3f}" for p in position)
    if refused is not None:
        raise SafetyError(f"no joint angles in range reach the pose at ({where}) m: {range_violation(refused)}")
    reach = math.dist(wrist, (0.0, 0.0, _SHOULDER))
    raise SafetyError(
        f"the pose at ({where}) m is out of reach: its wrist is {reach:.3f} m from the shoulder, "
        f"the reach is {_FOREARM - _UPPER:.3f} to {_FOREARM + _UPPER:.3f} m"
    )


def _likely_branch(wrist: Vector, near: Sequence[float]) -> tuple[bool, int, int]:
    """The branch of the joint angles `near`; it is tried first, because an arm in motion stays on its branch."""
    turned = _wrap(near[0] - math.atan2(wrist[1], wrist[0]))
    return abs(turned) > math.pi / 2, 1 if near[2] + _ELBOW >= 0 else -1, 1 if near[4] >= 0 else -1


def _solution(wrist: Vector, matrix: Columns, branch: tuple[bool, int, int], near: Sequence[float]) -> Joints | None:
    """Joint angles of one branch (shoulder back, sign of the elbow angle, sign of joint 5); None when out of reach."""
    behind, elbow, flip = branch
    x, y, z = wrist
    radius, height = math.hypot(x, y), z - _SHOULDER
    cosine = (radius * radius + height * height - _UPPER * _UPPER - _FOREARM * _FOREARM) / (2 * _UPPER * _FOREARM)
    # Rounding gives slightly more than 1 for a stretched arm.
    if not abs(cosine) <= 1 + 1e-12:
        return None
    bend = elbow * math.acos(max(-1.0, min(1.0, cosine)))
    first = math.atan2(y, x)
    if behind:
        first, radius = _wrap(first + math.pi), -radius
    lean = math.atan2(_FOREARM * math.sin(bend), _UPPER + _FOREARM * math.cos(bend))
    arm = (first, _wrap(math.atan2(radius, height) - lean), _wrap(bend - _ELBOW))
    _, (x3, y3, z3) = _chain(arm, 3)
    # The flange axes in the frame of joint 3: z6 = (−s5 c4, −s5 s4, c5), and along z3: x6 = s5 c6, y6 = −s5 s6,
    # where joint 6 still includes its DH offset of 180°.
    tool_x, tool_y, tool_z = matrix
    zx, zy, zz = dot(x3, tool_z), dot(y3, tool_z), dot(z3, tool_z)
    sine = math.hypot(zx, zy)
    if sine < _SINGULAR and zz > 0:
        total = math.atan2(dot(y3, tool_x), dot(x3, tool_x))
        fourth, fifth, sixth = near[3], 0.0, total - near[3]
    else:
        fourth, fifth = math.atan2(-flip * zy, -flip * zx), math.atan2(flip * sine, zz)
        sixth = math.atan2(-flip * dot(z3, tool_y), flip * dot(z3, tool_x))
    return (*arm, fourth, fifth, _closest_turn(_wrap(sixth - math.pi), near[5]))


def _closest_turn(angle: float, near: float) -> float:
    """`angle` plus the multiple of 2π closest to `near`, within the range of joint 6 [rad], which exceeds one turn."""
    low, high = JOINT_RANGES[5]
    angle += 2 * math.pi * round((near - angle) / (2 * math.pi))
    if angle > high:
        return angle - 2 * math.pi
    return angle + 2 * math.pi if angle < low else angle


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)
