"""Insertion runner against the mock robot: stale data, faults and interrupts stop the arm."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.real.runner.harness import BackgroundRun, OraclePolicy, events, moving, plan_for, wait_for

from gelflow.errors import GelflowError, PeerTimeout, SafetyError
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.protocols import GripperState
from gelflow.real.runner.lab_file import save_lab
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.run_plan import run_insertions
from gelflow.real.runner.touch.observer import TactileObserver, TactileReading
from gelflow.session.reader import SessionReader


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (lambda robot: robot.cameras[1].stall(), "camera right"),
        (lambda robot: robot.cameras[0].drop_clients(), "camera left"),
        (lambda robot: robot.arm.silence(60.0), "pose is"),
        (lambda robot: robot.arm.motors(False), "motors"),
        (lambda robot: robot.gripper.raise_fast_stop(), "FAST"),
    ],
    ids=["frames stall", "stream ends", "poses stall", "motors off", "fast stop"],
)
def test_stale_data_or_a_fault_holds_the_arm_and_ends_the_run(
    robot: MockRobot, tmp_path: Path, fault: Callable[[MockRobot], None], expected: str
) -> None:
    plan = plan_for(robot, tmp_path, OraclePolicy(robot))
    finish = BackgroundRun(lambda: run_insertions(plan))
    wait_for(lambda: moving(robot), during=finish)
    fault(robot)
    with pytest.raises(GelflowError) as error:
        finish()
    assert expected.lower() in str(error.value).lower() and "\n" not in str(error.value)

    # The arm is at rest, no more references are sent, and the part is still held.
    answers = robot.arm.report.answers
    before = robot.cell.arm_pose()[0]
    time.sleep(0.3)
    assert robot.arm.report.answers == answers
    assert robot.cell.arm_pose()[0] == pytest.approx(before, abs=1e-6)
    assert robot.cell.truth()["part"]["phase"] == "gripped"
    assert robot.cell.gripper_state()[2] > 10
    # The recording is complete and contains the reason.
    recorded = dict(events(plan.session))
    assert expected.lower() in recorded["stopped"]["reason"].lower()
    assert recorded["arm timing"]["cycles"] > 100 and 0 <= recorded["arm timing"]["missed"] < 1


@pytest.mark.parametrize(
    ("expected", "in_motion", "grasp", "force", "stopped"),
    [
        (False, False, "idle", 0.0, True),
        (False, False, "grasping", 0.0, True),
        (False, False, "idle", 6.0, False),  # they press on something
        (False, False, "holding", 12.0, False),
        (False, False, None, 0.0, False),
        (False, True, "idle", 6.0, True),  # the device reports the motion later, or it is being prepared
        (False, True, "holding", 12.0, False),  # the grasp has ended
        (False, True, None, 0.0, True),  # nothing is received any more
        (True, True, "releasing", 12.0, False),
    ],
)
def test_fingers_stop_with_the_arm_unless_they_may_hold_a_part(
    expected: bool, in_motion: bool, grasp: str | None, force: float, stopped: bool
) -> None:
    calls: list[str] = []

    class Fingers:
        def forbid_motion(self, reason: str) -> bool:
            calls.append(reason)
            return in_motion

        def state(self) -> GripperState:
            if grasp is None:
                raise PeerTimeout("the gripper's state is old")
            return GripperState(0.05, 0.0, force, True, grasp, "", 0.0)

        def stop(self) -> None:
            calls.append("stop")

    executor: Any = SimpleNamespace(_part_expected=expected, _gripper=Fingers())
    MotionExecutor._stop_empty_fingers(executor, "why")
    assert ("stop" in calls) == stopped


def test_a_requested_stop_holds_the_arm_at_once_and_ends_the_run(robot: MockRobot, tmp_path: Path) -> None:
    executors: list[MotionExecutor] = []
    plan = plan_for(robot, tmp_path, OraclePolicy(robot), on_motion=executors.append)
    finish = BackgroundRun(lambda: run_insertions(plan))
    wait_for(lambda: moving(robot), during=finish)
    executors[0].request_stop("the operator pressed stop")
    with pytest.raises(SafetyError, match="the operator pressed stop"):
        executors[0].start_motion(executors[0].pose(), guarded=True)
    with pytest.raises(SafetyError, match="stopped: the operator pressed stop"):
        finish()
    executors[0].request_stop("again")
    answers = robot.arm.report.answers
    time.sleep(0.2)
    assert robot.arm.report.answers == answers
    assert robot.cell.truth()["part"]["phase"] == "gripped"
    with SessionReader(plan.session) as session:
        checks = [record.value["checks"] for record in session.records(["/checks"])]
    names = [check["name"] for check in checks[-1]]
    assert names[:7] == ["arm", "measured pose", "recording", "left camera", "right camera", "gripper", "motion"]
    assert {"target: x", "target: height", "target: turning speed"} <= set(names)
    assert all(check["ok"] for check in checks[-2])
    failed = {check["name"]: check["text"] for check in checks[-1] if not check["ok"]}
    assert "the operator pressed stop" in failed["motion"]


def test_a_stop_before_the_first_motion_moves_nothing(robot: MockRobot, tmp_path: Path) -> None:
    before, width = robot.cell.arm_pose()[0], robot.cell.gripper_state()[0]

    def stop(motion: MotionExecutor) -> None:
        motion.request_stop("the operator pressed stop")

    with pytest.raises(SafetyError, match="the operator pressed stop"):
        run_insertions(plan_for(robot, tmp_path, OraclePolicy(robot), on_motion=stop))
    assert robot.cell.arm_pose()[0] == pytest.approx(before, abs=1e-9)
    assert robot.cell.gripper_state()[0] == pytest.approx(width, abs=1e-4)  # the fingers were not homed


def test_a_stop_at_the_hand_over_does_not_close_the_fingers(
    robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hand may be between them: the stop is pressed while the reference images are taken."""
    executors: list[MotionExecutor] = []
    at_rest = TactileObserver.at_rest

    def stopped(observer: TactileObserver, since: float) -> list[TactileReading]:
        executors[0].request_stop("the operator pressed stop")
        return at_rest(observer, since)

    monkeypatch.setattr(TactileObserver, "at_rest", stopped)
    plan = plan_for(robot, tmp_path, OraclePolicy(robot), on_motion=executors.append)
    with pytest.raises(SafetyError, match="the operator pressed stop"):
        run_insertions(plan)
    assert robot.cell.gripper_state()[0] == pytest.approx(plan.lab.gripper.open_width, abs=1e-3)


@pytest.mark.slow
def test_slow_disk_stops_the_arm(robot: MockRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record may be late by 2 s (wall); an fsync takes up to 5 s once the part moves, and no time before."""
    seconds, ended = 0.0, threading.Event()
    monkeypatch.setattr(os, "fsync", lambda descriptor: ended.wait(seconds))
    lab = lab_for(robot)
    lab = replace(lab, limits=replace(lab.limits, recording_delay=2.0 * robot.clock.factor))
    plan = plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab)
    finish = BackgroundRun(lambda: run_insertions(plan))
    wait_for(lambda: moving(robot), during=finish)
    seconds = 5.0
    begun = robot.clock.now()
    wait_for(lambda: robot.arm.report.state == "ended")
    ended.set()
    # The error of the recording, or that of the next motion, which the latch refuses for the same reason.
    with pytest.raises(GelflowError, match=r"is \d\.\d s behind, at most 2 s is allowed; is the disk full or slow\?"):
        finish()
    recorded = events(plan.session)
    stops = [values["at"] for name, values in recorded if name == "arm stopped" and "at" in values]
    assert stops and stops[0] - begun < 5.0 * robot.clock.factor, "stopped before the first record was stored"
    assert "behind" in dict(recorded)["stopped"]["reason"]
    assert robot.cell.truth()["part"]["phase"] == "gripped"


def test_interrupt_stops_the_arm_and_closes_the_recording(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    save_lab(lab, tmp_path / "lab.toml", title="test")
    script = tmp_path / "run.py"
    script.write_text(_RUN_UNTIL_INTERRUPTED)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)], stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": _SOURCE}
    )
    try:
        wait_for(lambda: moving(robot) or process.poll() is not None)
        assert process.poll() is None, process.communicate()[1].decode()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, errors.decode()
    recorded = dict(events(tmp_path / "session.mcap"))  # an incomplete file is refused
    assert "KeyboardInterrupt" in recorded["arm stopped"]["reason"]
    assert not robot.gripper.fast_stopped
    answers = robot.arm.report.answers
    time.sleep(0.2)
    assert robot.arm.report.answers == answers
    assert robot.cell.truth()["part"]["phase"] == "gripped"


_SOURCE = str(Path(__file__).resolve().parents[3] / "src")


_RUN_UNTIL_INTERRUPTED = """
import signal
import sys
from pathlib import Path
import numpy as np
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import RunPlan, run_insertions
from gelflow.task import INSERTION

class Still:
    def reset(self): pass
    def act(self, observation): return np.zeros(3)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for background processes
folder = Path(sys.argv[1])
try:
    run_insertions(RunPlan(load_lab(folder / "lab.toml"), Still(), INSERTION, folder / "session.mcap", insertions=9))
except KeyboardInterrupt:
    sys.exit(130)
"""
