"""Lab files: errors name file, table, key and the nearest valid keys in one line."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import gelflow.real
from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, save_gel
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.perception.camera_calibration import CameraCalibration, save_calibration
from gelflow.real.limits import LAB_RANGES
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab
from gelflow.time_sync import TimeSync

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


def test_a_saved_lab_file_with_any_name_is_read_back(tmp_path: Path) -> None:
    lab = load_lab(EXAMPLE)
    lab = dataclasses.replace(lab, gripper=dataclasses.replace(lab.gripper, address="serial:/tmp/\U0001f916\x7f/pty"))
    save_lab(lab, tmp_path / "lab.toml", title="round trip")
    assert load_lab(tmp_path / "lab.toml") == lab


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
        ("open_width = 0.060", "open_width = 0.030", "part_width must be below open_width, got 0.035 and 0.03 m"),
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
        (
            "pixels_per_mm = 15.7",
            "pixels_per_mm = 1e12",
            "left: pixels_per_mm must be 1 to 200 px/mm, got 1000000000000",
        ),
        (
            '# web_services = "" ',
            'web_services = "192.168.125.1" #',
            "lab.toml, arm: web services: expected http://HOST or http://HOST:PORT, got '192.168.125.1'",
        ),
        ('# web_services = "" ', 'web_services = "http://[1" #', "arm: web services: expected http://HOST"),
        ('# robot = "" ', 'robot = "irc5.local" #', "lab.toml, arm: robot must be the IP address of the controller"),
        ("rows = 18", "rows = 100000", "lab.toml, cameras.left: rows and cols must be 3 to 100, got 100000"),
        ("# stale_gripper = 0.500", "stale_gripper = 0.2", "limits.stale_gripper must be 0.5 to 2 s, got 0.2"),
        ("# latency = 0.0 ", "latency = 0.3 #", "lab.toml, cameras.left: latency must be 0 to 0.2 s, got 0.3"),
        ("pixels_per_mm = 15.7", 'calibration = "none.json"', "lab.toml, cameras.left: cannot read"),
        ("# stale_pose = 0.020", "stale_pose = 0", "lab.toml: limits.stale_pose must be 0.008 to 0.1 s, got 0"),
        ("format = 1", "format = 1\ncameras = 3", "not valid TOML"),
        ('# gel = "" ', r'gel = "a\u0000b" #', "lab.toml, cameras.left: gel must not contain the character NUL"),
        ("http://192.168.1.30", r"uvc:/dev/vid\u0000eo", "cameras.left: source must not contain the character NUL"),
        ("serial:/dev/ttyUSB0", "tcp:192.168.1..20:1000", "lab.toml, gripper: a TCP address needs a valid host and a"),
        ("serial:/dev/ttyUSB0", "tcp:192.168.1.20", "gripper: address 'tcp:192.168.1.20' is neither tcp:HOST:PORT"),
        ("http://192.168.1.30", "http://192.168.1..30", "cameras.left: camera source: expected http://HOST:PORT/path"),
        ('# host = "0.0.0.0" ', 'host = "a..b" #', "lab.toml, arm: host must be an IPv4 address of this computer or"),
        ('# robot = "" ', 'robot = "::1" #', "lab.toml, arm: robot must be the IP address of the controller (IPv4)"),
        ("# height_min = 0.001", "height_min = 0.020", "insert_to must be at least workspace.height_min, got"),
        ("# load_height = 0.040", "load_height = 0.070", "load_height must be at most workspace.height_max, got"),
        (
            "# speed = 0.02 ",
            "speed = 0.005 #",
            "gripper.speed 0.005 m/s is too low: 60 mm take 12.5 s, and limits.gripper_motion is 6.0 s",
        ),
        (
            "# speed = 0.02 ",
            "speed = 0.01 #",
            "gripper.speed 0.01 m/s is too low: 60 mm take 6.5 s",
        ),
    ],
)
def test_errors_name_the_key(tmp_path: Path, example: str, old: str, new: str, expected: str) -> None:
    assert old in example
    assert expected in refused(tmp_path, example.replace(old, new, 1))


def test_a_latency_at_which_every_image_is_stale_is_refused(tmp_path: Path, example: str) -> None:
    text = example.replace("# latency = 0.0 ", "latency = 0.1 #").replace("# stale_frame = 0.250", "stale_frame = 0.1")
    assert "cameras.left.latency must be below limits.stale_frame, got 0.1 and 0.1 s" in refused(tmp_path, text)


def with_value(text: str, key: str, value: str) -> str:
    """A lab file with every key, with another value of the dotted `key`; `cameras.` means the left camera."""
    *table, name = key.replace("cameras.", "cameras.left.").split(".")
    head = rf"\[{re.escape('.'.join(table))}\]\n" if table else ""
    changed, count = re.subn(rf"({head}(?:(?!\[).*\n)*?{name} = ).*", rf"\g<1>{value}", text, count=1)
    assert count == 1
    return changed


def as_toml(before: object, number: float) -> str:
    return f"[{', '.join([str(number)] * len(before))}]" if isinstance(before, tuple) else str(number)


@pytest.mark.parametrize("key", LAB_RANGES)
def test_numbers_outside_their_range_are_refused_with_key_range_and_value(tmp_path: Path, key: str) -> None:
    saved = tmp_path / "saved.toml"
    lab = load_lab(EXAMPLE)
    save_lab(lab, saved, title="all keys")
    owner = lab
    for name in key.replace("cameras.", "cameras.left.").split(".")[:-1]:
        owner = getattr(owner, name)
    before, name, allowed = getattr(owner, key.split(".")[-1]), key.split(".")[-1], LAB_RANGES[key]
    step = 1 if isinstance(before, int) else 1e-3 * (allowed.high - allowed.low)
    wrong = [allowed.low - step, allowed.high + step, 10**9 if isinstance(before, int) else 1e9]
    for number in wrong:
        message = refused(tmp_path, with_value(saved.read_text(), key, as_toml(before, number)))
        assert f"{name} must be {allowed}, got " in message
        assert as_toml(before, number) in message
    if isinstance(before, float):
        for text in ("nan", "inf", "-inf"):
            assert name in refused(tmp_path, with_value(saved.read_text(), key, text))


def test_every_number_of_a_lab_file_has_a_range() -> None:
    def numbers(table: object, path: str) -> set[str]:
        found = set()
        for field in dataclasses.fields(table):  # type: ignore[arg-type]
            value = getattr(table, field.name)
            if dataclasses.is_dataclass(value):
                # Both cameras have the same ranges.
                found |= numbers(value, path if field.name in ("left", "right") else f"{path}{field.name}.")
            elif not isinstance(value, str | bool):
                found.add(path + field.name)
        return found

    # These have their own checks.
    own = {"format", "cameras.rows", "cameras.cols", "cameras.rotation_deg", "tool.quaternion"}
    own |= {"cameras.visible_rows", "cameras.visible_cols"}
    assert numbers(load_lab(EXAMPLE), "") - own == set(LAB_RANGES)


def test_time_limits_of_a_mock_robot_may_be_longer_in_proportion_to_its_clock(tmp_path: Path, example: str) -> None:
    TimeSync.create(sync := str(tmp_path / "time_sync"))
    scaled = example.replace("format = 1", f'format = 1\nclock_factor = 4.0\ntime_sync = "{sync}"')
    path = tmp_path / "lab.toml"
    path.write_text(scaled.replace("# stale_frame = 0.250", "stale_frame = 48.0"))
    assert load_lab(path).limits.stale_frame == 48.0
    message = refused(tmp_path, scaled.replace("# stale_frame = 0.250", "stale_frame = 48.1"))
    assert "limits.stale_frame must be 0.05 to 48 s, got 48.1" in message


@pytest.mark.parametrize("factor", ["0.01", "0.5", "4.0"])
def test_another_clock_than_real_time_needs_a_mock_robot(tmp_path: Path, example: str, factor: str) -> None:
    message = refused(tmp_path, example.replace("# clock_factor = 1.0", f"clock_factor = {factor}"))
    assert "clock_factor must be 1" in message and f"got {factor}" in message


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("http://192.168.1.31:8080/?action=stream", "http://192.168.1.31:8080/?action=stream"),
        ("http://Gel.local/stream", "http://gel.local:80/stream"),
        ("uvc:0", "uvc:/dev/video0"),
    ],
)
def test_one_camera_for_both_fingers_is_refused(tmp_path: Path, example: str, left: str, right: str) -> None:
    text = example.replace("http://192.168.1.30:8080/?action=stream", left)
    text = text.replace("http://192.168.1.31:8080/?action=stream", right)
    assert "lab.toml, cameras: left and right must be two cameras" in refused(tmp_path, text)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("rows = 18", "rows = 17", "rows = 17 and 18"),
        ("cols = 14", "cols = 13", "cols = 13 and 14"),
        ("pitch_mm = 1.4", "pitch_mm = 1.5", "pitch_mm = 1.5 and 1.4"),
        ("center_mm = [2.0, 0.0]", "center_mm = [1.5, 0.0]", "center_mm = [1.5, 0.0] and [2.0, 0.0]"),
    ],
)
def test_different_grids_of_both_pads_are_refused(tmp_path: Path, example: str, old: str, new: str, named: str) -> None:
    message = refused(tmp_path, example.replace(old, new, 1))
    assert f"lab.toml, cameras: left and right must have the same grid of markers, got {named}" in message


def test_uvc_devices_are_named_by_index_or_path(tmp_path: Path, example: str) -> None:
    text = example.replace("http://192.168.1.30:8080/?action=stream", "uvc:/dev/video2")
    path = tmp_path / "lab.toml"
    path.write_text(text.replace("http://192.168.1.31:8080/?action=stream", "uvc:0"))
    lab = load_lab(path)
    assert (lab.cameras.left.source, lab.cameras.right.source) == ("uvc:/dev/video2", "uvc:0")
    message = refused(tmp_path, text.replace("uvc:/dev/video2", "uvc:video2"))
    assert "source must be http://HOST:PORT/…, uvc:INDEX or uvc:/dev/videoN, got 'uvc:video2'" in message


def test_calibration_path_is_relative_to_the_lab_file(tmp_path: Path, example: str) -> None:
    matrix = ((13.0, 0.0, 0.0), (0.0, 13.0, 0.0), (0.0, 0.0, 1.0))
    calibration = CameraCalibration(320, 427, 18, 14, 1.4, matrix, (-0.1,), (159.5, 213.0), 0.1, 0.2)
    save_calibration(calibration, tmp_path / "left.json")
    path = tmp_path / "lab.toml"
    path.write_text(example.replace("pixels_per_mm = 15.7", 'calibration = "left.json"', 1), encoding="utf-8")
    lab = load_lab(path)
    assert lab.cameras.left.mount.calibration == calibration and lab.cameras.right.mount.pixels_per_mm == 15.7
    save_lab(lab, tmp_path / "elsewhere" / "lab.toml", title="the same calibration")
    assert load_lab(tmp_path / "elsewhere" / "lab.toml") == lab
    path.write_text(path.read_text().replace("\nrows = 18", "\nrows = 17"))
    assert "lab.toml, cameras.left: the calibration is for 18 rows of 14" in refused(tmp_path, path.read_text())


def test_gel_path_is_relative_to_the_lab_file(tmp_path: Path, example: str) -> None:
    save_gel(ElasticGel(1.5e5, 0.48, 3e-3), tmp_path / "left_gel.toml")
    path = tmp_path / "lab.toml"
    path.write_text(example.replace('# gel = ""', 'gel = "left_gel.toml"', 1), encoding="utf-8")
    lab = load_lab(path)
    assert lab.cameras.left.gel == str(tmp_path / "left_gel.toml")
    assert lab.cameras.left.elastic_gel == ElasticGel(1.5e5, 0.48, 3e-3)
    assert lab.cameras.right.elastic_gel is None


def test_wrong_gel_is_refused_in_one_line(tmp_path: Path, example: str) -> None:
    text = example.replace('# gel = ""', 'gel = "left_gel.toml"', 1)
    assert "lab.toml, cameras.left: no such file" in refused(tmp_path, text)
    (tmp_path / "left_gel.toml").write_text("format = 1\n[gel]\nyoungs_modulus = -1.0\n")
    assert "left_gel.toml, gel: poisson_ratio is missing" in refused(tmp_path, text)
    (tmp_path / "left_gel.toml").unlink()
    save_gel(ElasticGel(1.5e5, 0.48, 3e-3), tmp_path / "left_gel.toml")
    fine = text.replace("rows = 18\ncols = 14", "rows = 40\ncols = 30")
    assert "cameras.left: forces need a grid of" in refused(tmp_path, fine)


def test_visible_lines_are_read_and_checked(tmp_path: Path, example: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(example.replace("# visible_cols = [0, 0]", "visible_cols = [1, 12]", 1), encoding="utf-8")
    lab = load_lab(path)
    assert lab.cameras.left.mount.image_grid == (18, 12) and lab.cameras.right.mount.image_grid == (18, 14)
    save_lab(lab, tmp_path / "again.toml", title="visible lines")
    assert load_lab(tmp_path / "again.toml") == lab
    for lines, expected in (
        ("[1, 15]", "cameras.left: visible_cols must name the first and the last of at least 3 lines of 1 to 14"),
        ("[2, 13]", "cameras.left: a grid that extends beyond two opposite borders of the image needs a calibration"),
        ("[1.5, 12]", "cameras.left: visible_cols must be 2 integers, got [1.5, 12]"),
    ):
        text = example.replace("# visible_cols = [0, 0]", f"visible_cols = {lines}", 1)
        assert expected in refused(tmp_path, text)


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
