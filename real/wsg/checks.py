"""Checks of a WSG-50 motion before it is sent. All functions raise; none of them changes a value."""

from gelflow.errors import SafetyError, UsageError
from gelflow.protocols import GripperState
from gelflow.real.wsg.codec import MM
from gelflow.real.wsg.config import WsgLimits

_WIDTH_TOLERANCE = 0.5e-3  # of the measured width against the commanded one [m]
_CLAMPING_FORCE = 2.5  # above this the fingers may hold a part: half of the smallest grasping force [N]
_MOTION_MARGIN = 0.5  # acceleration and replies, on top of distance over speed [s]


def check_ready(name: str, state: GripperState, *, referenced: bool = True) -> None:
    """Raise SafetyError when the gripper reports a fault, or when it must be `referenced` and is not."""
    if state.fault:
        raise SafetyError(f"{name} refused: the gripper reports {state.fault}; inspect it, then acknowledge the fault")
    if referenced and not state.referenced:
        raise SafetyError(f"{name} refused: the gripper is not referenced; home it first")


def check_limits(limits: WsgLimits, **values: float) -> None:
    """Raise SafetyError when a named value (width [m], speed [m/s], force [N]) is outside `limits`, or NaN."""
    for name, value in values.items():
        low, high = getattr(limits, name)
        slack = 2.0**-23 * max(abs(low), abs(high))  # a bound from the device is rounded to float32
        if not low - slack <= value <= high + slack:  # false for NaN too
            raise SafetyError(f"{name} {value} is outside {low} to {high} (m, m/s, N): nothing was sent")


def motion_time(distance: float, speed: float) -> float:
    """Time that the fingers need for `distance` [m] at `speed` [m/s], with acceleration and replies [s]."""
    return distance / speed + _MOTION_MARGIN


def check_duration(state: GripperState, width: float, speed: float, timeout: float) -> None:
    """Raise UsageError when moving to `width` [m] at `speed` [m/s] takes longer than `timeout` [s]."""
    needed = motion_time(abs(width - state.width), speed)
    if needed > timeout:
        raise UsageError(
            f"{abs(width - state.width) * MM:.0f} mm at {speed * MM:.0f} mm/s take {needed:.1f} s, more than the "
            f"time-out of {timeout} s: choose a higher speed"
        )


def check_closes(state: GripperState, width: float) -> None:
    """Raise SafetyError when a grasp at `width` [m] would open the fingers."""
    if width > state.width + _WIDTH_TOLERANCE:
        raise SafetyError(
            f"grasp refused: width {width * MM:.1f} mm is above the opening of {state.width * MM:.1f} mm, "
            f"and the fingers would open; move them apart first"
        )


def check_opens(state: GripperState, width: float) -> None:
    """Raise SafetyError when a release to `width` [m] would close the fingers."""
    if width < state.width - _WIDTH_TOLERANCE:
        raise SafetyError(
            f"release refused: width {width * MM:.1f} mm is below the opening of {state.width * MM:.1f} mm, "
            f"and the fingers would close"
        )


def holds_part(state: GripperState, *, grasped: bool) -> bool:
    """Whether a part is held: the device reports it, or this session `grasped` one and no loss is reported."""
    return state.grasp == "holding" or (grasped and state.grasp not in ("part lost", "no part"))


def fingers_move(state: GripperState) -> bool:
    """Whether the fingers move, by the grasp state."""
    return state.grasp in ("grasping", "releasing", "positioning")


def may_hold_part(state: GripperState, *, grasped: bool) -> bool:
    """Whether a part cannot be excluded: as `holds_part`, or the fingers are grasping or press on something."""
    return holds_part(state, grasped=grasped) or state.grasp == "grasping" or state.force > _CLAMPING_FORCE
