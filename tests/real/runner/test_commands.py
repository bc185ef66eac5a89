"""`gelflow mock`, `run`, `demo` and `replay` as command lines, with the mock robot in a separate process."""

import json
import os
import signal
import socket
import urllib.request
from pathlib import Path

import pytest
from tests.real.runner.harness import free_port, untrained_checkpoint

import gelflow.real
from gelflow.cli.commands import demo
from gelflow.cli.main import main
from gelflow.errors import PeerError, PeerTimeout, UsageError
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.robot_process import mock_robot, true_state
from gelflow.real.runner import run_plan
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import RunPlan

FACTOR = 4.0


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return untrained_checkpoint(tmp_path)


def test_dry_run_with_the_mock_robot(tmp_path: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with mock_robot(factor=FACTOR, seed=9) as (lab_path, truth):
        lab = load_lab(lab_path)
        assert lab.clock_factor == FACTOR and lab.gripper.address.startswith("serial:")
        arguments = ["--lab", str(lab_path), "--checkpoint", str(checkpoint), "--out", str(tmp_path / "out")]
        assert main(["run", "insertion", *arguments, "--dry-run"]) == 0
        output = capsys.readouterr().out
        assert "nothing was moved" in output and "252 of 252 markers" in output
        # The session is never overwritten.
        assert main(["run", "insertion", *arguments, "--dry-run"]) == 2
        assert "a recording never overwrites" in capsys.readouterr().err
        request = urllib.request.Request(f"{truth}?seed=17", method="POST")
        with urllib.request.urlopen(request, timeout=10) as answer:
            assert json.load(answer) == {"next_seed": 17}
        assert true_state(truth)["waited"] >= 0
    with pytest.raises(PeerError, match="does not answer"):
        true_state(truth)  # the mock robot has ended


def test_a_timeout_of_a_demo_that_is_faster_than_real_time_names_a_remedy(
    tmp_path: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stall(plan: RunPlan) -> None:
        raise PeerTimeout("the arm's pose is 1202 ms old, at most 1200 ms is allowed")

    monkeypatch.setattr(run_plan, "run_insertions", stall)
    options = ["--quick", "--checkpoint", str(checkpoint), "--factor", "4"]
    assert main(["demo", "--out", str(tmp_path / "fast"), *options]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert "is allowed; delays of this computer are 4 times as long in robot time: close programs" in printed
    late = PeerTimeout("the arm's pose is 1202 ms old")
    assert demo._explained(late, 1.0) is late


def test_a_run_whose_output_is_closed_says_so(
    tmp_path: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(plan: RunPlan) -> None:
        if plan.on_preflight is not None:
            plan.on_preflight([])
        raise BrokenPipeError

    monkeypatch.setattr(run_plan, "run_insertions", closed)
    arguments = [
        "--lab",
        str(Path(gelflow.real.__path__[0]) / "runner" / "lab_example.toml"),
        "--checkpoint",
        str(checkpoint),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["run", "insertion", *arguments]) == 2
    error = capsys.readouterr().err
    assert "standard output was closed, which stopped the run; raise the gripper with: gelflow robot jog" in error


@pytest.mark.slow
def test_demo_inserts_a_part_and_its_session_replays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setattr(demo, "_EPISODES", 8)
    out = tmp_path / "demo"
    options = ["--insertions", "1", "--factor", str(FACTOR), "--no-real-time"]
    assert main(["demo", "--out", str(out), "--preset", "fast", *options]) == 0
    output = capsys.readouterr().out
    assert "misalignment" in output and f"gelflow replay {out / 'session.mcap'}" in output.replace("\n", "")
    assert "in truth" in output
    picture = out / "insertion-1.png"
    assert picture.read_bytes()[:4] == b"\x89PNG" and picture.stat().st_size > 50_000
    assert main(["replay", str(out / "session.mcap")]) == 0
    assert "decisions identical; largest difference: action 0" in " ".join(capsys.readouterr().out.split())


def test_a_mock_robot_ends_with_one_of_its_processes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started = MockRobot.start

    def start(robot: MockRobot) -> MockRobot:
        started(robot)
        assert robot.running and robot.arm.pid is not None
        with pytest.raises(UsageError, match="another mock robot sends to the UDP port"):
            started(MockRobot(1.0, robot.config))
        os.kill(robot.arm.pid, signal.SIGKILL)
        return robot

    monkeypatch.setattr(MockRobot, "start", start)
    assert main(["mock", "--egm-port", str(free_port(socket.SOCK_DGRAM))]) == 2
    error = capsys.readouterr().err
    assert "the mock controller's process has ended" in error and error.count("\n") == 1


def test_mock_reports_why_it_cannot_start(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["mock", "--tcp-port", port]) == 2
    output = capsys.readouterr().err
    assert port in output and output.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "name", "message"),
    [
        ("mock", "lab.toml", "lab.toml exists, and gelflow mock did not write it; name another file with --out"),
        ("demo", "out/session.mcap", "session.mcap is not the file of a demo; name another folder with --out"),
    ],
)
def test_files_of_others_are_not_replaced(
    command: str, name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("# lab 3\n", encoding="utf-8")
    assert main([command, "--out", str(path if command == "mock" else path.parent)]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert path.read_text(encoding="utf-8") == "# lab 3\n"


def test_demo_reports_a_mock_that_does_not_start() -> None:
    with pytest.raises(PeerError, match="did not start"), mock_robot(factor=-3.0, seed=0):
        pass


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["demo", "--insertions", "0"], "--insertions must be at least 1"),
        (["demo", "--checkpoint", "/nowhere/policy.safetensors"], "no checkpoint at /nowhere/policy.safetensors"),
        (["mock", "--factor", "0.5"], "clock factor 0.5 is outside 1 to 1000"),
    ],
)
def test_invalid_options_give_a_one_line_error(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    output = capsys.readouterr().err
    assert named in output and output.count("\n") == 1
