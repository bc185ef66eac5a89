"""EGM messages: bytes ↔ frozen dataclasses. Units on the wire are mm, degrees and ms; here m, rad and s. No I/O.

Fields of the messages (protobuf; the schema is ABB's egm.proto in the package ABBRobotEGM):

- EgmRobot, from the controller: header (seqno, tm, mtype = data), feedBack and planned (joints; cartesian: pos, orient,
  euler), motorState, mciState, rapidExecState, mciConvergenceMet. Of planned, nothing is read.
- EgmSensor, to the controller: header (seqno, tm, mtype = correction), planned.cartesian (pos, orient).

protobuf rejects a second copy of a schema in one process, so no other EGM package (such as abb_robot_client) may be
imported.
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
except TypeError as error:  # raised by protobuf for a second schema
    raise UsageError(
        "expected one EGM schema in this process, got a second one; "
        f"do not import another EGM package (such as abb_robot_client) together with gelflow ({error})"
    ) from None

_DATA = egm_pb2.EgmHeader.MSGTYPE_DATA
_CORRECTION = egm_pb2.EgmHeader.MSGTYPE_CORRECTION
_UINT32 = 0xFFFFFFFF  # seqno and tm are unsigned 32-bit
_MOTORS = ("undefined", "on", "off")
_MCI = ("undefined", "error", "stopped", "running")
_RAPID = ("undefined", "stopped", "running")
_NORM_TOLERANCE = 1e-2  # rounding of a unit quaternion on the wire


@dataclass(frozen=True, slots=True)
class EgmFeedback:
    """Feedback of the robot, sent every 4 ms (EgmRobot, type 2)."""

    sequence: int  # message counter
    time: float  # the controller's clock [s], rounded to milliseconds
    position: Vector  # of the tool in the work object [m]
    quaternion: Quaternion  # w x y z
    joints: Joints  # [rad]
    motors: str = "on"  # undefined, on, off
    mci: str = "running"  # motion control interface: undefined, error, stopped, running
    rapid: str = "running"  # undefined (a known defect of the controller after its restart), stopped, running
    converged: bool = False  # EGM's own convergence condition is met

    @property
    def stop_reason(self) -> str:
        """The reason why references are not followed; empty when they are."""
        if self.motors != "on":
            return f"motors {self.motors}"
        if self.rapid == "stopped":
            return "RAPID stopped"
        if self.mci != "running":
            return f"EGM motion {self.mci}"
        return ""


@dataclass(frozen=True, slots=True)
class EgmReference:
    """Reference pose for the robot (EgmSensor, type 3)."""

    sequence: int
    time: float  # robot time [s], rounded to milliseconds
    position: Vector  # [m]
    quaternion: Quaternion  # w x y z


def _fill_pose(pose: Any, position: Vector, quaternion: Quaternion) -> None:
    pos, orient = pose.pos, pose.orient
    pos.x, pos.y, pos.z = position[0] * 1e3, position[1] * 1e3, position[2] * 1e3
    orient.u0, orient.u1, orient.u2, orient.u3 = quaternion


def encode_robot(feedback: EgmFeedback) -> bytes:
    """An EgmRobot message with equal measured and planned values, and Euler angles as sent by a controller."""
    message = egm_pb2.EgmRobot()
    header = message.header
    header.seqno, header.tm, header.mtype = feedback.sequence & _UINT32, _milliseconds(feedback.time), _DATA
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
    """Parse an EgmRobot message. Raises PeerError for other data, or without a finite pose and six finite joints."""
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
    # The front part of a message may be a valid message, too.
    if not (header.HasField("seqno") and message.HasField("motorState") and message.HasField("mciState")):
        raise PeerError("expected EGM feedback with a count and the states of motors and motion control; it is cut off")
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
        motors=_state_name(_MOTORS, message.motorState.state),
        mci=_state_name(_MCI, message.mciState.state),
        rapid=_state_name(_RAPID, message.rapidExecState.state),
        converged=message.mciConvergenceMet,
    )


def encode_sensor(reference: EgmReference) -> bytes:
    """An EgmSensor message with a reference pose."""
    message = egm_pb2.EgmSensor()
    header = message.header
    header.seqno, header.tm, header.mtype = reference.sequence & _UINT32, _milliseconds(reference.time), _CORRECTION
    _fill_pose(message.planned.cartesian, reference.position, reference.quaternion)
    return message.SerializeToString()  # type: ignore[no-any-return]


def decode_sensor(data: bytes) -> EgmReference:
    """Parse an EgmSensor message. Raises PeerError for other data, or without a finite pose."""
    try:
        message = egm_pb2.EgmSensor.FromString(data)
    except DecodeError:
        raise PeerError(f"expected an EgmSensor message, got {len(data)} bytes that are not one") from None
    header = message.header
    if header.mtype != _CORRECTION:
        raise PeerError(f"expected an EgmSensor message of type {_CORRECTION} (correction), got type {header.mtype}")
    if not message.planned.HasField("cartesian"):
        raise PeerError("expected an EgmSensor message with a planned pose, got none")
    # Euler angles override the quaternion, as on the controller.
    position, quaternion = _pose(message.planned.cartesian, not message.planned.cartesian.HasField("euler"))
    return EgmReference(sequence=header.seqno, time=header.tm * 1e-3, position=position, quaternion=quaternion)


def _pose(pose: Any, by_quaternion: bool) -> tuple[Vector, Quaternion]:
    if not pose.HasField("pos") or not (pose.HasField("orient") or pose.HasField("euler")):
        raise PeerError("expected a pose with position and orientation, got an incomplete pose")
    pos, orient = pose.pos, pose.orient
    position = (pos.x * 1e-3, pos.y * 1e-3, pos.z * 1e-3)
    quaternion = (orient.u0, orient.u1, orient.u2, orient.u3) if by_quaternion else _from_euler(pose.euler)
    w, x, y, z = quaternion
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    # The comparison is false for NaN.
    if not abs(norm - 1) < _NORM_TOLERANCE or not math.isfinite(position[0] + position[1] + position[2]):
        raise PeerError(f"expected a finite pose with a unit quaternion, got {position} m and {quaternion}")
    return position, (w / norm, x / norm, y / norm, z / norm)


def _to_euler(q: Quaternion) -> Vector:
    """Angles about x, y, z [rad] with R = Rz Ry Rx."""
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
    return round(time * 1e3) & _UINT32


def _state_name(names: tuple[str, ...], number: int) -> str:
    return names[number] if 0 <= number < len(names) else "undefined"
