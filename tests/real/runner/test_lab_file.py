"""Lab files: errors name file, table, key and the nearest valid keys in one line."""

import re
from pathlib import Path

import numpy as np
import pytest

import gelflow.real
from gelflow.errors import UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.perception.calibration import Calibration, save_calibration
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab

EXAMPLE = Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml"


@pytest.fixture
def example() -> str:
    return EXAMPLE.read_text(encoding="utf-8")


def refused(tmp_path: Path, text: str) -> str:
    path = tmp_path / "lab.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError) as error:
        load_lab(path)
    message = str(error.value)
    assert message.startswith(str(path)) and "\n" not in message
    return message


def test_commented_keys_of_the_example_show_the_defaults(tmp_path: Path, example: str) -> None:
    lab = load_lab(EXAMPLE)
    assert lab.descent.speed == 0.5e-3 and lab.clock_factor == 1.0
    path = tmp_path / "all.toml"
    path.write_text(re.sub(r"^# (\w+ = )", r"\1", example, flags=re.M), encoding="utf-8")
    assert load_lab(path) == lab


def test_example_contains_every_key(tmp_path: Path, example: str) -> None:
    saved = tmp_path / "saved.toml"
    save_lab(load_lab(EXAMPLE), saved, title="all keys")
    shown = set(re.findall(r"^(?:# )?(\w+) = ", example, flags=re.M))
    assert set(re.findall(r"^(\w+) = ", saved.read_text(), flags=re.M)) == shown


def test_saved_lab_file_round_trip(tmp_path: Path) -> None:
    lab = load_lab(EXAMPLE)
    save_lab(lab, tmp_path / "deep" / "lab.toml", title="round trip")
    assert load_lab(tmp_path / "deep" / "lab.toml") == lab


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "grasp_force = 12.0",
            "grasp_forc = 12.0",
            "lab.toml, gripper: unknown key 'grasp_forc'; did you mean 'grasp_force'?",
        ),
        ("[hole] ", "[holes] ", "lab.toml: unknown key 'holes'; did you mean 'hole'?"),
        ("format = 1", 'format = 1\nclock_pace = ""', "unknown key 'clock_pace'; it is now called 'time_sync'"),
        ("rows = 18", "row = 18", "lab.toml, cameras.left: unknown key 'row'; did you mean 'rows'?"),
        ("part_width = 0.035", "# none", "lab.toml, gripper: part_width is missing"),
        ("format = 1", "format = 2", "lab file format 2; this gelflow reads format 1"),
        ("format = 1", "", "lab.toml: format is missing"),
        (
            "grasp_force = 12.0",
            'grasp_force = "much"',
            "lab.toml, gripper: grasp_force must be a finite number, got 'much'",
        ),
        ("grasp_force = 12.0", "grasp_force = nan", "grasp_force must be a finite number"),
        ("grasp_force = 12.0", "grasp_force = 300", "lab.toml, gripper: grasp_force must be 5 to 80 N, got 300"),
        ("open_width = 0.060", "open_width = 0.030", "0 < part_width < open_width"),
        ("serial:/dev/ttyUSB0", "/dev/ttyUSB0", "address must be serial:DEVICE or tcp:HOST:PORT"),
        ("rows = 18", "rows = 18.5", "rows must be an integer, got"),
        ("rows = 18", "rows = true", "rows must be an integer, got"),
        (
            "position = [0.374, 0.05, 0.05]",
            "position = [0.374, 0.05]",
            "lab.toml, hole: position must be 3 finite numbers",
        ),
        ("quaternion = [0.0, 1.0,", "quaternion = [0.0, 2.0,", "quaternion must have length 1, got 2.0000"),
        ("# rotation_deg = 0 ", "rotation_deg = 45 #", "rotation_deg must be 0, 90, 180 or 270, got 45"),
        ('# presentation = "prompt"', 'presentation = "hope"', 'presentation must be "prompt" or "wait"'),
        ("# stop_shear_mm = 0.12", "stop_shear_mm = 0.01", "stop_shear_mm must be above contact_shear_mm"),
        ("pixels_per_mm = 15.7", "pixels_per_mm = 0.0", "lab.toml, cameras.left: give either calibration"),
        ("pixels_per_mm = 15.7", 'calibration = "none.json"', "lab.toml, cameras.left: cannot read"),
        ("# stale_pose = 0.020", "stale_pose = 0", "stale_pose must be above 0"),
        ("format = 1", "format = 1\ncameras = 3", "not valid TOML"),
    ],
)
def test_errors_name_the_key(tmp_path: Path, example: str, old: str, new: str, expected: str) -> None:
    assert old in example
    assert expected in refused(tmp_path, example.replace(old, new, 1))


def test_calibration_path_is_relative_to_the_lab_file(tmp_path: Path, example: str) -> None:
    matrix = ((13.0, 0.0, 0.0), (0.0, 13.0, 0.0), (0.0, 0.0, 1.0))
    calibration = Calibration(320, 427, 18, 14, 1.4, matrix, (-0.1,), (159.5, 213.0), 0.1, 0.2)
    save_calibration(calibration, tmp_path / "left.json")
    path = tmp_path / "lab.toml"
    path.write_text(example.replace("pixels_per_mm = 15.7", 'calibration = "left.json"', 1), encoding="utf-8")
    lab = load_lab(path)
    assert lab.cameras.left.mount.calibration == calibration and lab.cameras.right.mount.pixels_per_mm == 15.7
    save_lab(lab, tmp_path / "elsewhere" / "lab.toml", title="the same calibration")
    assert load_lab(tmp_path / "elsewhere" / "lab.toml") == lab
    path.write_text(path.read_text().replace("rows = 18", "rows = 17", 1))
    assert "lab.toml, cameras.left: the calibration is for 18 rows of 14" in refused(tmp_path, path.read_text())


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no such file: .*none\.toml"):
        load_lab(tmp_path / "none.toml")


def test_tool_and_gripper_poses_are_inverse_to_each_other() -> None:
    lab: Lab = load_lab(EXAMPLE)
    gripper = Pose(np.array([0.3, -0.1, 0.2]), yaw_quaternion(0.4))
    tool = lab.tool_pose(gripper)
    # The flange points down, 180 mm above the pads.
    assert tool.position == pytest.approx([0.3, -0.1, 0.38])
    back = lab.gripper_pose(tool.position, tool.quaternion)
    assert back.position == pytest.approx(gripper.position) and back.yaw == pytest.approx(0.4)
