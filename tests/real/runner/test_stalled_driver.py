"""A computer that does not run the arm driver's process for a second: robot time of the mock robot waits."""

import os
import signal
import time

from gelflow.cli.mock_lab import lab_for
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.real.egm.driver import EgmArm
from gelflow.real.runner.cell import egm_config


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
