"""Dry runs, preflight checks and unreachable devices, with the mock robot on the wire."""

import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.real.runner.harness import OraclePolicy, free_port, plan_for
from tests.real.wsg.harness import Relay, unmodified

from gelflow.cli.main import main
from gelflow.errors import GelflowError, PeerTimeout, SafetyError, UsageError
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab, save_lab
from gelflow.real.runner.run_plan import RunPlan, dry_run, run_insertions
from gelflow.real.wsg.codec import Decoder, Packet, plausible_request
from gelflow.real.wsg.constants import Command
from gelflow.task import INSERTION

MOTIONS = {Command.HOME, Command.PRE_POSITION, Command.GRASP, Command.RELEASE, Command.STOP, Command.FAST_STOP}


def test_dry_run_sends_no_motion(robot: MockRobot, tmp_path: Path) -> None:
    relay = Relay(robot.gripper.tcp_address, unmodified)
    try:
        lab = lab_for(robot)
        lab = replace(lab, gripper=replace(lab.gripper, address=relay.address))
        result = dry_run(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
    finally:
        relay.close()
    assert [item.good for item in result.items] == [True] * 5 and len(result.targets) == 5
    assert np.isfinite(result.correction).all()
    packets = Decoder(plausible=plausible_request).feed(relay.sent)
    assert packets and all(isinstance(packet, Packet) for packet in packets)
    asked = [packet.id for packet in packets]
    assert Command.DISCONNECT in asked and Command.DEVICE_INFO in asked
    assert not MOTIONS & set(asked)
    assert robot.arm.report.answers == 0  # no EGM message was sent
    assert robot.gripper.fast_stopped is False


def test_preflight_reports_all_failed_checks_without_motion(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    lab = replace(
        lab,
        gripper=replace(lab.gripper, home_at_start=False),
        hole=replace(lab.hole, position=(0.374, 0.10, 0.05)),
    )
    with pytest.raises(SafetyError) as error:
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
    message = str(error.value)
    assert "gripper: it is not homed" in message and "pose: target refused: y -50 mm" in message
    assert robot.arm.report.largest_step < 1e-9
    assert robot.cell.gripper_state()[0] == pytest.approx(0.06, abs=1e-4)


def test_the_fingers_move_only_after_all_checks(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    lab = replace(lab, hole=replace(lab.hole, position=(0.374, 0.10, 0.05)))  # the gripper is outside its workspace
    assert lab.gripper.home_at_start
    with pytest.raises(SafetyError, match="preflight failed: pose: target refused"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
    assert robot.cell.gripper_state()[0] == pytest.approx(0.06, abs=1e-4)


def test_a_clamped_part_is_refused_in_every_state_of_the_gripper(
    robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After an acknowledged FAST STOP the device is idle, and the fingers still press on the part."""
    measured = robot.cell.gripper_state
    monkeypatch.setattr(robot.cell, "gripper_state", lambda: (*measured()[:2], 8.0))
    with pytest.raises(SafetyError, match=r"a part may be held \(idle, 8\.0 N\); hold it and release it with"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot)))
    assert robot.arm.report.largest_step < 1e-9
    assert robot.cell.gripper_state()[0] == pytest.approx(0.06, abs=1e-4)


def lab_with_address(robot_lab: Lab, **changes: str) -> Lab:
    lab = robot_lab
    if "gripper" in changes:
        lab = replace(lab, gripper=replace(lab.gripper, address=changes["gripper"]))
    if "camera" in changes:
        cameras = replace(lab.cameras, left=replace(lab.cameras.left, source=changes["camera"]))
        lab = replace(lab, cameras=cameras)
    return lab


@pytest.mark.parametrize("what", ["gripper", "serial", "camera", "arm"])
def test_device_that_does_not_answer_gives_a_one_line_error(
    robot: MockRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    dead = free_port(socket.SOCK_STREAM)
    lab = lab_for(robot)
    expected = str(dead)
    if what == "gripper":
        lab = lab_with_address(lab, gripper=f"tcp:127.0.0.1:{dead}")
    elif what == "serial":
        lab, expected = lab_with_address(lab, gripper="serial:/dev/no-such-gripper"), "/dev/no-such-gripper"
    elif what == "camera":
        lab = lab_with_address(lab, camera=f"http://127.0.0.1:{dead}/?action=stream")
    else:
        silent = free_port(socket.SOCK_DGRAM)
        lab, expected = replace(lab, arm=replace(lab.arm, egm_port=silent, connect_timeout=0.4)), str(silent)
    path = tmp_path / "lab.toml"
    save_lab(lab, path, title="test")
    with pytest.raises((GelflowError, PeerTimeout)) as error:
        run_insertions(RunPlan(load_lab(path), OraclePolicy(robot), INSERTION, tmp_path / "session.mcap"))
    assert expected in str(error.value) and "\n" not in str(error.value)
    assert not robot.gripper.fast_stopped


def test_a_run_without_an_operator_is_refused_where_a_person_presents_the_parts(
    robot: MockRobot, tmp_path: Path
) -> None:
    lab = lab_for(robot)
    lab = replace(lab, part=replace(lab.part, presentation="prompt"))
    with pytest.raises(UsageError, match="has no operator to ask"):
        run_insertions(RunPlan(lab, OraclePolicy(robot), INSERTION, tmp_path / "session.mcap"))
    assert not (tmp_path / "session.mcap").exists()


def test_run_command_refuses_invalid_files_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.toml").write_text("format = 1\nspeed = 3\n")
    (tmp_path / "policy").write_text("not a checkpoint")
    for arguments, expected in (
        (["--lab", str(tmp_path / "none.toml")], "none.toml"),
        (["--lab", str(tmp_path / "lab.toml")], "unknown key 'speed'"),
        (["--lab", str(tmp_path / "lab.toml"), "--insertions", "0"], "--insertions must be at least 1"),
    ):
        assert main(["run", "insertion", *arguments]) == 2
        output = capsys.readouterr()
        assert expected in output.err and output.err.count("\n") == 1


def test_a_scale_that_does_not_fit_the_markers_is_refused(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    left, right = (replace(camera, pixels_per_mm=157.0) for camera in (lab.cameras.left, lab.cameras.right))
    lab = replace(lab, cameras=replace(lab.cameras, left=left, right=right))
    with pytest.raises(SafetyError, match=r"left camera: .* pixels_per_mm = 15\.7\d* would fit; right camera: .*"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
    assert robot.arm.report.largest_step < 1e-9


def test_the_same_images_from_both_cameras_are_refused(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    # Another spelling of the address of the left camera, so that the sources differ.
    same = replace(lab.cameras.left, source=lab.cameras.left.source.replace("127.0.0.1", "localhost"))
    lab = replace(lab, cameras=replace(lab.cameras, right=same))
    with pytest.raises(SafetyError, match="right camera: it delivers the same images as the left camera"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab))
    assert robot.arm.report.largest_step < 1e-9
