"""Limits and configuration of the WSG-50 driver."""

import math
from dataclasses import dataclass, replace

from gelflow.errors import PeerError, UsageError
from gelflow.real.limits import LIMITS
from gelflow.real.wsg.codec import MM


@dataclass(frozen=True)
class WsgLimits:
    """Allowed motion commands; the limits that the device reports narrow them further."""

    width: tuple[float, float] = LIMITS.gripper_width  # [m]
    speed: tuple[float, float] = LIMITS.gripper_speed  # [m/s]
    force: tuple[float, float] = LIMITS.gripper_force  # [N]

    def __post_init__(self) -> None:
        hardware = {"width": LIMITS.gripper_width, "speed": LIMITS.gripper_speed, "force": LIMITS.gripper_force}
        for name, (lowest, highest) in hardware.items():
            low, high = getattr(self, name)
            if not lowest <= low < high <= highest:
                raise UsageError(
                    f"{name} limits must be increasing and within {lowest} to {highest} (SI), got {low} to {high}"
                )


@dataclass(frozen=True)
class WsgConfig:
    """Configuration of the driver. Times are in robot time [s]."""

    limits: WsgLimits = WsgLimits()
    update_period: float = 0.05  # period of the updates of each state value [s]
    stale_after: float = LIMITS.gripper_age  # maximum age of a state [s]
    reply_timeout: float = LIMITS.gripper_reply_time  # for the first reply to a command [s]
    home_timeout: float = LIMITS.gripper_home_time  # for the result of homing [s]
    move_timeout: float = LIMITS.gripper_motion_time  # for the result of move, grasp and release [s]
    command_interval: float = 0.05  # pause between commands; shorter pauses can put the device into an error state [s]
    crc: bool = True  # False for a device whose checksum is switched off
    dry_run: bool = False  # check, record and report commands, but send no motion

    def __post_init__(self) -> None:
        times = (self.update_period, self.stale_after, self.reply_timeout, self.home_timeout, self.move_timeout)
        if not all(math.isfinite(t) and t > 0 for t in times) or not 0 <= self.command_interval < 1:
            raise UsageError(
                "the gripper's times must be above 0 s and the pause between commands 0 to 1 s, "
                f"got {dict(zip(_TIMES, times, strict=True))} and command_interval {self.command_interval}"
            )
        if self.update_period > self.stale_after / 2:
            raise UsageError(
                f"update_period {self.update_period} s is more than half of stale_after {self.stale_after} s"
            )


_TIMES = ("update_period", "stale_after", "reply_timeout", "home_timeout", "move_timeout")


def narrowed(limits: WsgLimits, device: tuple[float, ...]) -> WsgLimits:
    """`limits` intersected with the limits that the device reports (mm, mm/s, N).

    Raises PeerError when the intersection is empty.
    """
    stroke, speed_min, speed_max, _, _, force_min, force_nominal, _ = device
    try:
        return replace(
            limits,
            width=(limits.width[0], min(limits.width[1], stroke / MM)),
            speed=(max(limits.speed[0], speed_min / MM), min(limits.speed[1], speed_max / MM)),
            force=(max(limits.force[0], force_min), min(limits.force[1], force_nominal)),
        )
    except UsageError:
        raise PeerError(
            f"the limits that the gripper reports {device} do not overlap with {limits}: is it a WSG-50?"
        ) from None
