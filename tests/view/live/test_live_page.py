"""The page of a run while it happens: it follows the recording, its button stops the mock arm, and it may be lost."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.real.runner.harness import FACTOR, BackgroundRun, OraclePolicy, free_port, moving, plan_for, wait_for
from tests.view.browser import browser, needs_browser
from tests.view.session.made_session import make_session

from gelflow.cli.main import main
from gelflow.errors import SafetyError, UsageError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.run_plan import run_insertions
from gelflow.view.live.live_view import LiveView


@pytest.fixture
def robot() -> Iterator[MockRobot]:
    config = MockRobotConfig(cell=SimulatedCellConfig(seed=2), egm_port=free_port(socket.SOCK_DGRAM))
    with MockRobot(FACTOR, config) as running:
        yield running


@needs_browser
def test_the_page_follows_the_run_and_its_button_stops_the_arm(robot: MockRobot, tmp_path: Path) -> None:
    lost: list[str] = []
    with browser() as window, LiveView(host="127.0.0.1", port=0, on_lost=lost.append) as view:
        window.driver.set_window_size(1300, 850)
        window.open(view.url)
        window.wait(lambda: "waiting for the recording" in window.text())

        def on_motion(motion: MotionExecutor) -> None:
            view.watch(motion.request_stop)

        plan = plan_for(robot, tmp_path, OraclePolicy(robot), on_motion=on_motion)
        view.show(plan.session)
        finish = BackgroundRun(lambda: run_insertions(plan))
        wait_for(lambda: moving(robot), during=finish)
        window.wait(lambda: "N, holding" in window.text() and "checks pass" in window.text())
        assert window.errors() == []
        window.press("STOP THE ARM")
        with pytest.raises(SafetyError, match="the stop button of the page was pressed"):
            finish()
        assert robot.cell.truth()["part"]["phase"] == "gripped"
        window.wait(lambda: "checks fail" in window.text())
        assert window.foreign_requests() == []
    assert lost == []


def test_a_stop_before_the_arm_is_known_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    reasons: list[str] = []
    with LiveView(host="127.0.0.1", port=0) as view:
        view._handle({"stop": "pressed"})
        view.watch(reasons.append)
        assert reasons == ["pressed"]
        view._handle({"stop": "pressed"})
        assert reasons == ["pressed", "pressed"]


def test_a_lost_page_is_reported_once_and_nothing_else_happens(tmp_path: Path) -> None:
    lost: list[str] = []
    reported = threading.Event()

    def on_lost(line: str) -> None:
        lost.append(line)
        reported.set()

    with LiveView(host="127.0.0.1", port=0, on_lost=on_lost) as view:
        os.kill(view._helper.pid, signal.SIGKILL)
        assert reported.wait(60)
        view.show(tmp_path / "session.mcap")
        view.watch(lambda reason: None)
    assert len(lost) == 1 and "the run goes on without it" in lost[0]


def test_an_address_in_use_is_refused_before_anything_starts() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(UsageError, match=f"^port {port} of 127.0.0.1 is in use"),
            LiveView(host="127.0.0.1", port=port),
        ):
            pass


def test_view_and_dry_run_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.toml").write_text("")
    assert main(["run", "insertion", "--lab", str(tmp_path / "none.toml"), "--dry-run", "--view"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@needs_browser
def test_a_recording_that_grows_is_followed_until_it_ends(tmp_path: Path) -> None:
    """The file grows in pieces that end anywhere, also inside of a record."""
    make_session(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    growing = tmp_path / "session.mcap"
    with browser() as window, LiveView(host="127.0.0.1", port=0) as view:
        window.open(view.url)
        view.show(growing)
        with growing.open("ab", buffering=0) as file:  # a recorder appends, and never cuts the file
            for begin in range(0, len(data), 300_001):
                file.write(data[begin : begin + 300_001])
                time.sleep(0.05)
        window.wait(lambda: "11.90 s of 11.9 s" in window.text())
        window.wait(lambda: "insertion 0, attempt 0" in window.text())
        assert window.errors() == []


def test_command_names_the_page_and_ends_it(tmp_path: Path) -> None:
    """Without a robot the run fails; the page has been served and is gone."""
    lab = Path("real/runner/lab_example.toml")
    command = [sys.executable, "-m", "gelflow.cli", "run", "insertion", "--lab", str(lab), "--view", "--port", "0"]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "out"), "--json"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2
    assert "open http://127.0.0.1:" in done.stderr and "red button" in done.stderr
    assert done.stdout == "" or json.loads(done.stdout)
