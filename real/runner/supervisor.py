"""Supervisor: checks every target before it is sent to the arm, and latches stops. Not a safety-rated function.

An invalid target is refused, never clamped. After an emergency stop, motors off, a stopped program or stale data,
nothing moves for the rest of the run; an operator starts the next run.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SafetyError
from gelflow.geometry import Pose, angle_between, multiply, yaw_quaternion
from gelflow.protocols import ArmState
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.phases import Phase, PhaseMachine, with_advice

_TOLERANCE = 1e-6  # rounding at a bound
_DEVIATION = (0.1e-3, 0.1e-3, math.radians(0.1))  # of a measured pose from its target [m, m, rad]


class Supervisor:
    """Checks targets of the gripper frame against a lab's limits and the phase of the run. Thread-safe."""

    def __init__(self, lab: Lab, *, on_phase: Callable[[Phase], None] = lambda phase: None) -> None:
        self._lab = lab
        self._base_to_hole = lab.hole.pose.inverse()
        self.phases = PhaseMachine(on_phase)
        self.last_bounds: tuple[TargetBound, ...] = ()  # of the last target that was checked

    @property
    def latched(self) -> str:
        """The reason why motion is forbidden; empty while motion is allowed."""
        return self.phases.latched

    def latch(self, reason: str) -> None:
        """Forbid motion for the rest of the run. The first reason is kept."""
        self.phases.latched = self.phases.latched or reason
        self.phases.enter(Phase.LATCHED)

    def watch(self, state: ArmState) -> None:
        """Latch, and raise SafetyError, when the controller is not ready to move."""
        reason = not_ready_reason(state)
        if reason:
            self.latch(reason)
            raise SafetyError(with_advice(f"the arm stopped: {reason.removeprefix('stopped: ')}"))

    def check(self, target: Pose, previous: Pose, *, speed: float, turn_speed: float) -> Pose:
        """Check a target of the gripper frame; returns the tool pose to send to the controller.

        Parameters
        ----------
        target: gripper frame in the base frame
        previous: present pose of the gripper frame in the base frame
        speed, turn_speed: speeds of the motion [m/s], [rad/s]

        Raises SafetyError when the target is not finite, outside the workspace, too far from the present pose or too
        fast, and always after a latch. The arm's driver checks joint ranges, because it knows the controller's tool.
        """
        if self.latched:
            raise SafetyError(with_advice(f"motion is latched: {self.latched}"))
        self._check_numbers(target)
        self.last_bounds = bounds = self._bounds(target, previous, speed, turn_speed)
        for bound in bounds:
            if not bound.ok:
                raise SafetyError(f"target refused: {bound.refusal}")
        if not (speed > 0 and turn_speed > 0):
            raise SafetyError(f"target refused: speeds must be above 0, got {speed:g} m/s and {turn_speed:g} rad/s")
        return self._lab.tool_pose(target)

    def hole_coordinates(self, target: Pose) -> tuple[float, float, float, float]:
        """Gripper pose relative to the taught hole: x, y [m], yaw [rad], height of the part's lower face [m]."""
        local = self._base_to_hole @ target
        x, y, z = (float(c) for c in local.position)
        return x, y, local.yaw, z - self._lab.part.grasp_height

    def within_workspace(self, measured: Pose) -> Pose:
        """A measured pose at a limit of x, y or yaw, moved back by at most 0.1 mm and 0.1°.

        With it, a motion straight up from a target at the limit is not refused because the arm deviates slightly from
        the target.
        """
        local, space = self._base_to_hole @ measured, self._lab.workspace
        now = np.array([*local.position[:2], local.yaw])
        limit = np.array([space.x, space.y, math.radians(space.yaw_deg)])
        back = np.clip(now, -limit, limit) - now
        back[np.abs(back) > _DEVIATION] = 0.0
        quaternion = np.array(multiply(yaw_quaternion(back[2]), local.quaternion))
        return self._lab.hole.pose @ Pose(local.position + np.append(back[:2], 0.0), quaternion)

    @staticmethod
    def _check_numbers(target: Pose) -> None:
        values = np.concatenate([target.position, target.quaternion])
        if not np.isfinite(values).all():
            raise SafetyError(f"target refused: it contains a number that is not finite: {_row(values)}")
        if abs(float(np.linalg.norm(target.quaternion)) - 1) > 1e-6:
            raise SafetyError(f"target refused: its quaternion {_row(target.quaternion)} does not have length 1")

    def _bounds(self, target: Pose, previous: Pose, speed: float, turn_speed: float) -> "tuple[TargetBound, ...]":
        """The quantities of a target that have bounds."""
        space, arm = self._lab.workspace, self._lab.arm
        x, y, yaw, height = self.hole_coordinates(target)
        tilt = (self._base_to_hole @ target).tilt
        step = float(np.linalg.norm(target.position - previous.position))
        turn = math.degrees(angle_between(previous.quaternion, target.quaternion))
        return (
            TargetBound("x", 1e3 * x, -1e3 * space.x, 1e3 * space.x, "mm"),
            TargetBound("y", 1e3 * y, -1e3 * space.y, 1e3 * space.y, "mm"),
            TargetBound("yaw", math.degrees(yaw), -space.yaw_deg, space.yaw_deg, "°"),
            TargetBound("tilt", math.degrees(tilt), 0.0, space.tilt_deg, "°"),
            TargetBound("height", 1e3 * height, 1e3 * space.height_min, 1e3 * space.height_max, "mm"),
            TargetBound("step", 1e3 * step, 0.0, 1e3 * space.max_step, "mm"),
            TargetBound("turn", turn, 0.0, space.max_turn_deg, "°"),
            TargetBound("speed", 1e3 * speed, 0.0, 1e3 * arm.max_speed, "mm/s"),
            TargetBound("turning speed", math.degrees(turn_speed), 0.0, arm.max_turn_speed_deg, "°/s"),
        )


@dataclass(frozen=True)
class TargetBound:
    """One quantity of a target and its allowed range."""

    name: str
    value: float
    low: float
    high: float
    unit: str

    @property
    def ok(self) -> bool:
        """Whether the value is within its range; False for NaN."""
        return self.low - _TOLERANCE <= self.value <= self.high + _TOLERANCE

    @property
    def _shown(self) -> str:
        """The value to 0.001 of its unit, so that rounding errors are 0."""
        return f"{round(self.value, 3) + 0.0:g}"

    @property
    def text(self) -> str:
        """Value and range in words."""
        return f"{self._shown} {self.unit}, allowed {self.low:g} to {self.high:g} {self.unit}"

    @property
    def refusal(self) -> str:
        """The reason why a target with this value is refused."""
        return f"{self.name} {self.value:.4g} {self.unit} is outside {self.low:g} to {self.high:g} {self.unit}"


def not_ready_reason(state: ArmState) -> str:
    """The reason why the arm must not be moved; empty when it may be moved."""
    if state.fault:
        return state.fault
    if not state.motors_on:
        return "motors are off"
    if not state.running:
        return "the controller's program or its motion control is not running"
    if state.operating_mode not in ("auto", "manual reduced", "unknown"):
        return f"operating mode is {state.operating_mode}; it must be auto or manual reduced"
    return ""


def _row(values: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"
