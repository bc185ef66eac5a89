"""EGM messages: bytes ↔ frozen dataclasses. The wire has mm, degrees and ms; everything here has m, rad and s.

The message layer is the schema of the ABBRobotEGM package. A second copy of it in one process clashes in protobuf, so
nothing else in gelflow may import another one (abb_robot_client brings its own). No I/O.
"""

import math
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import DecodeError

from gelflow.errors import PeerError, UsageError
from gelflow.geometry import Quaternion, Vector
from gelflow.real.kinematics import Joints

try:
    from ABBRobotEGM._egm_protobuf import egm_pb2
except TypeError as error:  # what protobuf raises for a second schema
    raise UsageError(
        "expected to be the only EGM schema in this process, got another one; "
        f"do not import another EGM package (such as abb_robot_client) beside gelflow ({error})"
    ) from None

_DATA = egm_pb2.EgmHeader.MSGTYPE_DATA
_CORRECTION = egm_pb2.EgmHeader.MSGTYPE_CORRECTION
_COUNTER = 0xFFFFFFFF  # seqno and tm are unsigned 32-bit
_MOTORS = ("undefined", "on", "off")
_MCI = ("undefined", "error", "stopped", "running")
_RAPID = ("undefined", "stopped", "running")
# A quaternion on the wire may be rounded, but not be another kind of thing.
_NORM_SLACK = 1e-2


@dataclass(frozen=True, slots=True)
class EgmFeedback:
    """What the robot says every 4 ms (EgmRobot, type 2)."""

    sequence: int  # counts messages
    time: float  # the controller's clock [s], to the millisecond
    position: Vector  # of the tool in the work object [m]
    quaternion: Quaternion  # w x y z
    joints: Joints  # [rad]
    motors: str = "on"  # undefined, on, off
    mci: str = "running"  # the motion interpreter: undefined, error, stopped, running
    rapid: str = "running"  # undefined (a known fault of the controller after its restart), stopped, running
    converged: bool = False  # EGM's own convergence condition is met

    @property
    def trouble(self) -> str:
        """Why references are not followed, in a few words; empty when they are."""
        if self.motors != "on":
            return f"motors {self.motors}"
        if self.rapid == "stopped":
            return "RAPID stopped"
        if self.mci != "running":
            return f"EGM motion {self.mci}"
        return ""


@dataclass(frozen=True, slots=True)
class EgmReference:
    """What the robot is told to follow (EgmSensor, type 3)."""

    sequence: int
    time: float  # our clock [s], to the millisecond
    position: Vector  # [m]
    quaternion: Quaternion  # w x y z


def _fill_pose(pose: Any, position: Vector, quaternion: Quaternion) -> None:
    pos, orient = pose.pos, pose.orient
    pos.x, pos.y, pos.z = position[0] * 1e3, position[1] * 1e3, position[2] * 1e3
    orient.u0, orient.u1, orient.u2, orient.u3 = quaternion


def encode_robot(feedback: EgmFeedback) -> bytes:
    """An EgmRobot message. Measured and planned values are the same, as Euler angles too, as a controller sends."""
    message = egm_pb2.EgmRobot()
    header = message.header
    header.seqno, header.tm, header.mtype = feedback.sequence & _COUNTER, _milliseconds(feedback.time), _DATA
    degrees = [math.degrees(angle) for angle in feedback.joints]
    roll, pitch, yaw = (math.degrees(angle) for angle in _to_euler(feedback.quaternion))
    for part in (message.feedBack, message.planned):
        part.joints.joints.extend(degrees)
        _fill_pose(part.cartesian, feedback.position, feedback.quaternion)
        euler = part.cartesian.euler
        euler.x, euler.y, euler.z = roll, pitch, yaw
    message.motorState.state = _MOTORS.index(feedback.motors)
    message.mciState.state = _MCI.index(feedback.mci)
    message.rapidExecState.state = _RAPID.index(feedback.rapid)
    message.mciConvergenceMet = feedback.converged
    return message.SerializeToString()  # type: ignore[no-any-return]


def decode_robot(data: bytes) -> EgmFeedback:
    """Parse an EgmRobot message. Raises PeerError when it is not one, or has no finite pose and six joints."""
    try:
        message = egm_pb2.EgmRobot.FromString(data)
    except DecodeError:
        raise PeerError(f"expected an EgmRobot message, got {len(data)} bytes that are not one") from None
    header = message.header
    if header.mtype != _DATA:
        raise PeerError(f"expected an EgmRobot message of type {_DATA} (data), got type {header.mtype}")
    measured = message.feedBack
    if not measured.HasField("cartesian") or len(measured.joints.joints) != 6:
        raise PeerError(
            "expected EGM feedback with a pose and 6 joints, got "
            f"{len(measured.joints.joints)} joints and {'a' if measured.HasField('cartesian') else 'no'} pose; "
            "set EGM up with EGMSetupUC \\Pose and EGMActPose"
        )
    position, quaternion = _pose(measured.cartesian, measured.cartesian.HasField("orient"))
    a, b, c, d, e, f = measured.joints.joints
    radian = math.pi / 180
    joints = (a * radian, b * radian, c * radian, d * radian, e * radian, f * radian)
    if not math.isfinite(a + b + c + d + e + f):
        raise PeerError(f"expected finite joint angles, got {joints} rad")
    return EgmFeedback(
        sequence=header.seqno,
        time=header.tm * 1e-3,
        position=position,
        quaternion=quaternion,
        joints=joints,
        motors=_word(_MOTORS, message.motorState.state),
        mci=_word(_MCI, message.mciState.state),
        rapid=_word(_RAPID, message.rapidExecState.state),
        converged=message.mciConvergenceMet,
    )


def encode_sensor(reference: EgmReference) -> bytes:
    """An EgmSensor message with a pose to follow."""
    message = egm_pb2.EgmSensor()
    header = message.header
    header.seqno, header.tm, header.mtype = reference.sequence & _COUNTER, _milliseconds(reference.time), _CORRECTION
    _fill_pose(message.planned.cartesian, reference.position, reference.quaternion)
    return message.SerializeToString()  # type: ignore[no-any-return]


def decode_sensor(data: bytes) -> EgmReference:
    """Parse an EgmSensor message. Raises PeerError when it is not one, or carries no finite pose."""
    try:
        message = egm_pb2.EgmSensor.FromString(data)
    except DecodeError:
        raise PeerError(f"expected an EgmSensor message, got {len(data)} bytes that are not one") from None
    header = message.header
    if header.mtype != _CORRECTION:
        raise PeerError(f"expected an EgmSensor message of type {_CORRECTION} (correction), got type {header.mtype}")
    if not message.planned.HasField("cartesian"):
        raise PeerError("expected an EgmSensor message with a planned pose, got none")
    # Here Euler angles override the quaternion, as on the controller.
    position, quaternion = _pose(message.planned.cartesian, not message.planned.cartesian.HasField("euler"))
    return EgmReference(sequence=header.seqno, time=header.tm * 1e-3, position=position, quaternion=quaternion)


def _pose(pose: Any, by_quaternion: bool) -> tuple[Vector, Quaternion]:
    if not pose.HasField("pos") or not (pose.HasField("orient") or pose.HasField("euler")):
        raise PeerError("expected a pose with position and orientation, got a part of it")
    pos, orient = pose.pos, pose.orient
    position = (pos.x * 1e-3, pos.y * 1e-3, pos.z * 1e-3)
    quaternion = (orient.u0, orient.u1, orient.u2, orient.u3) if by_quaternion else _from_euler(pose.euler)
    w, x, y, z = quaternion
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    # Not a number fails this comparison too.
    if not abs(norm - 1) < _NORM_SLACK or not math.isfinite(position[0] + position[1] + position[2]):
        raise PeerError(f"expected a finite pose with a unit quaternion, got {position} m and {quaternion}")
    return position, (w / norm, x / norm, y / norm, z / norm)


def _to_euler(q: Quaternion) -> Vector:
    """Angles about x, y, z [rad] of R = Rz Ry Rx."""
    w, x, y, z = q
    sine = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(sine),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def _from_euler(euler: Any) -> Quaternion:
    (cx, sx), (cy, sy), (cz, sz) = (
        (math.cos(half), math.sin(half)) for half in (math.radians(a) / 2 for a in (euler.x, euler.y, euler.z))
    )
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )


def _milliseconds(time: float) -> int:
    return round(time * 1e3) & _COUNTER


def _word(words: tuple[str, ...], number: int) -> str:
    return words[number] if 0 <= number < len(words) else "undefined"
