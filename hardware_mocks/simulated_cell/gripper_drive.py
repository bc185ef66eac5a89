"""Gripper drive of the simulated cell: ramped width command, force limit, coupled jaws."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene import Scene
from gelflow.sim.simulator import Simulator

_SATURATED = 0.9  # fraction of the force limit at which a jaw counts as pressing
_LOCK_AFTER = 0.1  # time for which both jaws press before the part counts as gripped [s]
_WIDTH_TOLERANCE = 3e-3  # of the width against the part's width while gripping [m]
_FINGERS = ("finger_left", "finger_right")
_HOLDS = ("hold_left", "hold_right")


class GripperDrive:
    """Drives the two fingers of the insertion scene. The caller holds the cell's lock.

    In motion, both fingers follow a servo with a force limit. When both press on a part, the left jaw holds its
    position stiffly while the right one continues to press: the jaws of the real gripper are coupled by a gear and
    cannot both yield to one side, and a kinematic tree has no such coupling.
    """

    def __init__(
        self, sim: Simulator, scene: Scene, controls: NDArray[np.float64], *, width: float, closed_on: float
    ) -> None:
        self._sim, self._u = sim, controls
        self._joints, self._rates = sim.q[0], sim.v[0]
        self._q = [sim.joint_q(name) for name in _FINGERS]
        self._v = [sim.joint_v(name) for name in _FINGERS]
        self._hold = [scene.u(name) for name in _HOLDS]
        self._kp = [float(sim.param(f"{name}.kp")[0]) for name in _HOLDS]
        self._kd = [float(sim.param(f"{name}.kd")[0]) for name in _HOLDS]
        self._part_width = closed_on
        self._target = self._width = width
        self._speed = 0.05
        self._force = 10.0
        self._pressing = 0.0
        self.locked = False  # a part is gripped
        sim.q[0, self._q] = -width / 2
        self._limit(self._force)

    def command(self, *, width: float, speed: float, force: float) -> None:
        """Move towards `width` [m] at `speed` [m/s] with at most `force` [N]."""
        if self.locked or abs(width - self._target) > 0:
            self._width = self.width()
        self._target, self._speed, self._force = width, speed, force
        self.locked, self._pressing = False, 0.0
        self._limit(force)

    def width(self) -> float:
        """Distance between the pads [m]."""
        return -(float(self._joints[self._q[0]]) + float(self._joints[self._q[1]]))

    def state(self) -> tuple[float, float, float]:
        """Width [m], speed [m/s, positive opens], force [N]."""
        speed = -(float(self._rates[self._v[0]]) + float(self._rates[self._v[1]]))
        return self.width(), speed, max(0.0, sum(self._forces()) / 2)

    def drive(self, seconds: float) -> None:
        """Set the servo targets for the next step of `seconds`."""
        if self.locked:
            return
        remaining = self._target - self._width
        self._width += min(max(remaining, -self._speed * seconds), self._speed * seconds)
        self._u[self._hold] = -self._width / 2
        closing = self._width < self.width() and min(self._forces()) > _SATURATED * self._force
        on_part = abs(self.width() - self._part_width) < _WIDTH_TOLERANCE
        self._pressing = self._pressing + seconds if closing and on_part else 0.0
        if self._pressing > _LOCK_AFTER:
            self._lock()

    def _forces(self) -> list[float]:
        """Closing force of each servo [N]."""
        forces = []
        for q, v, hold, kp, kd in zip(self._q, self._v, self._hold, self._kp, self._kd, strict=True):
            force = kp * (float(self._u[hold]) - float(self._joints[q])) - kd * float(self._rates[v])
            forces.append(min(max(force, -self._force), self._force))
        return forces

    def _lock(self) -> None:
        self.locked = True
        left = self._joints[self._q[0]]
        # Offset the servo target so that the present force continues without a jump.
        self._u[self._hold[0]] = left + self._force / self._kp[0]
        self._set("hold_left", np.inf)

    def _limit(self, force: float) -> None:
        for name in _HOLDS:
            self._set(name, force)

    def _set(self, name: str, force: float) -> None:
        values: Any = ((f"{name}.force_lower", -force), (f"{name}.force_upper", force))
        for key, value in values:
            self._sim.param(key)[:] = value
