"""Files of an earlier `gelflow demo`: which are replaced, and when."""

from pathlib import Path

import pytest

from gelflow.cli.commands.demo import _clear
from gelflow.cli.main import main
from gelflow.clock import ScaledClock
from gelflow.session import SessionRecorder

MARKER = ".gelflow-demo"
WRITTEN = ("session.mcap", "session-real-time.mcap", "insertion-1.png", "insertion-12.png", "insertion-real-time-1.png")


def make(folder: Path, *names: str) -> Path:
    """The folder with files of these names."""
    folder.mkdir()
    for name in names:
        (folder / name).write_text(name)
    return folder


def test_only_files_that_a_demo_writes_are_deleted(tmp_path: Path) -> None:
    kept = {MARKER, "session.recovered.mcap", "session2.mcap", "insertion-notes.png", "insertion-1-left.png"}
    folder = make(tmp_path / "demo", *WRITTEN, *kept)
    _clear(folder)
    assert {path.name for path in folder.iterdir()} == kept


@pytest.mark.parametrize("options", [["--factor", "0.5"], ["--preset", "typo"]])
def test_wrong_options_delete_nothing(tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    folder = make(tmp_path / "demo", MARKER, *WRITTEN)
    assert main(["demo", "--quick", "--out", str(folder), *options]) == 2
    assert "did not start" in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == {MARKER, *WRITTEN}


def test_a_session_that_another_demo_records_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make(tmp_path / "demo", MARKER)
    with SessionRecorder(folder / "session.mcap", ScaledClock()):
        assert main(["demo", "--quick", "--out", str(folder)]) == 2
        error = capsys.readouterr().err
        assert "another demo records" in error and error.count("\n") == 1
        assert (folder / "session.mcap").exists()
