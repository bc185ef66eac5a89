"""`gelflow track` and `gelflow calibrate-camera`: written files, killed runs, errors."""

import csv
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.perception.camera_calibration import load_calibration
from gelflow.perception.frames import CameraMount
from gelflow.perception.output.summary import TrackingSummary
from gelflow.perception.output.writers import TrackedImage, TrackWriter, open_writer
from gelflow.perception.sources import ImageSource, SourceImage
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import TrackingResult
from gelflow.session.reader import SessionReader
from gelflow.session.recovery import recover
from gelflow.view.tracking.tracking_page import TrackingPage

MAIN = [sys.executable, "-c", "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"]
LOOK = GelAppearance(grid=Grid(rows=8, cols=6, pitch=2.2), width=240, height=320, noise=0.5)


def track(*arguments: str) -> tuple[int, str]:
    """Exit status and standard error of the command in a separate process: video libraries also write to stderr."""
    run = subprocess.run([*MAIN, "track", *arguments], capture_output=True, text=True)
    return run.returncode, run.stderr


def field(number: int) -> np.ndarray:
    """Displacement of every marker in image `number` [mm] on the pad (x down the image, y to its left)."""
    return np.tile([0.05 * number, -0.03 * number], (48, 1))


def draw(folder: Path, images: int) -> Path:
    renderer = FastGelRenderer(LOOK)
    folder.mkdir()
    for number in range(images):
        data = renderer.encode(renderer.render(field(number % 12), sequence=number))
        (folder / f"{number}.jpg").write_bytes(data)
    return folder


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as text:
        return list(csv.DictReader(text))


@pytest.mark.parametrize("source", ["broken.jpg", "missing.mp4", "empty", "notes.txt", "zeros.mp4", "none.mcap"])
def test_a_source_without_images_is_an_error_of_one_line(source: str, tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_text("not an image\n" * 50)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("sechs Gramm, 5 µm\n" * 300)
    (tmp_path / "zeros.mp4").write_bytes(bytes(5000))
    status, error = track(str(tmp_path / source), "--out", str(tmp_path / "out.csv"))
    assert status == 2
    assert error.startswith("gelflow track: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out.csv").exists()


def test_an_unreachable_stream_is_an_error_of_one_line() -> None:
    status, error = track("http://127.0.0.1:9/?action=stream")
    assert status == 2
    assert "Connection refused" in error
    assert error.count("\n") == 1


def test_written_files_contain_the_rendered_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw(tmp_path / "images", 12)
    fit, table, video, session = (tmp_path / name for name in ("gel.json", "t.csv", "o.mkv", "s.mcap"))
    assert main(["calibrate-camera", str(folder), "--spacing-mm", "2.2", "--out", str(fit)]) == 0
    assert load_calibration(fit).residual_px < 0.1 and fit.with_suffix(".png").exists()
    outputs = ["--out", str(table), "--out", str(video), "--out", str(session)]
    assert main(["track", str(folder), "--calibration", str(fit), *outputs, "--rate", "10"]) == 0
    told = capsys.readouterr().out
    for words in ("48: 8 rows of 6", "100.0 %", "rest jitter", "0.64", "a second tracked"):
        assert words in told
    rows = rows_of(table)
    assert len(rows) == 12 * 48
    for row in rows:
        x, y = field(int(row["frame"]))[0]
        assert (int(row["row"]), int(row["col"])) == divmod(int(row["marker"]), 6)
        assert abs(float(row["dx_mm"]) + y) < 0.02 and abs(float(row["dy_mm"]) - x) < 0.02
        assert float(row["stamp"]) == pytest.approx(int(row["frame"]) / 10) and row["valid"] == "1"
    film = cv2.VideoCapture(str(video))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10, rel=0.01)
    assert sum(film.read()[0] for _ in range(13)) == 12
    with SessionReader(session) as reader:
        records = [record.value for record in reader.records(["/left/markers"])]
        assert reader.counts()["/left/image"] == len(records) == 12
    assert np.allclose(records[-1]["displacement_mm"][0], [-field(11)[0, 1], field(11)[0, 0]], atol=0.02)
    # Tracking the recording gives the same numbers.
    assert main(["track", str(session), "--out", str(tmp_path / "again.csv")]) == 0
    same = [(a["x_px"], a["dx_px"], a["quality"]) for a in rows_of(tmp_path / "again.csv")]
    assert same == [(a["x_px"], a["dx_px"], a["quality"]) for a in rows]


def test_a_killed_run_leaves_readable_files(tmp_path: Path) -> None:
    folder = draw(tmp_path / "images", 12)
    files = list(folder.iterdir())
    for number in range(12, 3000):  # more than it can process before the kill
        (folder / f"{number}.jpg").hardlink_to(files[number % 12])
    table, video, session = (tmp_path / name for name in ("t.csv", "o.mkv", "s.mcap"))
    outputs = ["--out", str(table), "--out", str(video), "--out", str(session)]
    run = subprocess.Popen([*MAIN, "track", str(folder), *outputs], stdout=subprocess.DEVNULL)
    while not table.exists() or table.stat().st_size < 600_000:  # about 130 images
        assert run.poll() is None
        time.sleep(0.05)
    run.kill()
    assert run.wait() == -9
    rows = rows_of(table)
    images = int(rows[-1]["frame"])
    assert 100 < images < 2999 and all(None not in row.values() for row in rows[:-48])
    film = cv2.VideoCapture(str(video))
    assert sum(film.read()[0] for _ in range(images)) > 5
    recover(session, tmp_path / "whole.mcap")
    with SessionReader(tmp_path / "whole.mcap") as reader:
        assert reader.counts()["/left/markers"] >= images // 50 * 50  # the recorder waits for the disk every 50 images


@pytest.mark.parametrize("name", ["t.csv", "o.mkv", "o.avi", "o.mp4", "s.mcap"])
def test_a_full_disk_is_an_error(name: str, tmp_path: Path) -> None:
    full = [*MAIN[:2], f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (30000, 30000)); {MAIN[2]}"]
    words = ["track", str(draw(tmp_path / "images", 40)), "--json", "--out", str(tmp_path / name)]
    run = subprocess.run([*full, *words], capture_output=True, text=True)
    assert run.returncode == 2 and "Traceback" not in run.stderr
    result = json.loads(run.stdout)
    assert not result["complete"]
    assert all(Path(file).stat().st_size for file in result["files"])
    assert all(file.stat().st_size for file in tmp_path.iterdir())
    assert name in run.stderr.splitlines()[-1]  # OpenCV writes warnings before


@pytest.mark.parametrize("first", ["a.csv", "a.mcap", "a.png"])
def test_a_file_that_cannot_be_created_leaves_none_of_the_others(
    first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(file: Path, **options: Any) -> TrackWriter:
        if file.name == "b.csv":
            raise UsageError("b.csv cannot be created: No space left on device")
        return open_writer(file, **options)

    images, out = str(draw(tmp_path / "images", 2)), tmp_path / "out"
    out.mkdir()
    command = ["track", images, "--out", str(out / first), "--out", str(out / "b.csv")]
    with monkeypatch.context() as patch:
        patch.setattr("gelflow.cli.commands.track.open_writer", opened)
        assert main(command) == 2
    assert "No space left" in capsys.readouterr().err
    assert list(out.iterdir()) == []
    assert main(command) == 0


def test_a_picture_that_cannot_be_written_leaves_no_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*arguments: object) -> None:
        raise UsageError("cannot write the picture: No space left on device")

    command = ["calibrate-camera", str(draw(tmp_path / "images", 1)), "--spacing-mm", "2.2"]
    command += ["--out", str(tmp_path / "left.json")]
    with monkeypatch.context() as patch:
        patch.setattr("gelflow.cli.commands.calibrate_camera.draw_calibration", full)
        assert main(command) == 2
    assert "No space left" in capsys.readouterr().err and not (tmp_path / "left.json").exists()
    assert main(command) == 0 and (tmp_path / "left.png").exists()


def test_a_camera_number_beyond_all_cameras_is_an_error() -> None:
    status, error = track("99999999999")
    assert status == 2 and "camera 99999999999 cannot be opened" in error and "Traceback" not in error


def test_a_recording_waits_for_a_slow_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = os.fsync

    def wait_for_disk(file: int) -> None:
        time.sleep(1.3)  # longer than a run of a robot allows
        stored(file)

    folder = draw(tmp_path / "images", 60)
    monkeypatch.setattr(os, "fsync", wait_for_disk)
    assert main(["track", str(folder), "--out", str(tmp_path / "s.mcap")]) == 0
    with SessionReader(tmp_path / "s.mcap") as reader:
        assert reader.counts()["/left/markers"] == 60


@pytest.mark.parametrize(("rate", "expected"), [(99.9985, 100.0), (0.0151, 0.015), (1000.0, 240.0)])
def test_a_video_has_the_nearest_rate_that_its_file_can_have(rate: float, expected: float, tmp_path: Path) -> None:
    video = tmp_path / "o.mkv"
    assert main(["track", str(draw(tmp_path / "images", 28)), "--rate", str(rate), "--out", str(video)]) == 0
    film = cv2.VideoCapture(str(video))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(expected, rel=0.01)
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 28


def test_a_failed_start_saves_a_picture_and_no_empty_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((240, 320, 3), 120, dtype=np.uint8))
    table, fit = tmp_path / "t.csv", tmp_path / "gel.json"
    assert main(["track", str(tmp_path / "blank.png"), "--out", str(table)]) == 2
    assert main(["calibrate-camera", str(tmp_path / "blank.png"), "--spacing-mm", "1.4", "--out", str(fit)]) == 2
    told = capsys.readouterr().err.splitlines()
    for line, file in zip(told, (table, fit), strict=True):
        picture = file.with_name(f"{file.stem}-refused.png")
        seen = cv2.imread(str(picture))
        assert str(picture) in line and seen is not None and seen.shape == (240, 320, 3)
        assert not file.exists()


def test_a_live_source_may_begin_with_black_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    renderer = FastGelRenderer(LOOK)
    black = np.full((320, 240, 3), 3, dtype=np.uint8)
    pictures = [black, black, *(renderer.render(field(number), sequence=number) for number in range(4))]
    images = [SourceImage(f"{number:06d}", picture, number / 25) for number, picture in enumerate(pictures)]
    with monkeypatch.context() as patch:
        patch.setattr(ImageSource, "_from_capture", lambda source: iter(images))
        assert main(["track", "0", "--images", "3", "--out", "t.csv", "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert main(["calibrate-camera", "0", "--spacing-mm", "2.2", "--out", "fit.json"]) == 0
    assert result["images"] == 3 and result["unreadable_images"] == 2
    assert result["first_unreadable"].startswith("image 000000: ")
    assert [row["image"] for row in rows_of(Path("t.csv"))[::48]] == ["000002", "000003", "000004"]
    assert load_calibration(Path("fit.json")).residual_px < 0.1
    seconds = [SourceImage(f"{number}", black, float(number)) for number in range(9)]
    monkeypatch.setattr(ImageSource, "_from_capture", lambda source: iter(seconds))
    assert main(["track", "0", "--out", "u.csv"]) == 2
    assert "u-refused.png" in capsys.readouterr().err and not Path("u.csv").exists()


def test_a_picture_of_a_failed_start_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((240, 320, 3), 120, dtype=np.uint8))
    kept = tmp_path / "t-refused.png"
    kept.write_bytes(b"mine")
    for name in ("t-refused-2.png", "t-refused-3.png"):
        assert main(["track", str(tmp_path / "blank.png"), "--out", str(tmp_path / "t.csv")]) == 2
        assert str(tmp_path / name) in capsys.readouterr().err and (tmp_path / name).stat().st_size > 100
    assert kept.read_bytes() == b"mine"


def test_unreadable_images_are_skipped_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw(tmp_path / "images", 6)
    for number in (0, 3):
        (folder / f"{number}.jpg").write_bytes((folder / f"{number}.jpg").read_bytes()[:500])
    assert main(["track", str(folder), "--out", str(tmp_path / "t.csv")]) == 0
    assert "2 unreadable" in capsys.readouterr().out
    assert len(rows_of(tmp_path / "t.csv")) == 4 * 48
    assert main(["track", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["images"] == 4 and result["unreadable_images"] == 2 and "0.jpg" in result["first_unreadable"]
    assert main(["calibrate-camera", str(folder), "--spacing-mm", "2.2", "--out", str(tmp_path / "g.json")]) == 2
    assert "0.jpg: expected a JPEG or PNG image" in capsys.readouterr().err and not (tmp_path / "g.json").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--out", "notes.csv"], "notes.csv exists; name a new file"),
        (["--out", "film.gif"], "suffix must be one of .csv, .mcap, .mp4, .mkv, .avi"),
        (["--out", "t.mkv", "--out", "./t.mkv"], "--out names t.mkv twice"),
        (["--out", "/proc/t.mkv"], "/proc/t.mkv: "),  # no user can write there
        (["--out", "none/t.csv"], "the folder none does not exist"),
        (["--calibration", "none.json"], "cannot read none.json"),
        (["--calibration", "other.json"], "for images of 320 × 427 px, this one has 240 × 320"),
        (["--sensor", "middle"], "sensor must be left or right"),
        (["--rate", "0"], "rate must be"),
        (["--images", "0"], "--images must be at least 1"),
        (["--magnify", "inf"], "--magnify must be above 0 and at most 1e+06, got inf"),
        (["--magnify", "nan"], "--magnify must be above 0 and at most 1e+06, got nan"),
        (["--pixels-per-mm", "0.0333"], "a scale of 0.0333 px/mm is impossible for markers 34."),
        (["--pixels-per-mm", "1e9"], "must be within 0.01 to 50 mm; correct --pixels-per-mm"),
        (["--pixels-per-mm", "20", "--profile", "mine.toml"], "pitch of the profile is 2.2 mm: --pixels-per-mm 15."),
    ],
)
def test_wrong_options_are_errors(
    options: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    draw(Path("images"), 1)
    Path("notes.csv").write_text("mine")
    Path("mine.toml").write_text('format = 1\ntitle = "mine"\n[markers]\npitch_mm = 2.2\n')
    if "other.json" in options:
        Path("big.jpg").write_bytes(FastGelRenderer().encode(FastGelRenderer().render(np.zeros((252, 2)))))
        assert main(["calibrate-camera", "big.jpg", "--spacing-mm", "1.4", "--out", "other.json"]) == 0
    assert main(["track", "images", *options]) == 2
    assert expected in capsys.readouterr().err and Path("notes.csv").read_text() == "mine"


def test_jitter_is_the_noise_without_the_motion() -> None:
    rng = np.random.default_rng(0)
    rest = np.stack(np.meshgrid(np.arange(13), np.arange(10)), axis=-1).reshape(-1, 2) * 20.0
    summary, yes = TrackingSummary(), np.ones(130, dtype=bool)
    for number in range(60):
        shake = rng.normal(0, 1.0, 2)  # motion of the camera
        moved = 0.05 * number * np.sin(rest / 100) + shake + rng.normal(0, 0.03, rest.shape)
        tracked = TrackingResult(rest + moved, moved, yes, ~yes, yes.astype(float), 10, 13, 20.0)
        summary.add(TrackedImage(number, SourceImage("", np.zeros((1, 1, 3), np.uint8), number / 25), tracked), 1e-3)
    assert summary.jitter() == pytest.approx(0.03, rel=0.2)


def test_jitter_of_a_short_recording_is_not_that_of_its_reference() -> None:
    """The reference is the running mean of the first eight images, with which the displacements are too small."""
    rng = np.random.default_rng(0)
    rest = np.stack(np.meshgrid(np.arange(13), np.arange(10)), axis=-1).reshape(-1, 2) * 20.0
    summary, yes = TrackingSummary(), np.ones(130, dtype=bool)
    positions = rest + rng.normal(0, 0.03, (12, 130, 2))
    for number, position in enumerate(positions):
        moved = position - positions[: min(number, 7) + 1].mean(0)
        tracked = TrackingResult(position, moved, yes, ~yes, yes.astype(float), 10, 13, 20.0)
        summary.add(TrackedImage(number, SourceImage("", np.zeros((1, 1, 3), np.uint8), number / 25), tracked), 1e-3)
    assert summary.jitter() == pytest.approx(0.03, rel=0.2)


def test_a_ruler_replaces_the_spacing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "rest.png"), FastGelRenderer(LOOK).render(field(0)))
    length = 200 / LOOK.pixels_per_mm  # [mm]
    words = ["calibrate-camera", str(tmp_path / "rest.png"), "--out", str(tmp_path / "fit.json")]
    assert main([*words, "--ruler", "20", "160", "220", "160", f"{length}"]) == 0
    printed = re.search(r"([0-9.]+) mm between neighbouring markers, by the ruler", capsys.readouterr().out)
    assert printed is not None
    calibration = load_calibration(tmp_path / "fit.json")
    assert calibration.spacing_mm == pytest.approx(LOOK.grid.pitch, rel=2e-3)
    # The printed spacing serves as the pitch of a lab file.
    assert CameraMount(8, 6, float(printed[1]), calibration=calibration).unit == "mm"
    with pytest.raises(UsageError, match="correct the mount, or calibrate again"):
        CameraMount(8, 6, 1.002 * calibration.spacing_mm, calibration=calibration)
    assert main([*words[:2], "--out", str(tmp_path / "other.json")]) == 2
    assert "give --ruler" in capsys.readouterr().err
    assert main([*words[:2], "--spacing-mm", "2.2", "--out", str(tmp_path / "new.PNG")]) == 2
    assert "new.PNG: the picture beside the result gets this name" in capsys.readouterr().err
    assert not list(tmp_path.glob("new.*"))


def test_a_new_zero_from_the_page_is_the_new_state_of_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = FastGelRenderer(LOOK)
    for number in range(6):
        cv2.imwrite(str(tmp_path / f"{number}.png"), renderer.render(field(number)))
    asked = iter([False, False, True, False, False])
    monkeypatch.setattr(TrackingPage, "take_zero_request", lambda page: next(asked))
    table = tmp_path / "table.csv"
    words = ["track", str(tmp_path), "--rate", "200", "--pixels-per-mm", str(LOOK.pixels_per_mm)]
    assert main([*words, "--show", "--port", "0", "--out", str(table)]) == 0
    with table.open() as file:
        rows = list(csv.DictReader(file))
    moved = np.array([float(row["dy_mm"]) for row in rows]).reshape(6, 48).mean(1)
    np.testing.assert_allclose(moved, [0, 0.05, 0.1, 0, 0.05, 0.1], atol=5e-3)
