"""Finger control of the mock WSG-50: motions and their results, grasping control, FAST STOP, flags."""

import math
from dataclasses import dataclass

from gelflow.hardware_mocks.plant import GripperPlant
from gelflow.real.limits import LIMITS
from gelflow.real.wsg.constants import HOME_INWARDS, Command, GraspState, Status, SystemFlag

_REACHED = 0.2e-3  # distance from the goal at which a motion is complete [m]
_AT_REST = 1e-3  # speed below which the fingers are at rest [m/s]
_SETTLE = 0.05  # fingers at rest this long before their goal are blocked [s]
_PRESSED = 0.8  # fraction of the force limit at which a part counts as grasped
_SLIPPED = 1.5e-3  # a held part is lost when the fingers close by more than this [m]
_LOOSE_FORCE = 0.1  # a held part is lost when the force is below this fraction of the force limit ...
_LOOSE_TIME = 0.1  # ... for this time [s]


@dataclass(frozen=True)
class MockWsgConfig:
    """Hardware data and settings of the mock gripper. SI units."""

    stroke: float = LIMITS.gripper_width[1]  # [m]
    speed: tuple[float, float] = LIMITS.gripper_speed  # [m/s]
    acceleration: tuple[float, float] = (0.1, 5.0)  # [m/s²]
    force: tuple[float, float, float] = (*LIMITS.gripper_force, 120.0)  # minimum, nominal, overdrive [N]
    clamp_travel: float = 3e-3  # half the band around the nominal width in which a part is grasped [m]
    homing_speed: float = 0.060  # [m/s]
    crc: bool = True  # False: checksums are neither checked nor sent
    fast_stop_on_disconnect: bool = True  # an unannounced TCP close raises FAST STOP
    shortest_command_interval: float = 0.0  # commands at shorter intervals are answered with OVERRUN [s]
    stops_at_any_rate: bool = True  # False: stops at shorter intervals are answered with OVERRUN too
    serial_number: int = 50_110


@dataclass
class _Motion:
    command: Command
    goal: float  # [m]
    sign: int  # +1 opens, −1 closes
    nominal: float  # expected width of the part [m]
    started: float
    at_rest_since: float | None = None


class FingerController:
    """State machine of the finger motions on a plant. Not thread-safe: the device holds a lock."""

    def __init__(self, plant: GripperPlant, config: MockWsgConfig) -> None:
        self._plant = plant
        self._config = config
        self._motion: _Motion | None = None
        self._clamped = False  # a part is between the fingers, also after a stop has ended the grasping control
        self._held_width = 0.0
        self._held_sign = -1
        self._loose_since: float | None = None
        self._blocked = 0
        self._reached = False
        self._stopped = False
        self._failed = False
        self._at_limit = 0
        self.referenced = False
        self.fast_stopped = False
        self.grasp = GraspState.IDLE
        self.force_limit = config.force[1] / 2  # [N]
        self.acceleration = 1.0  # [m/s²]; stored and reported, not simulated
        self.soft_limits: tuple[float, float] | None = None  # [m]
        self.measured = plant.gripper_state()  # width [m], speed [m/s], force [N]

    def home(self, direction: int, now: float) -> Status:
        """Start homing; returns PENDING or the reason of a refusal."""
        if direction not in (0, 1, 2):
            return Status.INVALID_PARAMETER
        goal = 0.0 if direction == HOME_INWARDS else self._config.stroke
        if refusal := self._refusal(Command.HOME):
            return refusal
        self.referenced = False
        self._start(Command.HOME, goal, self._config.homing_speed, self._config.force[0] * 2, now)
        return Status.CMD_PENDING

    def travel(self, command: Command, width: float, speed: float, now: float) -> Status:
        """Start a pre-position, grasp or release [m, m/s]; returns PENDING or the reason of a refusal."""
        if refusal := self._refusal(command):
            return refusal
        if not (math.isfinite(width) and math.isfinite(speed)):
            return Status.INVALID_PARAMETER
        low, high = self.soft_limits or (0.0, self._config.stroke)
        slowest, fastest = self._config.speed
        tiny = 1e-7  # rounding of float32 on the wire
        if not (low - tiny <= width <= high + tiny and slowest - tiny <= speed <= fastest + tiny):
            if self.soft_limits is not None:
                self._at_limit = (width > high) - (width < low)
            return Status.RANGE_ERROR
        force = self._config.force[1] if command == Command.RELEASE else self.force_limit
        goal = width
        if command == Command.GRASP:
            band = self._config.clamp_travel if width > self.measured[0] else -self._config.clamp_travel
            goal = min(max(width + band, 0.0), self._config.stroke)
        self._start(command, goal, speed, force, now, nominal=width)
        return Status.CMD_PENDING

    def stop(self) -> tuple[Command, Status] | None:
        """Stop the fingers; returns the command that ends, with its status."""
        ended = (self._motion.command, Status.CMD_ABORTED) if self._motion is not None else None
        # A held part stays clamped: the drive holds its position, and only the grasping control ends.
        if not self._clamped:
            self._plant.command_gripper(
                width=self.measured[0], speed=self._config.speed[0], force=self._config.force[0]
            )
        self._motion = None
        self._stopped = True
        if self.grasp != GraspState.ERROR:
            self.grasp = GraspState.IDLE
        return ended

    def fast_stop(self) -> tuple[Command, Status] | None:
        """Stop and lock; returns the command that ends, with its status."""
        ended = self.stop()
        self.fast_stopped = True
        self.grasp = GraspState.ERROR
        return ended

    def acknowledge(self) -> None:
        """Leave FAST STOP."""
        self.fast_stopped = False
        if self.grasp == GraspState.ERROR:
            self.grasp = GraspState.IDLE

    def lose_part(self) -> None:
        """Report that the held part is lost."""
        if self.grasp == GraspState.HOLDING:
            self.grasp = GraspState.PART_LOST

    def poll(self, now: float) -> tuple[Command, Status] | None:
        """Read the plant; returns the command that ends now, with its status."""
        self.measured = self._plant.gripper_state()
        if self._motion is None:
            self._monitor(now)
            return None
        status = self._result(self._motion, now)
        if status is None:
            return None
        command = self._motion.command
        self._motion = None
        self._failed = status != Status.SUCCESS
        return command, status

    def flags(self) -> SystemFlag:
        """Flags of the system state."""
        shown = {
            SystemFlag.REFERENCED: self.referenced,
            SystemFlag.MOVING: self._motion is not None,
            SystemFlag.BLOCKED_MINUS: self._blocked < 0,
            SystemFlag.BLOCKED_PLUS: self._blocked > 0,
            SystemFlag.SOFT_LIMIT_MINUS: self._at_limit < 0,
            SystemFlag.SOFT_LIMIT_PLUS: self._at_limit > 0,
            SystemFlag.AXIS_STOPPED: self._stopped,
            SystemFlag.TARGET_REACHED: self._reached,
            SystemFlag.FORCE_CONTROL: self.grasp == GraspState.HOLDING,
            SystemFlag.FAST_STOP: self.fast_stopped,
            SystemFlag.CMD_FAILURE: self._failed,
        }
        return SystemFlag(sum(flag for flag, on in shown.items() if on))

    def _refusal(self, command: Command) -> Status | None:
        if self.fast_stopped:
            return Status.ACCESS_DENIED
        if self._motion is not None:
            return Status.ALREADY_RUNNING
        if command != Command.HOME and not self.referenced:
            return Status.NOT_INITIALIZED
        if self.grasp == GraspState.HOLDING and command != Command.RELEASE:
            return Status.ALREADY_RUNNING
        return None

    def _start(
        self, command: Command, goal: float, speed: float, force: float, now: float, *, nominal: float = 0.0
    ) -> None:
        self._plant.command_gripper(width=goal, speed=speed, force=force)
        self._clamped = False
        self._motion = _Motion(command, goal, 1 if goal > self.measured[0] else -1, nominal, now)
        self._blocked = self._at_limit = 0
        self._reached = self._stopped = self._failed = False
        self.grasp = {Command.GRASP: GraspState.GRASPING, Command.RELEASE: GraspState.RELEASING}.get(
            command, GraspState.POSITIONING
        )

    def _result(self, motion: _Motion, now: float) -> Status | None:
        width, speed, force = self.measured
        there = abs(width - motion.goal) < _REACHED
        if abs(speed) > _AT_REST or now - motion.started < _SETTLE:
            motion.at_rest_since = None
        elif motion.at_rest_since is None:
            motion.at_rest_since = now
        blocked = not there and motion.at_rest_since is not None and now - motion.at_rest_since >= _SETTLE
        if motion.command == Command.GRASP:
            pressed = force >= _PRESSED * self.force_limit and abs(speed) < 5 * _AT_REST
            return self._grasp_result(motion, now, there=there, pressed=pressed or blocked)
        if there:
            self._reached = True
            self.grasp = GraspState.IDLE
            if motion.command == Command.HOME:
                self.referenced = True
                self.soft_limits = None
            return Status.SUCCESS
        return self._block(motion) if blocked else None

    def _grasp_result(self, motion: _Motion, now: float, *, there: bool, pressed: bool) -> Status | None:
        width = self.measured[0]
        if pressed:
            before_band = motion.sign * (motion.nominal - width) > self._config.clamp_travel
            if before_band:
                return self._block(motion)
            self.grasp, self._clamped = GraspState.HOLDING, True
            self._held_width, self._held_sign, self._loose_since = width, motion.sign, None
            return Status.SUCCESS
        if there:
            self._reached = True
            self.grasp = GraspState.NO_PART
            return Status.CMD_FAILED
        return None

    def _block(self, motion: _Motion) -> Status:
        self._blocked = motion.sign
        self.grasp = GraspState.ERROR
        return Status.AXIS_BLOCKED

    def _monitor(self, now: float) -> None:
        """Detect the loss of a clamped part; only the grasping control reports it."""
        if not self._clamped:
            return
        width, _, force = self.measured
        if force >= _LOOSE_FORCE * self.force_limit:
            self._loose_since = None
        elif self._loose_since is None:
            self._loose_since = now
        loose = self._loose_since is not None and now - self._loose_since >= _LOOSE_TIME
        if loose or self._held_sign * (width - self._held_width) > _SLIPPED:
            self._clamped = False
            self.lose_part()
