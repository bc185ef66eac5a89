"""`gelflow render-scene`: films and pictures of included scenes and of bare model files."""

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from gelflow.cli.commands.pictures.render_scene import _write_film
from gelflow.cli.main import main
from gelflow.errors import SimulationError
from gelflow.sim.scene import load_scene

MODEL = """
<mujoco><worldbody><geom name="ground" type="plane" size="1 1 .1"/>
  <body name="arm" pos="0 0 .3"><joint name="hinge" axis="0 1 0"/><geom name="rod" type="capsule" size=".02 .1"/></body>
</worldbody></mujoco>
"""


def test_film_has_the_pictures_of_the_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    controls = np.zeros((20, load_scene("pushing").nu))
    np.savetxt(tmp_path / "u.csv", controls, delimiter=",", encoding="utf-8-sig")
    film = tmp_path / "film.mp4"
    arguments = ["--out", str(film), "--controls", str(tmp_path / "u.csv"), "--size", "160x120"]
    assert main(["render-scene", "pushing", *arguments, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    video = cv2.VideoCapture(str(film))
    count = 0
    while video.read()[0]:
        count += 1
    assert count == result["pictures"] == int(20 * load_scene("pushing").step * 25 + 1e-9) + 1


def test_picture_of_a_bare_model(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(MODEL)
    picture = tmp_path / "arm.png"
    assert main(["render-scene", str(tmp_path / "arm.xml"), "--out", str(picture), "--camera", "front"]) == 0
    image = cv2.imread(str(picture))
    assert image is not None and image.shape == (480, 640, 3) and image.std() > 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "film.gif"], "--out must end in"),
        (["--out", "no/such/folder/film.mp4"], "there is no folder"),
        (["--size", "big"], "--size must be width x height"),
        (["--fps", "0"], "--fps must be within 0.01 to 240, got 0"),
        (["--fps", "1000"], "--fps must be within 0.01 to 240, got 1000"),
        (["--fps", "0.001"], "--fps must be within 0.01 to 240, got 0.001"),
        (["--fps", "nan"], "--fps must be within 0.01 to 240, got nan"),
        (["--speed", "0"], "--speed must be above 0"),
        (["--seconds", "-1"], "--seconds must be at least 0"),
        (["--controls", "missing.npy"], "cannot read missing.npy"),
        (["--camera", "behind"], "no view 'behind'"),
    ],
)
def test_wrong_options_are_refused_and_leave_no_file(
    options: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render-scene", "pushing", *options]) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_controls_of_a_wrong_width_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "u.npy", np.zeros((3, 99)))
    assert main(["render-scene", "pushing", "--controls", str(tmp_path / "u.npy")]) == 2
    assert "must be (steps," in capsys.readouterr().err


def test_an_error_while_drawing_leaves_the_earlier_film(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    film.write_bytes(b"earlier")

    def pictures() -> Iterator[np.ndarray]:
        yield np.zeros((48, 64, 3), dtype=np.uint8)
        raise SimulationError("a step failed")

    with pytest.raises(SimulationError):
        _write_film(film, pictures(), (64, 48), 25.0, "mp4v")
    assert film.read_bytes() == b"earlier" and [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("name", ["empty.csv", "complex.npy"])
def test_controls_without_real_numbers(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty.csv").touch()
    np.save(tmp_path / "complex.npy", np.ones((3, 6), complex))
    arguments = ["--controls", str(tmp_path / name), "--out", str(tmp_path / "p.png")]
    assert main(["render-scene", "pushing", *arguments]) == 2
    error = capsys.readouterr().err
    assert "--controls: " in error and error.count("\n") == 1
