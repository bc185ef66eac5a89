"""Supervisor: checks every target before it is sent to the arm, and latches stops. Not a safety-rated function.

An invalid target is refused, never clamped. After an emergency stop, motors off, a stopped program or stale data,
nothing moves for the rest of the run; an operator starts the next run.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SafetyError
from gelflow.geometry import Pose, angle_between
from gelflow.protocols import ArmState
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.phases import Phase, PhaseMachine

_TOLERANCE = 1e-6  # rounding at a bound


class Supervisor:
    """Checks targets of the gripper frame against a lab's limits and the phase of the run. Thread-safe."""

    def __init__(self, lab: Lab, *, on_phase: Callable[[Phase], None] = lambda phase: None) -> None:
        self._lab = lab
        self._base_to_hole = lab.hole.pose.inverse()
        self.phases = PhaseMachine(on_phase)

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
            raise SafetyError(f"the arm stopped: {reason}; inspect the robot, then start a new run")

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
            raise SafetyError(f"motion is latched: {self.latched}; inspect the robot, then start a new run")
        self._check_numbers(target)
        self._check_workspace(target)
        self._check_change(target, previous, speed, turn_speed)
        return self._lab.tool_pose(target)

    def hole_coordinates(self, target: Pose) -> tuple[float, float, float, float]:
        """Gripper pose relative to the taught hole: x, y [m], yaw [rad], height of the part's lower face [m]."""
        local = self._base_to_hole @ target
        x, y, z = (float(c) for c in local.position)
        return x, y, local.yaw, z - self._lab.part.grasp_height

    @staticmethod
    def _check_numbers(target: Pose) -> None:
        values = np.concatenate([target.position, target.quaternion])
        if not np.isfinite(values).all():
            raise SafetyError(f"target refused: it contains a number that is not finite: {_row(values)}")
        if abs(float(np.linalg.norm(target.quaternion)) - 1) > 1e-6:
            raise SafetyError(f"target refused: its quaternion {_row(target.quaternion)} does not have length 1")

    def _check_workspace(self, target: Pose) -> None:
        space = self._lab.workspace
        x, y, yaw, height = self.hole_coordinates(target)
        local = self._base_to_hole @ target
        bounds = (
            ("x", 1e3 * abs(x), 1e3 * space.x, "mm"),
            ("y", 1e3 * abs(y), 1e3 * space.y, "mm"),
            ("yaw", math.degrees(abs(yaw)), space.yaw_deg, "°"),
            ("tilt", math.degrees(local.tilt), space.tilt_deg, "°"),
        )
        for name, value, limit, unit in bounds:
            if not value <= limit + _TOLERANCE:
                raise SafetyError(f"target refused: |{name}| = {value:.2f} {unit} is outside ±{limit:g} {unit}")
        if not space.height_min - _TOLERANCE <= height <= space.height_max + _TOLERANCE:
            low, high = 1e3 * space.height_min, 1e3 * space.height_max
            raise SafetyError(f"target refused: height {1e3 * height:.2f} mm is outside {low:g} to {high:g} mm")

    def _check_change(self, target: Pose, previous: Pose, speed: float, turn_speed: float) -> None:
        space, arm = self._lab.workspace, self._lab.arm
        step = float(np.linalg.norm(target.position - previous.position))
        turn = math.degrees(angle_between(previous.quaternion, target.quaternion))
        bounds = (
            ("step", 1e3 * step, 1e3 * space.max_step, "mm"),
            ("turn", turn, space.max_turn_deg, "°"),
            ("speed", 1e3 * speed, 1e3 * arm.max_speed, "mm/s"),
            ("turning speed", math.degrees(turn_speed), arm.max_turn_speed_deg, "°/s"),
        )
        for name, value, limit, unit in bounds:
            # The comparison is false for NaN.
            if not value <= limit * (1 + _TOLERANCE):
                raise SafetyError(f"target refused: {name} {value:.4g} {unit} is more than {limit:.4g} {unit}")
        if not (speed > 0 and turn_speed > 0):
            raise SafetyError(f"target refused: speeds must be above 0, got {speed:g} m/s and {turn_speed:g} rad/s")


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
