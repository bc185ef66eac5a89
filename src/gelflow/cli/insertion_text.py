"""Text output of insertions, shared by `gelflow run` and `gelflow demo`."""

import math
from typing import TYPE_CHECKING, Any

from rich.table import Table

from gelflow.cli.output import yes_or_no

if TYPE_CHECKING:
    from gelflow.real.runner.insertion.attempt import Attempt, Insertion
    from gelflow.real.runner.preflight import PreflightItem

ATTEMPT_HEADER = "  part  try   x [mm]   y [mm]  yaw [°]  depth [mm]  shear [mm]"

_FORCE_KEYS = ("normal", "normal_deviation", "shear", "shear_deviation")  # of the recorded forces [N]


def attempt_line(number: int, attempt: "Attempt") -> str:
    """One line for an attempt of part `number`, below `ATTEMPT_HEADER`."""
    x, y, yaw = attempt.planar_pose
    pose = f"{1e3 * x:+9.1f}{1e3 * y:+9.1f}{math.degrees(yaw):+9.1f}"
    measured = f"{1e3 * attempt.depth:12.2f}{attempt.shear:12.3f}"
    return f"{number + 1:6d}{attempt.number + 1:5d}{pose}{measured}  {attempt_outcome(attempt)}"


def attempt_outcome(attempt: "Attempt") -> str:
    """Outcome of an attempt in words."""
    if attempt.inserted:
        return "in the hole"
    return "stopped by contact" if attempt.stopped_by_contact else "not in the hole"


def preflight_table(items: "list[PreflightItem]") -> Table:
    """Table of the checks before the first motion."""
    table = Table(title="Preflight", show_header=False, box=None)
    for item in items:
        table.add_row(yes_or_no(item.good), item.name, item.text)
    return table


def insertion_table(results: "list[Insertion]") -> Table:
    """Table of the insertions by the robot's own measurements."""
    table = Table(title="Insertions, as measured by the robot")
    for name in ("part", "attempts", "outcome", "time [s]"):
        table.add_column(name, justify="left" if name == "outcome" else "right")
    for result in results:
        count = str(len(result.attempts))
        table.add_row(str(result.number + 1), count, result.outcome, f"{result.duration:.0f}")
    return table


def insertion_to_json(result: "Insertion") -> dict[str, Any]:
    """An insertion as plain data, for `--json`."""
    return {
        "part": result.number + 1,
        "inserted": result.inserted,
        "outcome": result.outcome,
        "seconds": result.duration,
        "attempts": [_attempt_to_json(attempt) for attempt in result.attempts],
    }


def _attempt_to_json(attempt: "Attempt") -> dict[str, Any]:
    values = {
        "pose": attempt.planar_pose,
        "depth": attempt.depth,
        "shear_mm": attempt.shear,
        "outcome": attempt_outcome(attempt),
        "correction": attempt.correction,
    }
    forces = {side: {key: force[key] for key in _FORCE_KEYS} for side, force in attempt.pad_forces.items()}
    return values | ({"force": forces} if forces else {})
