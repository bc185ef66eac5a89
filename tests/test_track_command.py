"""`gelflow track` on what it can not read: one line, exit status 2, no traceback."""

import subprocess
import sys
from pathlib import Path

import pytest

MAIN = "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"


def track(*arguments: str) -> tuple[int, str]:
    """Exit status and standard error of the command in a process of its own: video libraries write there too."""
    run = subprocess.run([sys.executable, "-c", MAIN, "track", *arguments], capture_output=True, text=True)
    return run.returncode, run.stderr


@pytest.mark.parametrize("source", ["broken.jpg", "missing.mp4", "empty", "notes.txt", "zeros.mp4"])
def test_a_source_that_is_no_image_is_told_in_one_line(source: str, tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_text("not an image\n" * 50)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("sechs Gramm, 5 µm\n" * 300)
    (tmp_path / "zeros.mp4").write_bytes(bytes(5000))
    status, error = track(str(tmp_path / source), "--out", str(tmp_path / "out"))
    assert status == 2
    assert error.startswith("gelflow track: ")
    assert error.count("\n") == 1


def test_a_stream_that_nobody_serves_is_told_in_one_line(tmp_path: Path) -> None:
    status, error = track("http://127.0.0.1:9/?action=stream", "--out", str(tmp_path / "out"))
    assert status == 2
    assert "Connection refused" in error
    assert error.count("\n") == 1
