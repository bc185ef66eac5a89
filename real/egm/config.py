"""Configuration of the EGM arm driver."""

import math
from dataclasses import dataclass

from gelflow.errors import UsageError
from gelflow.geometry import Vector
from gelflow.real.addresses import is_host
from gelflow.real.limits import LIMITS

DEFAULT_PORT = 6510


@dataclass(frozen=True)
class EgmConfig:
    """An ABB IRB 120 that follows references over EGM. Times are in robot time."""

    workspace_min: Vector  # lowest target position in the robot's base frame [m]
    workspace_max: Vector  # highest target position [m]
    port: int = DEFAULT_PORT  # UDP port on which this computer listens; 0 takes any free port
    host: str = "0.0.0.0"  # address of this computer to listen on
    robot: str = ""  # IP address of the controller; empty: the first sender
    max_speed: float = LIMITS.tool_speed  # of the reference [m/s]
    max_turn_speed: float = math.radians(LIMITS.tool_turn_speed_deg)  # of the reference [rad/s]
    ramp_time: float = 0.1  # from rest to full speed [s]
    max_step: float = LIMITS.target_distance  # from the reference to a target [m]
    max_turn: float = math.radians(LIMITS.target_turn_driver_deg)  # from the reference to a target [rad]
    joint_speed: float = math.radians(LIMITS.joint_speed_deg)  # of each joint: MaxSpeedDeviation [rad/s]
    max_lead: float = LIMITS.reference_lead  # the reference waits when it is farther away from the robot [m]
    max_turn_lead: float = math.radians(LIMITS.reference_turn_lead_deg)  # the same as an angle [rad]
    lead_time: float = LIMITS.reference_lead_time  # lead in the direction of motion over the speed [s]
    lead_margin: float = LIMITS.reference_lead_margin  # in addition [m]
    turn_lead_margin: float = math.radians(LIMITS.reference_turn_lead_margin_deg)  # in addition [rad]
    max_lifetime: float = LIMITS.longest_target_lifetime  # of a target [s]
    cycle: float = 0.004  # period of EGM [s]
    stale: float = LIMITS.pose_age  # feedback older than this: hold [s]
    silence: float = LIMITS.pose_silence  # feedback older than this: stop [s]
    connect_timeout: float = 2.0  # for the first message of the robot [s]
    log_records: int = 65536  # capacity of the cycle log; a full log stops the arm
    dry_run: bool = False  # listen and check targets, but send nothing

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.workspace_min, self.workspace_max, strict=True)):
            box = f"{self.workspace_min}, {self.workspace_max}"
            raise UsageError(f"workspace_min must be below workspace_max in x, y and z, got {box}")
        if not 0 <= self.port < 65536:
            raise UsageError(f"port must be 0 to 65535, got {self.port}")
        if not is_host(self.host):
            raise UsageError(f"host must be an IPv4 address of this computer or its name, got {self.host!r}")
        for name in (
            *("max_speed", "max_turn_speed", "ramp_time", "max_step", "max_turn", "joint_speed"),
            *("max_lead", "max_turn_lead", "lead_time", "lead_margin", "turn_lead_margin"),
            *("max_lifetime", "cycle", "stale", "silence", "connect_timeout", "log_records"),
        ):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise UsageError(f"{name} must be above 0 and finite, got {value}")
        if not self.cycle < self.stale < self.silence:
            raise UsageError(f"cycle < stale < silence must hold, got {self.cycle}, {self.stale}, {self.silence} s")
