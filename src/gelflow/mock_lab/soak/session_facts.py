"""Facts of a recorded run for the rules of a soak test: latches, motion after them, targets, stops."""

import itertools
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.geometry import Pose
from gelflow.real.runner.lab import Lab
from gelflow.session.reader import SessionReader
from gelflow.session.recovery import recover

_SETTLING = 0.2  # after a latch the reference may return to the arm's pose for this time [s]
_LATCHED = "latched"  # value of the event "state"
_STOPS = ("stopped", "arm stopped")  # names of events


@dataclass(frozen=True)
class SessionFacts:
    """Facts of one session. Lengths in metres, times in robot time."""

    readable: str  # "yes", "recovered", "no", or "no session"
    states: tuple[str, ...] = ()  # of the supervisor, without repetitions
    latched_at: float | None = None  # time of the first latch [s]
    reason: str = ""  # of the stop
    moved_after_latch: float = 0.0  # largest distance of a later reference from that shortly after the latch [m]
    outside: float = 0.0  # largest distance of a reference from the workspace [m]
    stop_recorded: bool = False
    moved: bool = False  # a reference was sent


def read_session(path: Path, lab: Lab) -> SessionFacts:
    """Read the facts of a session, from its recovered copy if it is unfinished."""
    if not path.exists():
        return SessionFacts("no session")
    try:
        return _facts(path, lab, "yes")
    except UsageError:
        return SessionFacts("no")
    except PeerError:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "recovered.mcap"
            try:
                recover(path, copy)
                return _facts(copy, lab, "recovered")
            except GelflowError:
                return SessionFacts("no")


def _facts(path: Path, lab: Lab, readable: str) -> SessionFacts:
    applied: list[tuple[float, Pose]] = []
    events: list[tuple[float, str, dict[str, Any]]] = []
    with SessionReader(path) as session:
        for record in session.records(["/event", "/arm/applied"]):
            if record.topic == "/event":
                events.append((record.stamp, record.value["name"], record.value["values"]))
            else:
                applied.append((record.stamp, record.value))
    states = [str(values.get("state")) for _, name, values in events if name == "state"]
    latches = [stamp for stamp, name, values in events if _is_latch(name, values)]
    latched_at = min(latches, default=None)
    reasons = [str(values.get("reason", "")) for _, name, values in events if _is_latch(name, values) or name in _STOPS]
    return SessionFacts(
        readable=readable,
        states=tuple(state for state, _ in itertools.groupby(states)),
        latched_at=latched_at,
        reason=next(filter(None, reasons), ""),
        moved_after_latch=0.0 if latched_at is None else _motion_after(latched_at, applied),
        outside=_distance_outside(applied, lab),
        stop_recorded=any(name in _STOPS for _, name, _ in events),
        moved=len(applied) > 0,
    )


def _is_latch(name: str, values: dict[str, Any]) -> bool:
    return name == "stopped" or (name == "state" and values.get("state") == _LATCHED)


def _motion_after(latched_at: float, applied: list[tuple[float, Pose]]) -> float:
    """Largest distance of the references after a latch from the first one after the settling time [m]."""
    later = [pose.position for stamp, pose in applied if stamp > latched_at + _SETTLING]
    return max((float(np.linalg.norm(position - later[0])) for position in later), default=0.0)


def _distance_outside(applied: list[tuple[float, Pose]], lab: Lab) -> float:
    """Largest distance of a reference from the workspace about the taught hole [m]."""
    if not applied:
        return 0.0
    to_hole = lab.hole.pose.inverse()
    local = np.array([(to_hole @ (pose @ lab.tool.pose)).position for _, pose in applied[::5]])
    space, height = lab.workspace, lab.part.grasp_height
    low = np.array([-space.x, -space.y, space.height_min + height])
    high = np.array([space.x, space.y, space.height_max + height])
    beyond: NDArray[np.float64] = np.maximum(low - local, local - high).max(axis=1)
    return max(0.0, float(beyond.max()))


def longest_wait(lab: Lab) -> float:
    """The longest time for which a run may wait without motion [s]."""
    limits = lab.limits
    of_limits = (limits.attempt_time, limits.gripper_motion, limits.recording_delay)
    return max(*of_limits, lab.arm.connect_timeout, lab.part.load_wait)
