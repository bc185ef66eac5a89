"""Monitors that the arm comes closer to a target."""

import math
from collections.abc import Callable

import numpy as np

from gelflow.clock import Clock
from gelflow.errors import PeerTimeout
from gelflow.geometry import Pose, angle_between

ARRIVED = (0.1e-3, math.radians(0.1))  # distance from the target at which a move has ended [m, rad]
_PROGRESS = 0.1  # reduction of the remaining motion that counts as progress, as a fraction of ARRIVED
_BLOCKED_AFTER = 3.0  # without progress [s]


class ApproachMonitor:
    """Progress of a motion to `target`; `pose` gives the measured pose, `hold` ends the motion.

    The controller may follow more slowly than the reference may move (MaxSpeedDeviation), so the duration of a motion
    does not show whether the arm is blocked.
    """

    def __init__(self, pose: Callable[[], Pose], hold: Callable[[], None], target: Pose, clock: Clock) -> None:
        self._pose, self._hold, self._target, self._clock = pose, hold, target, clock
        self._best, self._since = math.inf, clock.now()

    def check(self) -> None:
        """Hold and raise PeerTimeout when the arm came no closer for 3 s [robot time]."""
        now = self._clock.now()  # before the pose: a delay of this thread between the two is no lack of progress
        pose = self._pose()
        distance = float(np.linalg.norm(pose.position - self._target.position)) / ARRIVED[0]
        turn = angle_between(pose.quaternion, self._target.quaternion) / ARRIVED[1]
        remaining = max(distance, turn)  # 1 at the arrival
        if remaining < self._best - _PROGRESS:
            self._best, self._since = remaining, now
        elif now - self._since > _BLOCKED_AFTER:
            self._hold()
            millimetres, degrees = 1e3 * distance * ARRIVED[0], math.degrees(turn * ARRIVED[1])
            raise PeerTimeout(
                f"the arm is {millimetres:.2f} mm and {degrees:.2f}° from its target and came no closer for "
                f"{_BLOCKED_AFTER:g} s; is it blocked, or slower than its MaxSpeedDeviation?"
            )
