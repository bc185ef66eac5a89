"""The `gelflow` command as a whole: help for everything, and readers that stop reading."""

import subprocess
import sys

import pytest

from gelflow.cli.main import COMMANDS, main

MAIN = [sys.executable, "-c", "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_in_80_columns(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_reader_that_stops_ends_the_command_without_a_word(form: list[str]) -> None:
    arguments = ["describe", "insertion", "--no-timing", *form]
    command = subprocess.Popen([*MAIN, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert command.stdout is not None and command.stderr is not None
    command.stdout.close()
    assert command.stderr.read() == b""
    assert command.wait() == 1
