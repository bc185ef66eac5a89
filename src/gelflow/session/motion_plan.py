"""Motion plans: attempts at given poses about a taught hole, as a TOML file that the robot's runner executes.

A calibration writes them (`gelflow calibrate --plan`), so that few attempts have much information.
"""

import math
from dataclasses import dataclass
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.toml_tables import TomlTable, read_toml, toml_text

FORMAT = 1
_KEYS = ("x", "y", "yaw_deg", "depth")
_STOP = "stop_shear_mm"


@dataclass(frozen=True)
class PlannedMotion:
    """One attempt: a descent from the start height at a pose of the gripper relative to the taught hole."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]
    depth: float  # largest depth below the start [m]; contact stops the descent earlier
    stop_shear_mm: float | None = None  # mean shear along the finger that stops it; None: that of the lab file

    @property
    def planar_pose(self) -> tuple[float, float, float]:
        """x [m], y [m], yaw [rad]."""
        return self.x, self.y, self.yaw

    @property
    def text(self) -> str:
        """The motion in words."""
        pose = f"x {1e3 * self.x:+.1f} mm, y {1e3 * self.y:+.1f} mm, yaw {math.degrees(self.yaw):+.1f}°"
        stop = "" if self.stop_shear_mm is None else f" or {self.stop_shear_mm:g} mm of shear"
        return f"{pose}, down to {1e3 * self.depth:.2f} mm{stop}"

    def beyond(
        self, workspace: tuple[float, float, float], max_depth: float, stop_shear_range: tuple[float, float]
    ) -> str:
        """How the motion exceeds the largest |x|, |y| [m], |yaw| [rad] and depth [m]; empty when it does not.

        `stop_shear_range` are the limits of `stop_shear_mm`: above the first, at most the second.
        """
        named = zip(("x", "y", "yaw"), self.planar_pose, workspace, (1e3, 1e3, 180 / math.pi), strict=True)
        found = [
            f"|{name}| is {scale * abs(value):.4g}, at most {scale * limit:.4g} {'°' if name == 'yaw' else 'mm'}"
            for name, value, limit, scale in named
            if not abs(value) <= limit + 1e-9
        ]
        if not 0 < self.depth <= max_depth + 1e-9:
            found.append(f"depth is {1e3 * self.depth:.4g}, must be above 0 and at most {1e3 * max_depth:.4g} mm")
        least, most = stop_shear_range
        if self.stop_shear_mm is not None and not least < self.stop_shear_mm <= most:
            found.append(f"{_STOP} is {self.stop_shear_mm:.4g}, must be above {least:g} and at most {most:g} mm")
        return "; ".join(found)


def load_motion_plan(path: Path) -> tuple[PlannedMotion, ...]:
    """The motions of a plan file. Raises UsageError, in one line that names the file, the motion and the key."""
    table = TomlTable(read_toml(path), str(path)).check_keys(("format", "motions"))
    if (version := table.integer("format")) != FORMAT:
        raise UsageError(f"{path}: motion plan format {version}; this gelflow reads format {FORMAT}")
    given = table.data.get("motions")
    if not isinstance(given, list) or not given or not all(isinstance(motion, dict) for motion in given):
        raise UsageError(f"{path}: the plan has no motions; give each one as a table [[motions]] with {_keys()}")
    motions = []
    for number, data in enumerate(given):
        row = TomlTable(data, f"{path}, motion {number + 1}").check_keys((*_KEYS, _STOP))
        x, y, yaw, depth = (row.number(key) for key in _KEYS)
        stop = row.number(_STOP) if _STOP in data else None
        motions.append(PlannedMotion(x, y, math.radians(yaw), depth, stop))
    return tuple(motions)


def save_motion_plan(motions: tuple[PlannedMotion, ...], path: Path, *, title: str) -> None:
    """Write a plan file; `title` is its first comment. Raises UsageError when the file exists or cannot be written."""
    rows = []
    for m in motions:
        pose = {"x": round(m.x, 7), "y": round(m.y, 7), "yaw_deg": round(math.degrees(m.yaw), 5)}
        stop = {} if m.stop_shear_mm is None else {_STOP: m.stop_shear_mm}
        rows.append({**pose, "depth": round(m.depth, 9), **stop})
    heading = (
        f"# {title}\n# Poses of the gripper relative to the taught hole, and the largest depth of each descent, [m];\n"
        f"# contact stops it earlier, at {_STOP} of mean shear along the finger (without it, that of the lab file).\n"
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(heading + toml_text({"format": FORMAT, "motions": rows}))
    except FileExistsError:
        raise UsageError(f"{path} exists; name a new file with --plan") from None
    except OSError as error:
        raise UsageError(f"cannot write the plan {path}: {error.strerror}") from None


def _keys() -> str:
    return ", ".join(_KEYS)
