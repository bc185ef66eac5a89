"""Robot time of the mock robot waits for the arm's driver and for the runner, and neither for the other."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tests.real.runner.harness import events

from gelflow.errors import PeerError, PeerTimeout
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.egm.driver import EgmArm
from gelflow.real.runner.cell import egm_config, open_cell
from gelflow.real.runner.run_plan import create_motion
from gelflow.session.recorder import SessionRecorder
from gelflow.time_sync import RUNNER


def test_pose_stays_fresh_while_the_drivers_process_does_not_run(robot: MockRobot) -> None:
    lab = lab_for(robot)
    oldest = 0.0
    with EgmArm(egm_config(lab, dry_run=True), clock=lab.clock) as arm:
        assert arm.pid is not None
        os.kill(arm.pid, signal.SIGSTOP)
        end = time.monotonic() + 1.0  # 4 s of robot time
        while time.monotonic() < end:
            now = lab.clock.now()  # before the state, as the runner's check does
            oldest = max(oldest, now - arm.state().stamp)
            time.sleep(0.01)
        os.kill(arm.pid, signal.SIGCONT)
        stopped = lab.clock.now()
        while arm.state().stamp < stopped:
            time.sleep(0.01)
    assert oldest < lab.limits.stale_pose


def test_the_state_is_readable_during_a_stop(robot: MockRobot) -> None:
    """A thread in a bounded block waited for the state, and the stop for robot time: the process was killed."""
    lab = lab_for(robot)
    with EgmArm(egm_config(lab), clock=lab.clock) as arm:
        arm.wait_following(60.0)
        start = arm.state()
        stopping = threading.Thread(target=arm.stop, args=("the test stops it",))
        up = start.position + np.array([0.0, 0.0, 0.01])
        arm.target(up, start.quaternion, lifetime=0.5)
        while arm.state().position[2] < start.position[2] + 1e-4:
            arm.target(up, start.quaternion, lifetime=0.5)
        with lab.clock.bounded(RUNNER):
            time.sleep(0.1)  # robot time stands still from now on, and the arm does not come to rest
            stopping.start()
            time.sleep(0.1)
            assert not arm.state().fault
        stopping.join()
        assert arm.state().fault == "the test stops it"


def test_a_reset_that_is_not_confirmed_has_no_effect_later(robot: MockRobot) -> None:
    lab = lab_for(robot)
    with EgmArm(egm_config(lab), clock=lab.clock) as arm:
        arm.wait_following(60.0)
        arm.stop("the operator pressed stop")
        pid = arm.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        with pytest.raises(PeerTimeout, match="did not confirm the reset"):
            arm.reset()
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.2)
        with pytest.raises(PeerError, match="nothing is sent to the robot any more"):
            arm.state()


def test_the_hold_of_an_interrupted_run_is_recorded(robot: MockRobot, tmp_path: Path) -> None:
    """The driver's process confirms it late, when the thread that records events has already ended."""
    lab = lab_for(robot)
    path = tmp_path / "session.mcap"
    with (
        pytest.raises(KeyboardInterrupt),
        SessionRecorder(path, lab.clock).open() as recorder,
        open_cell(lab, recorder) as cell,
    ):
        cell.arm.wait_following(60.0)
        with create_motion(cell)[1]:
            start = cell.arm.state()
            up = start.position + np.array([0.0, 0.0, 0.01])
            cell.arm.target(up, start.quaternion, lifetime=1.0)
            begun = lab.clock.now()
            pid = cell.arm.pid
            assert pid is not None
            os.kill(pid, signal.SIGSTOP)
            threading.Timer(0.3, os.kill, (pid, signal.SIGCONT)).start()
            raise KeyboardInterrupt
    recorded = events(path)
    times = {name: values["at"] for name, values in recorded if "at" in values}
    assert begun <= times["arm hold"] <= times["arm stopped"]
    assert recorded[-1][0] == "arm stopped" and recorded[-1][1]["reason"] == "KeyboardInterrupt: "
