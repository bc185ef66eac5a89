"""`gelflow track` on what it can not read: one line, exit status 2, no traceback."""

from pathlib import Path

import pytest

from gelflow.cli.main import main


@pytest.mark.parametrize("source", ["broken.jpg", "missing.mp4", "empty", "notes.txt", "zeros.mp4"])
def test_a_source_that_is_no_image_is_told_in_one_line(
    source: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.jpg").write_text("not an image\n" * 50)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("sechs Gramm, 5 µm\n" * 300)
    (tmp_path / "zeros.mp4").write_bytes(bytes(5000))
    assert main(["track", str(tmp_path / source), "--out", str(tmp_path / "out")]) == 2
    error = capfd.readouterr().err
    assert error.startswith("gelflow track: ")
    assert error.count("\n") == 1


def test_a_stream_that_nobody_serves_is_told_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["track", "http://127.0.0.1:9/?action=stream", "--out", str(tmp_path / "out")]) == 2
    error = capfd.readouterr().err
    assert "Connection refused" in error
    assert error.count("\n") == 1
