"""What may be asked of a WSG-50, and how long to wait for it."""

import math
from dataclasses import dataclass, replace

from gelflow.errors import PeerError, UsageError
from gelflow.real.wsg.codec import MM


@dataclass(frozen=True)
class WsgLimits:
    """What a motion may ask for; the device's own limits narrow it further."""

    width: tuple[float, float] = (0.0, 0.110)  # [m]
    speed: tuple[float, float] = (0.005, 0.420)  # [m/s]
    force: tuple[float, float] = (5.0, 80.0)  # [N]

    def __post_init__(self) -> None:
        outer = {"width": (0.0, 0.110), "speed": (0.005, 0.420), "force": (5.0, 80.0)}
        for name, (lowest, highest) in outer.items():
            low, high = getattr(self, name)
            if not lowest <= low < high <= highest:
                raise UsageError(f"{name} limits must rise within {lowest} to {highest} (SI), got {low} to {high}")


@dataclass(frozen=True)
class WsgConfig:
    """How to talk to the gripper. Times are robot time [s]."""

    limits: WsgLimits = WsgLimits()
    update_period: float = 0.05  # of each state value [s]
    stale_after: float = 0.5  # a state older than this is refused [s]
    reply_timeout: float = 1.0  # for the first answer to any command [s]
    home_timeout: float = 4.0  # for the result of homing [s]
    move_timeout: float = 6.0  # for the result of move, grasp and release [s]
    command_interval: float = 0.05  # pause between commands: shorter ones can bring the device into error [s]
    crc: bool = True  # False for a device whose checksum is off
    dry_run: bool = False  # check, record and report commands, but send no motion

    def __post_init__(self) -> None:
        times = (self.update_period, self.stale_after, self.reply_timeout, self.home_timeout, self.move_timeout)
        if not all(math.isfinite(t) and t > 0 for t in times) or not 0 <= self.command_interval < 1:
            raise UsageError(f"the gripper's times must be above 0 s, the pause between commands below 1 s, got {self}")
        if self.update_period > self.stale_after / 2:
            raise UsageError(f"update_period {self.update_period} s is over half of stale_after {self.stale_after} s")


def narrowed(limits: WsgLimits, device: tuple[float, ...]) -> WsgLimits:
    """`limits` within what the device reports (mm, mm/s, N). Raises PeerError when nothing is left."""
    stroke, speed_min, speed_max, _, _, force_min, force_nominal, _ = device
    try:
        return replace(
            limits,
            width=(limits.width[0], min(limits.width[1], stroke / MM)),
            speed=(max(limits.speed[0], speed_min / MM), min(limits.speed[1], speed_max / MM)),
            force=(max(limits.force[0], force_min), min(limits.force[1], force_nominal)),
        )
    except UsageError:
        raise PeerError(f"the gripper's own limits {device} leave nothing of {limits}: is it a WSG-50?") from None
