"""The controller's mode over Robot Web Services: shown and checked by preflight, and a change of it ends the run."""

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tests.real.runner.harness import BackgroundRun, OraclePolicy, events, moving, plan_for, wait_for

from gelflow.cli.main import main
from gelflow.errors import PeerError, SafetyError
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.hardware_mocks.web_services.device import MockWebServices
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import save_lab
from gelflow.real.runner.run_plan import dry_run, run_insertions
from gelflow.session.reader import SessionReader


def lab_with(robot: MockRobot, address: str) -> Lab:
    lab = lab_for(robot)
    return replace(lab, arm=replace(lab.arm, web_services=address))


def arm_text(robot: MockRobot, folder: Path, lab: Lab) -> str:
    result = dry_run(plan_for(robot, folder, OraclePolicy(robot), lab=lab))
    return next(item.text for item in result.items if item.name == "arm")


def test_preflight_shows_the_mode(robot: MockRobot, tmp_path: Path) -> None:
    text = arm_text(robot, tmp_path / "without", lab_for(robot))
    assert "mode unknown (no web_services in the lab file)" in text
    with MockWebServices() as server:
        server.opmode = "MANR"
        text = arm_text(robot, tmp_path / "with", lab_with(robot, server.url))
    assert "mode manual reduced, motors on, program running" in text


def test_status_shows_the_controller(robot: MockRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lab.toml"
    with MockWebServices() as server:
        save_lab(lab_with(robot, server.url), path, title="test")
        assert main(["robot", "status", "--lab", str(path), "--json"]) == 1  # the gripper is not homed
        status = json.loads(capsys.readouterr().out)
        assert main(["robot", "status", "--lab", str(path)]) == 1
    text = "mode auto, motors on, program running"
    assert status["controller"] == {"ready": True, "text": text, "operating_mode": "auto"}
    assert text in capsys.readouterr().out


def test_preflight_refuses_manual_full_speed(robot: MockRobot, tmp_path: Path) -> None:
    with MockWebServices() as server:
        server.opmode = "MANF"
        with pytest.raises(SafetyError, match="arm: operating mode is manual full; it must be auto or manual reduced"):
            run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab_with(robot, server.url)))
    assert robot.arm.report.largest_step < 1e-9


def test_controller_without_an_answer_ends_the_run_before_it_begins(robot: MockRobot, tmp_path: Path) -> None:
    with MockWebServices(password="changed") as server, pytest.raises(PeerError, match="refuses the user"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab_with(robot, server.url)))
    assert robot.arm.report.answers == 0


def test_change_during_a_run_latches(robot: MockRobot, tmp_path: Path) -> None:
    with MockWebServices() as server:
        plan = plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab_with(robot, server.url))
        finish = BackgroundRun(lambda: run_insertions(plan))
        wait_for(lambda: moving(robot), during=finish)
        server.opmode, message = "MANF", "the operating mode changed from auto to manual full"
        with pytest.raises(SafetyError, match=message):
            finish()
    answers = robot.arm.report.answers
    time.sleep(0.2)
    assert robot.arm.report.answers == answers  # no reference after the stop
    assert robot.cell.truth()["part"]["phase"] == "gripped"
    recorded = events(plan.session)
    assert message in dict(recorded)["stopped"]["reason"]
    assert [values["state"] for kind, values in recorded if kind == "state"][-1] == "latched"
    with SessionReader(plan.session) as session:
        modes = [record.value["operating_mode"] for record in session.records(["/arm/status"])]
    assert modes[0] == "auto" and "unknown" not in modes
