"""`gelflow run` as a process: signals, and prompts at a terminal, against the mock robot over TCP, UDP and HTTP."""

import contextlib
import dataclasses
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.real.runner.harness import events, moving, untrained_checkpoint, wait_for

from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.lab_file import save_lab

SOURCE = str(Path(__file__).resolve().parents[3] / "src")
MAIN = "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"


def command(robot: MockRobot, folder: Path, **part: Any) -> list[str]:
    """`gelflow run` with an untrained policy; over TCP the gripper notices a disconnect that was not announced."""
    checkpoint = untrained_checkpoint(folder)
    lab = lab_for(robot)
    gripper = dataclasses.replace(lab.gripper, address=robot.gripper.addresses[1])
    lab = dataclasses.replace(lab, gripper=gripper, part=dataclasses.replace(lab.part, **part))
    save_lab(lab, folder / "lab.toml", title="test")
    options = ["--lab", str(folder / "lab.toml"), "--out", str(folder / "out"), "--checkpoint", str(checkpoint)]
    return [sys.executable, "-c", MAIN, "run", "insertion", *options]


@contextlib.contextmanager
def running(arguments: list[str], **streams: Any) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": SOURCE}, **streams)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


class Terminal:
    """A real pty with what the program wrote to it."""

    def __init__(self) -> None:
        self.ours, self.theirs = pty.openpty()
        os.set_blocking(self.ours, False)
        self.text = ""

    def shows(self, text: str) -> bool:
        with contextlib.suppress(BlockingIOError, OSError):
            self.text += os.read(self.ours, 65536).decode(errors="replace")
        return text in self.text.replace("\r\n", " ")

    def type(self, text: str) -> None:
        os.write(self.ours, text.encode())


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    os.close(terminal.ours)
    os.close(terminal.theirs)


def run_until_a_signal(
    robot: MockRobot, tmp_path: Path, number: signal.Signals, terminal: Terminal | None = None
) -> None:
    """Send `number` to a run that moves a part; with a terminal, Enter continues it before."""
    presentation = {} if terminal is None else {"presentation": "prompt"}
    stream = subprocess.DEVNULL if terminal is None else terminal.theirs
    with running(command(robot, tmp_path, **presentation), stdin=stream, stdout=stream) as process:
        if terminal is not None:
            wait_for(lambda: terminal.shows("press Enter.") or process.poll() is not None)
            terminal.type("\n")
        wait_for(lambda: moving(robot) or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1].decode()
        sent = robot.clock.now()
        process.send_signal(number)
        time.sleep(0.02)
        process.send_signal(number)  # a second signal does not break the shutdown
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number, errors.decode()
    assert errors.decode() == f"gelflow run: ended by {number.name}\n"
    recorded = events(tmp_path / "out" / "session.mcap")  # an unfinished file is refused
    holds = [values["at"] for name, values in recorded if name == "arm hold" and values["at"] >= sent]
    assert holds and number.name in dict(recorded)["arm stopped"]["reason"]
    assert holds[0] - sent < 1.0, "robot time; 20 ms of wall time on a quiet computer"
    assert not robot.gripper.fast_stopped
    answers = robot.arm.report.answers
    time.sleep(0.2)
    assert robot.arm.report.answers == answers
    assert robot.cell.truth()["part"]["phase"] == "gripped"


def test_signal_stops_the_arm_and_closes_everything(robot: MockRobot, tmp_path: Path) -> None:
    run_until_a_signal(robot, tmp_path, signal.SIGHUP)


def test_a_signal_after_enter_stops_the_arm_and_closes_everything(
    robot: MockRobot, tmp_path: Path, terminal: Terminal
) -> None:
    run_until_a_signal(robot, tmp_path, signal.SIGTERM, terminal)


def test_fault_while_the_operator_is_asked_ends_the_run_at_once(
    robot: MockRobot, tmp_path: Path, terminal: Terminal
) -> None:
    arguments = command(robot, tmp_path, presentation="prompt")
    with running(arguments, stdin=terminal.theirs, stdout=terminal.theirs) as process:
        wait_for(
            lambda: terminal.shows("Hold part 1 between the fingers, then press Enter.") or process.poll() is not None
        )
        assert process.poll() is None, process.communicate()[1].decode()
        robot.arm.motors(False)
        _, errors = process.communicate(timeout=60)  # Enter is never pressed
    assert process.returncode == 2
    assert "motors off" in errors.decode() and errors.decode().count("\n") == 1
    assert f"gelflow robot jog z +10 --lab {tmp_path / 'lab.toml'}" in errors.decode()
    assert "motors off" in dict(events(tmp_path / "out" / "session.mcap"))["stopped"]["reason"]


def test_prompt_with_closed_standard_input_ends_the_run(robot: MockRobot, tmp_path: Path) -> None:
    arguments = command(robot, tmp_path, presentation="prompt")
    with running(arguments, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 2 and "standard input is closed" in errors.decode()
    assert not robot.gripper.fast_stopped
    assert "arm stopped" in dict(events(tmp_path / "out" / "session.mcap"))
