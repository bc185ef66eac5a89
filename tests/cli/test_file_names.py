"""File names as found on old disks: not valid UTF-8."""

import os
from pathlib import Path

import pytest

from gelflow.cli.main import main

NAME = os.fsdecode(b"k\xe4")


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images") / "press"
    assert main(["render", "--out", str(folder), "--frames", "3", "--markers", "63"]) == 0
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ["render-scene", "pushing", "--size", "64x64", "--out", "{}.mp4"],
        ["track", "{}.mkv"],
        ["track", "images", "--out", "{}.mkv"],
        ["calibrate-camera", "{}.mkv", "--spacing-mm", "1"],
    ],
)
def test_names_that_opencv_cannot_use_are_refused(
    command: list[str], images: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / NAME)
    (tmp_path / f"{NAME}.mkv").write_bytes(b"RIFF\x00\xff\xfe")
    words = [word.format(file).replace("images", str(images)) for word in command]
    if "--out" in words:
        (tmp_path / f"{NAME}.mkv").unlink()
    assert main(words) == 2
    error = capfd.readouterr().err
    assert "is not valid UTF-8: rename the file" in error and error.count("\n") == 1


def test_tables_escape_such_names_of_images(images: Path, tmp_path: Path) -> None:
    for number, file in enumerate(sorted(images.iterdir())):
        (tmp_path / f"{NAME}{number}{file.suffix}").write_bytes(file.read_bytes())
    table = tmp_path / "table.csv"
    assert main(["track", str(tmp_path), "--out", str(table)]) == 0
    assert "k\\udce40" in table.read_text(encoding="utf-8")


def test_pictures_may_have_such_names(images: Path, tmp_path: Path) -> None:
    drawn, tracked = tmp_path / f"{NAME}.png", tmp_path / f"{NAME}.jpg"
    assert main(["render-scene", "pushing", "--size", "160x120", "--out", str(drawn)]) == 0
    assert main(["track", str(images), "--out", str(tracked)]) == 0
    assert drawn.read_bytes()[:4] == b"\x89PNG" and tracked.read_bytes()[:2] == b"\xff\xd8"
