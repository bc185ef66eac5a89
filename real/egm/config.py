"""Configuration of the EGM arm driver."""

import math
from dataclasses import dataclass

from gelflow.errors import UsageError
from gelflow.geometry import Vector

DEFAULT_PORT = 6510


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
