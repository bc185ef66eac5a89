"""What an EGM arm may be told: the settings, and the checks of a target. A wrong target is refused, never clamped.

The same checks run twice: in the caller before a target is posted, and in the process that talks to the robot.
"""

import math
from dataclasses import dataclass

from gelflow.errors import SafetyError, UsageError
from gelflow.real.egm.codec import EgmFeedback
from gelflow.real.kinematics import Frame, Quaternion, Vector, angle_between, compose, forward, inverse, invert

DEFAULT_PORT = 6510
# The controller's pose and the kinematics of its joints must tell the same story, or joint ranges can't be checked.
_FRAME_SLACK = (5e-3, math.radians(1.0))
# A target is near; when a joint would have to turn this far for it, the arm would have to turn over [rad].
_SAME_CONFIGURATION = math.pi / 2


@dataclass(frozen=True)
class EgmConfig:
    """An ABB IRB 120 that follows references over EGM. Times are robot time."""

    workspace_min: Vector  # lowest position a target may have, in the robot's base frame [m]
    workspace_max: Vector  # highest [m]
    port: int = DEFAULT_PORT  # UDP port on which this computer listens; 0 takes any free one
    host: str = "0.0.0.0"  # address of this computer to listen on
    robot: str = ""  # the controller's IP address; empty: whoever sends first
    max_speed: float = 0.02  # of the reference [m/s]
    max_turn_speed: float = math.radians(10)  # of the reference [rad/s]
    ramp_time: float = 0.1  # from rest to full speed [s]
    max_step: float = 0.05  # farthest a target may lie from the reference [m]
    max_turn: float = math.radians(20)  # largest turn from the reference to a target [rad]
    max_lead: float = 2e-3  # the reference waits when it is this far ahead of the robot [m]
    max_turn_lead: float = math.radians(1)  # and this [rad]
    max_lifetime: float = 1.0  # of a target [s]
    cycle: float = 0.004  # EGM's period [s]
    stale: float = 0.020  # feedback older than this: hold [s]
    silence: float = 0.100  # feedback older than this: stop [s]
    connect_timeout: float = 2.0  # how long to wait for the robot's first message [s]
    log_records: int = 65536  # room of the log; a full log stops the arm
    dry_run: bool = False  # listen and check targets, but send nothing

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.workspace_min, self.workspace_max, strict=True)):
            box = f"{self.workspace_min}, {self.workspace_max}"
            raise UsageError(f"workspace_min must be below workspace_max in x, y and z, got {box}")
        if not 0 <= self.port < 65536:
            raise UsageError(f"port must be 0 to 65535, got {self.port}")
        for name in (
            *("max_speed", "max_turn_speed", "ramp_time", "max_step", "max_turn", "max_lead", "max_turn_lead"),
            *("max_lifetime", "cycle", "stale", "silence", "connect_timeout", "log_records"),
        ):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise UsageError(f"{name} must be above 0 and finite, got {value}")
        if not self.cycle < self.stale < self.silence:
            raise UsageError(f"cycle < stale < silence must hold, got {self.cycle}, {self.stale}, {self.silence} s")


@dataclass(frozen=True, slots=True)
class Target:
    """Where to go, until when."""

    position: Vector  # of the controller's tool in the robot's base frame [m]
    quaternion: Quaternion  # w x y z, unit length
    expires: float  # robot time after which it is no longer followed [s]
    speed: float  # of the reference, at most [m/s]
    turn_speed: float  # [rad/s]


def tool_frame(feedback: EgmFeedback) -> Frame:
    """The controller's tool in the flange, as its own feedback says: pose and joints come in the same message."""
    return compose(invert(forward(feedback.joints)), (feedback.position, feedback.quaternion))


def check_target(config: EgmConfig, target: Target, *, reference: Frame, tool: Frame, feedback: EgmFeedback) -> None:
    """Raise SafetyError, with what was expected and got, when `target` must not be followed.

    `reference` is what the robot follows now, `tool` the tool frame found when EGM started.
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


def _check_joints(target: Target, tool: Frame, feedback: EgmFeedback) -> None:
    expected = compose(forward(feedback.joints), tool)
    off = math.dist(expected[0], feedback.position)
    turned = angle_between(expected[1], feedback.quaternion)
    if off > _FRAME_SLACK[0] or turned > _FRAME_SLACK[1]:
        raise SafetyError(
            f"target refused: the controller's pose is {off * 1e3:.1f} mm and {math.degrees(turned):.1f}° from what "
            "its joints say: EGM must run in wobj0, and the tool must not change while it runs"
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
            f"target refused: in range it is reached only with joint {number} at {math.degrees(angle):.1f}°, "
            f"{math.degrees(change):.1f}° from where it is; EGM does not turn over to another configuration"
        )
