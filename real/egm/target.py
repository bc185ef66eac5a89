"""Targets of the EGM arm and their checks. An invalid target is refused, never clamped.

The same checks run twice: in the caller before a target is sent to the EGM process, and in the EGM process.
"""

import math
from dataclasses import dataclass

from gelflow.errors import SafetyError
from gelflow.geometry import PoseTuple, Quaternion, Vector, angle_between, compose, invert
from gelflow.real.egm.codec import EgmFeedback
from gelflow.real.egm.config import EgmConfig
from gelflow.real.kinematics import forward, inverse

# Largest difference between the controller's pose and the forward kinematics of its joints [m, rad]: joint ranges can
# only be checked when the two agree.
_POSE_TOLERANCE = (5e-3, math.radians(1.0))
# Targets are near: a larger joint motion means another arm configuration [rad].
_SAME_CONFIGURATION = math.pi / 2


@dataclass(frozen=True, slots=True)
class Target:
    """A pose to move to, with speeds and an expiry time."""

    position: Vector  # of the controller's tool in the robot's base frame [m]
    quaternion: Quaternion  # w x y z, unit length
    expires: float  # robot time at which the target expires [s]
    speed: float  # largest speed of the reference [m/s]
    turn_speed: float  # largest angular speed of the reference [rad/s]


def tool_frame(feedback: EgmFeedback) -> PoseTuple:
    """Pose of the controller's tool in the flange frame, from pose and joints of one feedback message."""
    return compose(invert(forward(feedback.joints)), (feedback.position, feedback.quaternion))


def check_target(
    config: EgmConfig, target: Target, *, reference: PoseTuple, tool: PoseTuple, feedback: EgmFeedback
) -> None:
    """Raise SafetyError, with expected and actual values, when `target` must not be followed.

    `reference` is the pose that the robot follows now, `tool` the tool frame determined when EGM started.
    """
    numbers = (*target.position, *target.quaternion, target.speed, target.turn_speed, target.expires)
    if not all(map(math.isfinite, numbers)):
        raise SafetyError(f"target refused: not finite: {target.position} m, {target.quaternion}")
    if not abs(math.sqrt(sum(c * c for c in target.quaternion)) - 1) < 1e-3:
        raise SafetyError(f"target refused: expected a unit quaternion, got {target.quaternion}")
    for name, value, limit in (
        ("speed", target.speed, config.max_speed),
        ("turn speed", target.turn_speed, config.max_turn_speed),
    ):
        if not 0 < value <= limit * (1 + 1e-9):
            raise SafetyError(f"target refused: {name} {value:.6g} is not above 0 and at most {limit:.6g}")
    for axis, value, low, high in zip("xyz", target.position, config.workspace_min, config.workspace_max, strict=True):
        if not low <= value <= high:
            raise SafetyError(f"target refused: {axis} = {value:.6f} m is outside the workspace {low} to {high} m")
    step = math.dist(target.position, reference[0])
    if step > config.max_step:
        raise SafetyError(f"target refused: {step:.6f} m from the reference, at most {config.max_step} m is allowed")
    turn = angle_between(reference[1], target.quaternion)
    if turn > config.max_turn:
        raise SafetyError(
            f"target refused: {math.degrees(turn):.3f}° from the reference, "
            f"at most {math.degrees(config.max_turn):.3f}° is allowed"
        )
    _check_joints(target, tool, feedback)


def _check_joints(target: Target, tool: PoseTuple, feedback: EgmFeedback) -> None:
    expected = compose(forward(feedback.joints), tool)
    off = math.dist(expected[0], feedback.position)
    turned = angle_between(expected[1], feedback.quaternion)
    if off > _POSE_TOLERANCE[0] or turned > _POSE_TOLERANCE[1]:
        raise SafetyError(
            f"target refused: the controller's pose is {off * 1e3:.1f} mm and {math.degrees(turned):.1f}° from the "
            "forward kinematics of its joints: EGM must run in wobj0, and the tool must not change while it runs"
        )
    position, quaternion = compose((target.position, target.quaternion), invert(tool))
    try:
        joints = inverse(position, quaternion, near=feedback.joints)
    except SafetyError as error:
        raise SafetyError(f"target refused: {error}") from None
    change, number, angle = max(
        (abs(a - b), number, a) for number, (a, b) in enumerate(zip(joints, feedback.joints, strict=True), start=1)
    )
    if change > _SAME_CONFIGURATION:
        raise SafetyError(
            f"target refused: within the joint ranges it is reached only with joint {number} at "
            f"{math.degrees(angle):.1f}°, {math.degrees(change):.1f}° from its angle now; EGM must not change the arm "
            "configuration"
        )
