"""The table of motion limits: one source for all configurations, and the same numbers in the documentation."""

import dataclasses
import math
import re
from pathlib import Path

import gelflow.real
from gelflow.real.egm.config import EgmConfig
from gelflow.real.limits import LAB_RANGES, LIMITS
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.wsg.config import WsgConfig

ROOT = Path(__file__).resolve().parents[2]


def test_configurations_use_the_table() -> None:
    lab = load_lab(Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml")
    assert (lab.arm.max_speed, lab.arm.max_turn_speed_deg) == (LIMITS.tool_speed, LIMITS.tool_turn_speed_deg)
    assert (lab.workspace.max_step, lab.workspace.max_turn_deg) == (LIMITS.target_distance, LIMITS.target_turn_deg)
    assert (lab.workspace.height_min, lab.workspace.height_max) == LIMITS.workspace_height
    assert (lab.limits.stale_pose, lab.limits.stale_frame) == (LIMITS.pose_age, LIMITS.image_age)
    arm = EgmConfig((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert (arm.max_speed, arm.max_step, arm.stale) == (LIMITS.tool_speed, LIMITS.target_distance, LIMITS.pose_age)
    assert arm.max_turn_speed == math.radians(LIMITS.tool_turn_speed_deg)
    gripper = WsgConfig()
    assert (gripper.limits.width, gripper.limits.speed) == (LIMITS.gripper_width, LIMITS.gripper_speed)
    assert (gripper.limits.force, gripper.stale_after) == (LIMITS.gripper_force, LIMITS.gripper_age)


def test_documentation_shows_the_same_numbers() -> None:
    page = (ROOT / "docs" / "reference" / "robot_limits.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| [^|]+ \| `(\w+)` \| ([^|]+) \|", page, flags=re.M))
    assert set(rows) == {field.name for field in dataclasses.fields(LIMITS)}
    for name, text in rows.items():
        shown = [float(number.replace("−", "-")) for number in re.findall(r"[−-]?\d+(?:\.\d+)?", text)]
        value = getattr(LIMITS, name)
        if name == "joint_ranges_deg":
            assert shown == [bound for low, high in value for bound in ((high,) if -low == high else (low, high))]
        else:
            assert shown == list(value if isinstance(value, tuple) else (value,))


def test_documentation_shows_the_ranges_of_the_lab_file() -> None:
    page = (ROOT / "docs" / "reference" / "robot_limits.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \| ?(yes)? ?\|$", page, flags=re.M)
    shown = {key: (text, time_limit == "yes") for key, text, time_limit in rows}
    assert shown == {key: (str(allowed), allowed.time_limit) for key, allowed in LAB_RANGES.items()}


def test_defaults_are_within_the_ranges() -> None:
    assert LAB_RANGES["arm.max_speed"].low < LIMITS.tool_speed < LAB_RANGES["arm.max_speed"].high
    assert LAB_RANGES["limits.stale_frame"].low < LIMITS.image_age < LAB_RANGES["limits.stale_frame"].high
    assert LAB_RANGES["limits.target_lifetime"].high == LIMITS.longest_target_lifetime
