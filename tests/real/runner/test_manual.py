"""`gelflow robot` against the mock robot: the actions after a stop, and everything that is refused."""

import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.real.runner.harness import BackgroundRun, OraclePolicy, events, moving, plan_for, wait_for
from tests.real.wsg.harness import Relay, connected, eventually, unmodified

from gelflow.cli.main import main
from gelflow.errors import GelflowError, SafetyError
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.lab_file import save_lab
from gelflow.real.runner.manual import gripper_actions
from gelflow.real.runner.run_plan import run_insertions
from gelflow.real.wsg.codec import Decoder, Packet, plausible_request
from gelflow.real.wsg.constants import Command

MOTIONS = {Command.HOME, Command.PRE_POSITION, Command.GRASP, Command.RELEASE, Command.STOP, Command.FAST_STOP}


class Operator:
    """Runs `gelflow robot` with answers on standard input."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self.lab = folder / "lab.toml"
        self._folder, self._capsys, self._monkeypatch = folder, capsys, monkeypatch
        self._count = 0
        self.errors = ""

    def run(self, action: str, *options: str, answers: str | None = None) -> tuple[int, str]:
        """Exit code and standard output; without `answers`, standard input is closed."""
        self._count += 1
        readable, writable = os.pipe()
        os.write(writable, (answers or "").encode())
        os.close(writable)
        recording = [] if action == "status" else ["--out", str(self._folder / f"{self._count}")]
        with open(readable) as stdin:
            self._monkeypatch.setattr(sys, "stdin", stdin)
            code = main(["robot", action, "--lab", str(self.lab), *recording, *options])
        printed = self._capsys.readouterr()
        self.errors = printed.err
        return code, printed.out

    def json(self, action: str, *options: str) -> dict[str, Any]:
        code, printed = self.run(action, "--json", *options)
        assert code in (0, 1), self.errors
        values: dict[str, Any] = json.loads(printed)
        return values

    @property
    def session(self) -> Path:
        """The recording of the last action."""
        return self._folder / f"{self._count}" / "session.mcap"


@pytest.fixture
def operator(
    robot: MockRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Operator]:
    operator = Operator(tmp_path, capsys, monkeypatch)
    save_lab(lab_for(robot), operator.lab, title="test")
    yield operator


def height(robot: MockRobot) -> float:
    """Height of the tool [m]."""
    return float(robot.cell.arm_pose()[0][2])


def stopped_in_mid_descent(robot: MockRobot, folder: Path) -> str:
    """A run that motors off ended while a part was held; the motors are on again. Returns its error."""
    finish = BackgroundRun(lambda: run_insertions(plan_for(robot, folder, OraclePolicy(robot))))
    wait_for(lambda: moving(robot), during=finish)
    robot.arm.motors(False)
    with pytest.raises(GelflowError) as error:
        finish()
    robot.arm.motors(True)
    time.sleep(0.5)
    return str(error.value)


@pytest.mark.slow
def test_a_stopped_run_is_cleared_by_jog_open_and_home(robot: MockRobot, tmp_path: Path, operator: Operator) -> None:
    assert "motors" in stopped_in_mid_descent(robot, tmp_path)
    status = operator.json("status")
    assert status["gripper"]["grasp"] == "holding" and status["arm"]["motors_on"]

    # With a part in the grip nothing homes by itself, and a sideways motion raises it first.
    code, _ = operator.run("home", "--yes")
    assert code == 2 and "a part may be held" in operator.errors and "gelflow robot open --lab " in operator.errors
    down = 1e3 * (status["arm"]["height"] - 25.3e-3)  # 0.3 mm above the rim
    code, _ = operator.run("jog", "z", f"-{down:.2f}", "--yes")
    assert code == 0, operator.errors
    assert dict(events(operator.session))["move"]["speed"] > 0.3e-3  # the images show how often they come
    before = height(robot)
    code, printed = operator.run("jog", "x", "2", answers="n\n")
    assert code == 1 and "raise the gripper to the hand-over first: to x" in printed and "jog: not agreed" in printed
    assert f"height {1e3 * lab_for(robot).part.load_height:.1f} mm" in printed  # above the rim of any hole
    assert height(robot) == pytest.approx(before, abs=1e-5)

    code, printed = operator.run("jog", "z", "+3", answers="y\n")
    assert code == 0 and "jog z +3 mm: to x" in printed
    assert height(robot) == pytest.approx(before + 3e-3, abs=0.15e-3)
    assert robot.cell.truth()["part"]["phase"] == "gripped"
    recorded = events(operator.session)
    questions = [values for name, values in recorded if name == "operator"]
    assert len(questions) == 1 and questions[0]["yes"] and "jog z +3 mm" in questions[0]["question"]
    assert "move" in dict(recorded) and "arm stopped" in dict(recorded)

    result = operator.json("jog", "--to", "load", "--yes")
    assert result["done"] and result["to"]["height"] == pytest.approx(lab_for(robot).part.load_height, abs=0.2e-3)
    assert abs(result["to"]["x"]) < 0.2e-3 and abs(result["to"]["y"]) < 0.2e-3
    assert robot.cell.truth()["part"]["phase"] == "gripped"

    result = operator.json("open", "--yes")
    assert result["done"] and result["state"]["width"] == pytest.approx(0.06, abs=1e-3)
    wait_for(lambda: robot.cell.truth()["part"] is None or robot.cell.truth()["part"]["phase"] != "gripped")
    code, printed = operator.run("home", answers="y\n")
    assert code == 0 and "home: done" in printed
    assert not robot.gripper.fast_stopped


@pytest.mark.parametrize(("width", "opened"), [(0.040, 0.060), (0.070, 0.075), (0.108, 0.110)])
def test_a_held_part_that_is_wider_than_open_width_is_released(
    monkeypatch: pytest.MonkeyPatch, width: float, opened: float
) -> None:
    questions: list[str] = []

    def agreed(question: str, state: object) -> bool:
        questions.append(question)
        return True

    with connected() as (gripper, _, plant, record):
        monkeypatch.setattr(gripper_actions, "_gripper", lambda session: contextlib.nullcontext(gripper))
        session: Any = SimpleNamespace(
            attended=True,
            agreed=agreed,
            lab=SimpleNamespace(gripper=SimpleNamespace(open_width=0.06, speed=0.4)),
        )
        for action in (gripper_actions.open_fingers, gripper_actions.home):
            gripper.home(part_removed=True)
            plant.set_part(width)
            gripper.grasp(width=width, speed=0.4, force=20)
            assert action(session)["done"]
            released = next(values for name, values in reversed(record.commands) if name == "release")
            assert released["width"] == pytest.approx(opened, abs=1e-4)
    assert f"The fingers open from {1e3 * width:.1f} to {1e3 * opened:.1f} mm. Open?" in questions[0]


def test_home_releases_a_held_part_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The device accepts no other motion while it holds a part."""
    questions: list[str] = []

    def agreed(question: str, state: object) -> bool:
        questions.append(question)
        return True

    with connected() as (gripper, _, plant, record):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        monkeypatch.setattr(gripper_actions, "_gripper", lambda session: contextlib.nullcontext(gripper))
        session: Any = SimpleNamespace(
            attended=True,
            agreed=agreed,
            lab=SimpleNamespace(gripper=SimpleNamespace(open_width=0.06, speed=0.4)),
        )
        assert gripper_actions.home(session)["done"]
        assert record.names[-2:] == ["release", "home"] and plant.gripper_state()[0] == pytest.approx(0.110)
    assert "hold it, the fingers release it" in questions[0]


def test_fast_stop_is_acknowledged_by_an_operator_only(robot: MockRobot, operator: Operator) -> None:
    robot.gripper.raise_fast_stop()
    assert operator.json("status")["gripper"]["fault"] == "FAST_STOP"
    for action in (["home", "--yes"], ["open", "--yes"], ["jog", "z", "2", "--yes"]):
        code, _ = operator.run(*action)
        assert code == 2, action
        command = f"gelflow robot acknowledge --lab {operator.lab}"
        assert f"reports FAST_STOP; inspect it, then use: {command}" in operator.errors
    code, printed = operator.run("acknowledge", answers="n\n")
    assert code == 1 and "reports FAST_STOP" in printed
    code, _ = operator.run("acknowledge")
    assert code == 2 and "standard input is closed" in operator.errors and operator.errors.count("\n") == 1
    assert operator.json("acknowledge", "--dry-run")["done"] is False
    assert robot.gripper.fast_stopped
    code, printed = operator.run("acknowledge", answers="yes\n")
    assert code == 0 and not robot.gripper.fast_stopped
    code, printed = operator.run("acknowledge", "--yes")
    assert code == 0 and "reports no fault" in printed


def test_only_the_fault_that_the_operator_was_asked_about_is_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (gripper, server, _, record):
        server.raise_fast_stop()
        eventually(lambda: gripper.state().fault == "FAST_STOP", "FAST STOP did not appear in the state")
        state = gripper.state
        monkeypatch.setattr(gripper_actions, "_gripper", lambda session: contextlib.nullcontext(gripper))

        def agreed(question: str, check: object) -> bool:
            monkeypatch.setattr(gripper, "state", lambda: dataclasses.replace(state(), fault="FINGER_FAULT"))
            return True

        session: Any = SimpleNamespace(say=lambda text: None, agreed=agreed)
        with pytest.raises(SafetyError, match="reports FINGER_FAULT now, and FAST_STOP before the question"):
            gripper_actions.acknowledge(session)
        assert server.fast_stopped and "acknowledge fault" not in record.names


def test_gripper_that_is_not_homed_is_homed_outwards_after_the_question(robot: MockRobot, operator: Operator) -> None:
    width = robot.cell.gripper_state()[0]
    status = operator.json("status")
    assert status["gripper"]["referenced"] is False and status["ready"] is False
    code, _ = operator.run("open", "--yes")
    assert code == 2 and "not homed; use: gelflow robot home" in operator.errors
    code, printed = operator.run("home", answers="n\n")
    assert code == 1 and "home: not agreed" in printed
    code, printed = operator.run("home", "--dry-run")
    assert code == 0 and "nothing was sent" in printed
    assert robot.cell.gripper_state()[0] == pytest.approx(width, abs=1e-4)
    code, printed = operator.run("home", answers="y\n")
    assert code == 0 and robot.cell.gripper_state()[0] > 0.1
    assert operator.json("status")["gripper"]["referenced"] is True


def test_motors_off_and_bad_jogs_are_refused_without_motion(robot: MockRobot, operator: Operator) -> None:
    before = robot.cell.arm_pose()[0]
    for arguments, expected in (
        (["z", "21", "--yes"], "a jog in z must be within ±20 mm and not 0, got 21 mm"),
        (["z", "0", "--yes"], "not 0, got 0 mm"),
        (["z", "nan", "--yes"], "got nan mm"),
        (["yaw", "-11", "--yes"], "a jog in yaw must be within ±10° and not 0, got -11°"),
        (["z", "--yes"], "give an axis and an amount"),
        (["--yes"], "give an axis and an amount"),
        (["x", "1", "--to", "load"], "give an axis and an amount"),
        (["x", "17", "--yes"], "target refused: x 17 mm is outside -16 to 16 mm"),
    ):
        code, _ = operator.run("jog", *arguments)
        assert code == 2 and expected in operator.errors and operator.errors.count("\n") == 1, arguments
    code, _ = operator.run("jog", "z", "2")
    assert code == 2 and "standard input is closed" in operator.errors
    robot.arm.motors(False)
    assert operator.json("status")["arm"]["ready"] is False
    code, _ = operator.run("jog", "z", "2", "--yes")
    assert code == 2 and "motors off" in operator.errors
    assert robot.cell.arm_pose()[0] == pytest.approx(before, abs=1e-6)


def test_status_and_dry_run_send_no_motion_byte(robot: MockRobot, operator: Operator) -> None:
    relay = Relay(robot.gripper.tcp_address, unmodified)
    lab = lab_for(robot)
    save_lab(
        dataclasses.replace(lab, gripper=dataclasses.replace(lab.gripper, address=relay.address)),
        operator.lab,
        title="test",
    )
    try:
        status = operator.json("status")
    finally:
        relay.close()
    packets = Decoder(plausible=plausible_request).feed(relay.sent)
    asked = {packet.id for packet in packets if isinstance(packet, Packet)}
    assert Command.DISCONNECT in asked and not MOTIONS & asked
    assert robot.arm.report.answers == 0 and not robot.gripper.fast_stopped
    rate = robot.config.cell.world.cameras[0].rate
    for side in ("left camera", "right camera"):
        assert status[side]["ready"] and status[side]["rate"] == pytest.approx(rate, rel=0.3)
    assert status["arm"]["height"] == pytest.approx(0.040, abs=0.03)
    save_lab(lab, operator.lab, title="test")
    code, printed = operator.run("jog", "z", "2", "--dry-run")
    assert code == 0 and "would ask: jog z +2 mm" in printed
    assert robot.arm.report.answers == 0


@pytest.mark.slow
def test_held_part_is_only_raised_while_a_camera_fails(robot: MockRobot, tmp_path: Path, operator: Operator) -> None:
    stopped_in_mid_descent(robot, tmp_path)
    robot.cameras[0].stall()
    status = operator.json("status")
    assert status["left camera"]["ready"] is False and "error" in status["left camera"]
    before = height(robot)
    code, _ = operator.run("jog", "z", "-1", "--yes")
    assert code == 2 and "a held part is only raised while a pad is not observed" in operator.errors
    code, _ = operator.run("jog", "z", "+5", "--yes")
    assert code == 0, operator.errors
    assert height(robot) == pytest.approx(before + 5e-3, abs=0.15e-3)
    assert robot.cell.truth()["part"]["phase"] == "gripped"
