"""Images that show a part of the printed grid: calibrate-camera, lab files with its result, track, preflight."""

import json
import re
import socket
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.real.runner.harness import FACTOR, OraclePolicy, free_port, plan_for

from gelflow.cli.main import main
from gelflow.errors import SafetyError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.world import CameraView, World
from gelflow.mock_lab.lab import lab_for
from gelflow.perception import load_calibration
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.lens import Lens
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import dry_run

EXAMPLE = Path(__file__).parents[2] / "real/runner/lab_example.toml"


def picture(path: Path, *, cut: tuple[int, int] = (0, 0), lens: Lens | None = None, zoom: float = 1.0) -> str:
    """An image of the gel at rest; `cut` removes pixels at its right and lower border."""
    look = GelAppearance(pixels_per_mm=15.7 * zoom, radius=4.4 * zoom)
    image = FastGelRenderer(look, lens=lens).render(np.zeros((252, 2)))
    assert cv2.imwrite(str(path), image[: 427 - cut[1], : 320 - cut[0]])
    return str(path)


def calibrate(image: str, out: Path, *options: str) -> int:
    return main(["calibrate-camera", image, "--spacing-mm", "1.4", "--out", str(out), *options])


@pytest.mark.parametrize("lens", [None, Lens((8.0, -8.0), 30.0, 0.06)])
def test_the_lab_file_accepts_the_calibration_of_a_partly_visible_grid(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], lens: Lens | None
) -> None:
    image = picture(tmp_path / "rest.png", cut=(48, 0), lens=lens)  # the image border cuts the third column
    assert calibrate(image, tmp_path / "left.json", "--rows", "18", "--cols", "14") == 2
    told = capsys.readouterr().err
    choices = re.findall(r"--visible-rows 1 18 --visible-cols (\d+) (\d+)", told)
    assert "does not show which lines" in told and ("1", "12") in choices
    options = ["--rows", "18", "--cols", "14", "--visible-rows", "1", "18", "--visible-cols", "1", "12"]
    assert calibrate(image, tmp_path / "left.json", *options, "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert values["printed_grid"] == [18, 14] and values["skipped_lines"] == [0, 0, 0, 2]
    text = EXAMPLE.read_text().replace("pixels_per_mm = 15.7", 'calibration = "left.json"', 1)
    (tmp_path / "lab.toml").write_text(text)
    mount = load_lab(tmp_path / "lab.toml").cameras.left.mount
    assert mount.image_grid == (18, 12) and mount.pad_lines(mount.skipped) == ((1, 18), (3, 14))  # mirrored
    # The calibration also tells the lines to the tracker.
    assert main(["track", image, "--calibration", str(tmp_path / "left.json"), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["visible_rows"] == [1, 18] and values["visible_cols"] == [1, 12] and values["tracked_share"] > 0.97


def test_a_calibration_without_the_printed_grid_names_the_missing_options(tmp_path: Path) -> None:
    image = picture(tmp_path / "rest.png", cut=(48, 0))
    assert calibrate(image, tmp_path / "left.json") == 0 and load_calibration(tmp_path / "left.json").cols == 12
    text = EXAMPLE.read_text().replace("pixels_per_mm = 15.7", 'calibration = "left.json"', 1)
    (tmp_path / "lab.toml").write_text(text)
    with pytest.raises(Exception, match=r"cameras\.left: .* calibrate with --rows 18 --cols 14"):
        load_lab(tmp_path / "lab.toml")


def test_visible_lines_that_the_image_does_not_show_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = picture(tmp_path / "rest.png", cut=(48, 0))
    out = tmp_path / "left.json"
    printed = ["--rows", "18", "--cols", "14"]
    for options, expected in (
        ([*printed, "--visible-cols", "1", "11"], "does not show these lines"),
        (["--visible-cols", "1", "12"], "need --rows and --cols"),
        (
            ["--rows", "16", "--cols", "9"],
            "the image shows 18 rows of 12 markers, which is no part of a grid",
        ),
    ):
        assert calibrate(image, out, *options) == 2
        assert expected in capsys.readouterr().err and not out.exists()


def test_track_says_how_many_of_how_many_markers_are_visible(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = picture(tmp_path / "cut.png", cut=(0, 100), lens=Lens((3.0, 0.0)), zoom=0.75)
    assert main(["track", cut, "--rows", "18", "--cols", "14", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["printed_grid"] == [18, 14] and values["visible_cols"] == [1, 14]
    assert values["visible_rows"][0] == 1 and values["rows"] == values["visible_rows"][1] < 18
    assert main(["track", cut, "--rows", "18", "--cols", "14"]) == 0
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert f"{14 * values['rows']} of 252 printed markers: rows 1-{values['rows']} of 18, columns 1-14 of 14" in told
    near = picture(tmp_path / "near.png", zoom=1.2)
    assert main(["track", near, "--rows", "18", "--cols", "14"]) == 0
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "of 252 printed markers" in told and "the image does not show which" in told


def mock_robot(view: CameraView) -> MockRobot:
    world = World(left_camera=view, right_camera=replace(view))
    cell = SimulatedCellConfig(seed=2, world=world)
    return MockRobot(FACTOR, MockRobotConfig(cell=cell, egm_port=free_port(socket.SOCK_DGRAM)))


@pytest.mark.slow
def test_preflight_names_the_visible_lines_of_a_cropped_view(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The border cuts off one column on each side.
    with mock_robot(CameraView(pixels_per_mm=17.8, dot_radius_px=4.9)) as robot:
        lab = lab_for(robot)
        sides = {}
        for name, camera in (("left", lab.cameras.left), ("right", lab.cameras.right)):
            whole = replace(camera, visible_rows=(0, 0), visible_cols=(0, 0), calibration="", pixels_per_mm=17.8)
            sides[name] = whole
        wrong = replace(lab, cameras=replace(lab.cameras, **sides))
        with pytest.raises(SafetyError, match=r"192 of 252 .* visible_cols = \[2, 13\] in the lab file"):
            dry_run(plan_for(robot, tmp_path / "wrong", OraclePolicy(robot), lab=wrong))
        for name, camera in sides.items():
            out = tmp_path / f"{name}.json"
            options = ["--rows", "18", "--cols", "14", "--visible-rows", "2", "17", "--visible-cols", "2", "13"]
            assert calibrate(camera.source, out, *options) == 0
            sides[name] = replace(camera, calibration=str(out), pixels_per_mm=0.0)
        right = replace(lab, cameras=replace(lab.cameras, **sides))
        result = dry_run(plan_for(robot, tmp_path, OraclePolicy(robot), lab=right))
        cameras = [item.text for item in result.items if item.name.endswith("camera")]
        assert len(cameras) == 2
        assert all("192 of 252 markers: rows 2-17 of 18, columns 2-13 of 14" in text for text in cameras)
        assert np.isfinite(result.observation.image).all()
