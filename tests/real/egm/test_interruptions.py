"""The helper process of the arm, interrupted between any two lines: no pose in the log is older than the lead."""

import math
import socket

import pytest
from tests.real.egm.harness import DOWN, START

from gelflow.clock import ScaledClock
from gelflow.helper_process import Messages
from gelflow.real.egm.codec import EgmFeedback, encode_robot
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.cycle_log import EgmCycleLog
from gelflow.real.egm.process import _LONGEST_GAP, EgmLoop


class _InterruptedClock(ScaledClock):
    """Passes `interruption` [s, robot time] at each reading; `granted` is the limit of a mock robot's time."""

    interruption = 0.0
    time = 0.0
    granted = math.inf

    def now(self) -> float:
        object.__setattr__(self, "time", min(self.time + self.interruption, self.granted))
        return self.time

    def grant(self, slot: int, until: float) -> None:
        object.__setattr__(self, "granted", max(until, self.time))


@pytest.mark.parametrize("interruption", [0.001, 0.2, 0.7])
def test_no_pose_in_the_log_is_older_than_the_lead(interruption: float) -> None:
    clock = _InterruptedClock(5.0)
    object.__setattr__(clock, "interruption", interruption)
    log = EgmCycleLog(EgmCycleLog.create(1024), 1024)
    udp, controller = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    udp.bind(("127.0.0.1", 0))
    udp.setblocking(False)
    ours, parents = socket.socketpair()
    ages: list[float] = []

    class _Loop(EgmLoop):
        def _report(self) -> None:
            """At the start of each cycle, when the log has the newest record and the limit is already granted."""
            super()._report()
            newest = log.latest()
            if newest is not None:
                ages.append(clock.granted - newest.stamp)
            if len(ages) > 50:
                parents.close()
            number = len(ages)
            message = EgmFeedback(number, 0.004 * number, tuple(START), tuple(DOWN), (0.0, 0.0, 0.0, 0.0, 0.5, 0.0))
            controller.sendto(encode_robot(message), udp.getsockname())

    with ours, udp, controller:
        _Loop(EgmConfig((0.2, -0.3, 0.1), (0.5, 0.3, 0.6)), clock, udp, Messages(ours), log).run()
    log.close()
    assert len(ages) > 50
    assert max(ages) <= clock.factor * _LONGEST_GAP + 1e-9
