"""The `gelflow` command as a whole: help, common options, JSON output, closed pipes."""

import errno
import json
import os
import re
import socket
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from gelflow.cli.main import COMMANDS, main
from gelflow.clock import ScaledClock
from gelflow.protocols import CameraImage
from gelflow.session import SessionRecorder

MAIN = [sys.executable, "-m", "gelflow.cli"]
COMMON_OPTIONS = {
    "train": {"--json", "--out", "--seed", "--preset"},
    "sweep": {"--json", "--out"},
    "eval": {"--json", "--seed", "--preset", "--checkpoint", "--out"},
    "reproduce": {"--json", "--out", "--seed", "--quick"},
    "export": {"--json", "--out"},
    "track": {"--json", "--out"},
    "calibrate-camera": {"--json", "--out"},
    "calibrate-gel": {"--json", "--out"},
    "run": {"--json", "--out", "--checkpoint"},
    "robot": set(),  # its actions have options of their own
    "calibrate": {"--json", "--out", "--seed", "--quick"},
    "replay": {"--json", "--out", "--checkpoint"},
    "recover": {"--json", "--out"},
    "mock": {"--json", "--out", "--seed", "--preset"},
    "render": {"--json", "--out", "--seed"},
    "render-scene": {"--json", "--out", "--preset"},
    "view": {"--checkpoint", "--json", "--preset"},
    "bench": {"--json", "--out", "--quick", "--repeats"},
    "tradeoff": {"--json", "--out", "--quick", "--repeats"},
    "describe": {"--json", "--preset", "--repeats"},
    "soak": {"--json", "--out", "--seed", "--preset"},
    "demo": {"--json", "--out", "--seed", "--preset", "--quick", "--checkpoint"},
}


def test_a_warning_is_printed_once(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    assert main(["describe", "rolling", "--json", "--repeats", "1"]) == 0
    shown = [warnings.formatwarning(UserWarning(text), UserWarning, "a.py", line) for line, text in enumerate("aab")]
    assert shown == ["gelflow: a\n", "", "gelflow: b\n"]


def help_text(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_80_columns(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, help_text(command, capsys).splitlines())) <= 80


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_accept_the_common_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    options = set(re.findall(r"^  (--[a-z-]+)", help_text(command, capsys), re.MULTILINE))
    common = set().union(*COMMON_OPTIONS.values())
    assert options & common == COMMON_OPTIONS[command]


@pytest.mark.parametrize("action", ["status", "home", "open", "acknowledge", "jog"])
def test_actions_of_robot_have_their_own_help(
    action: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["robot", action, "--help"])
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert {"--lab", "--json"} <= set(re.findall(r"^  (--[a-z-]+)", text, re.MULTILINE))


def test_common_options_have_the_same_help_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    texts: dict[str, set[str]] = {}
    for command in COMMANDS:
        words = " ".join(help_text(command, capsys).split())
        for option in ("--json", "--preset", "--quick"):
            end = r"(?= --| \w+ only:|$)"  # the next option, the next group of options
            if found := re.search(rf" {option}(?: NAME)? ([^-\]\[|]+?){end}", words.split("options:")[1]):
                texts.setdefault(option, set()).add(found[1])
    assert {option: len(found) for option, found in texts.items()} == {"--json": 1, "--preset": 1, "--quick": 1}


def printed_json(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict[str, Any]:
    """The result of a command with `--json`: one object, and nothing else on standard output."""
    capsys.readouterr()
    assert main([*arguments, "--json"]) == status
    printed = json.loads(capsys.readouterr().out)
    assert isinstance(printed, dict)
    return printed


def test_json_of_the_perception_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images, table, fit = tmp_path / "images", tmp_path / "table.csv", tmp_path / "gel.json"
    regular = ("--markers", "63", "--set", "print_offset=0")
    rendered = printed_json(capsys, "render", "--out", str(images), "--frames", "3", *regular, "--motion", "rest")
    assert rendered == {"images": 3, "out": str(images), "truth": str(images / "truth.npz")}
    tracked = printed_json(capsys, "track", str(images), "--out", str(table))
    assert tracked["images"] == 3 and tracked["rows"] * tracked["cols"] == 63 and tracked["files"] == [str(table)]
    assert tracked["tracked_share"] > 0.9 and tracked["jitter_px"] is None
    calibrated = printed_json(capsys, "calibrate-camera", str(images), "--spacing-mm", "2", "--out", str(fit))
    assert calibrated["calibration"] == str(fit) and calibrated["residual_px"] < 0.2


def test_json_of_describe_and_bench(capsys: pytest.CaptureFixture[str]) -> None:
    assert printed_json(capsys, "describe", "pushing", "--no-timing")["times"] is None
    record = printed_json(capsys, "bench", "scenes", "--quick", "--repeats", "1")
    assert record["format"] == 1 and record["scenes"]["outside"] == []


def test_json_of_recover(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, target = tmp_path / "session.mcap", tmp_path / "recovered.mcap"
    with SessionRecorder(path, ScaledClock()) as recorder:
        recorder.metadata({"who": "test"})
        recorder.image(0, CameraImage(bytes(100), 0.0, 1))
    path.write_bytes(path.read_bytes()[:-10])
    report = printed_json(capsys, "recover", str(path), "--out", str(target))
    assert report["path"] == str(target) and report["messages"] == 2


def test_json_of_mock(tmp_path: Path) -> None:
    """With --attached and a closed standard input the mock robot starts, prints its addresses and ends."""
    lab = tmp_path / "lab.toml"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    arguments = ["mock", "--attached", "--json", "--egm-port", port, "--out", str(lab)]
    done = subprocess.run([*MAIN, *arguments], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["arm"] == f"127.0.0.1:{port}" and len(printed["cameras"]) == 2
    assert printed["lab_file"] == str(lab) and lab.exists()


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_closed_pipe_ends_the_command_silently(form: list[str]) -> None:
    arguments = ["describe", "insertion", "--no-timing", *form]
    command = subprocess.Popen([*MAIN, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert command.stdout is not None and command.stderr is not None
    command.stdout.close()
    assert command.stderr.read() == b""
    assert command.wait() == 1


@pytest.mark.parametrize(
    "environment",
    [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}],
)
def test_a_character_that_the_terminal_lacks_is_replaced(environment: dict[str, str]) -> None:
    command = [*MAIN, "describe", "insertion", "--no-timing"]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    assert "m/s?" in done.stdout


def test_a_closed_standard_output_is_no_traceback() -> None:
    command = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *MAIN, "describe", "insertion", "--no-timing"], stderr=subprocess.PIPE
    )
    assert command.returncode == 0 and command.stderr == b""


def test_an_interrupt_during_the_imports_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(name: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gelflow.cli.main.command_module", interrupted)
    assert main(["train", "grasp"]) == 130
    assert capsys.readouterr().err == "gelflow train: interrupted\n"


def test_a_full_disk_is_an_error_of_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(args: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", "runs/x")

    monkeypatch.setattr("gelflow.cli.commands.recover.run", full)
    assert main(["recover", "session.mcap"]) == 2
    assert capsys.readouterr().err == "gelflow recover: cannot write runs/x: No space left on device\n"


LONG = 300 * "a"


@pytest.mark.parametrize(
    "arguments",
    [
        ["track", LONG],
        ["calibrate-camera", LONG, "--spacing-mm", "1.4"],
        ["recover", f"{LONG}.mcap"],
        ["describe", LONG],
        ["export", LONG],
        ["render", "--frames", "2", "--out", LONG],
        ["eval", "insertion", "--part", LONG],
        ["calibrate", "--plan", LONG],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_name_that_is_too_long_is_an_error_of_one_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gelflow {arguments[0]}: ") and "File name too long" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["eval", "insertion", "--episodes", "0"], "--episodes must be at least 1, got 0"),
        (["mock", "--seed", "-1"], "--seed must be at least 0, got -1"),
        (["describe", "insertion", "--repeats", "0"], "--repeats must be at least 1, got 0"),
        (["track", "none", "--out", "film.gif"], "--out film.gif: the suffix must be one of .csv, .mcap, .mp4"),
        (["track", "none", "--port", "0"], "--port is for the page of --show; add --show"),
        (["run", "insertion", "--lab", "none", "--host", "0.0.0.0"], "--host is for the page of --view; add --view"),
        (["demo", "--port", "0"], "--port is for the page of --view; add --view"),
        (["recover", ""], "cannot open .: Is a directory"),
        (["recover", "."], "cannot open .: Is a directory"),
        (["recover", "/"], "cannot open /: Is a directory"),
        (["export", ""], ". is no checkpoint"),
        (["export", "."], ". is no checkpoint"),
        (["mock", "--truth-port", "70000"], "truth port must be within 0 to 65535, got 70000"),
        (["mock", "--truth-port", "-1"], "truth port must be within 0 to 65535, got -1"),
        (["mock", "--tcp-port", "70000"], "tcp port must be within 0 to 65535, got 70000"),
        (["tradeoff", "pushing", "--out", "a.foo"], "--out a.foo: the suffix must be one of .png, .jpg"),
    ],
)
def test_wrong_options_exit_with_2_and_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gelflow {arguments[0]}: ") and message in error and error.count("\n") == 1


@pytest.mark.parametrize("code", ["import gelflow", "from gelflow.cli.main import main; main(['--version'])"])
def test_import_and_version_load_no_third_party_package(code: str) -> None:
    """Both are fast because they load the standard library only."""
    heavy = {"numpy", "scipy", "torch", "cv2", "mujoco", "matplotlib", "rich", "gymnasium"}
    program = f"import sys\ntry: exec({code!r})\nexcept SystemExit: pass\nprint(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_numbers_that_are_too_large_are_errors_of_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["describe", "pushing", "--repeats", str(10**11)]) == 2
    assert "--repeats must be at most 2147483647, got 100000000000" in capsys.readouterr().err

    def exhausted(args: object) -> int:
        raise MemoryError

    monkeypatch.setattr("gelflow.cli.commands.describe.run", exhausted)
    assert main(["describe", "pushing"]) == 2
    assert capsys.readouterr().err == "gelflow describe: not enough memory; give smaller numbers\n"
