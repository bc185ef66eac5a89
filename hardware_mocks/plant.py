"""Plants: the physics behind the mock devices, as protocols, and kinematic plants for tests.

A mock implements the device's protocol on the wire; its plant simulates the mechanism. The simulated cell is the plant
of the mock robot; the kinematic plants here allow tests of the protocols without the simulator. Plants are called from
several threads and must be thread-safe. SI units; quaternions w x y z.
"""

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import Clock
from gelflow.errors import UsageError
from gelflow.real.limits import LIMITS


class GripperPlant(Protocol):
    """A parallel gripper: two fingers that move symmetrically."""

    def gripper_state(self) -> tuple[float, float, float]:
        """Width between the fingers [m], speed [m/s, positive opens], pressing force [N, ≥ 0]."""
        ...

    def command_gripper(self, *, width: float, speed: float, force: float) -> None:
        """Move towards `width` [m] at `speed` [m/s] with at most `force` [N]; replaces the last command."""
        ...


class ArmPlant(Protocol):
    """The tool of an arm in the robot's base frame."""

    def arm_pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Tool position [m], shape (3,), and quaternion w x y z, shape (4,)."""
        ...

    def command_arm(self, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
        """Follow this pose from now on: position [m], shape (3,); quaternion w x y z, shape (4,)."""
        ...


class GelPlant(Protocol):
    """The gels on the fingers."""

    def marker_displacement(self, finger: int) -> NDArray[np.float64]:
        """Displacement of the markers on the pad [mm], shape (markers, 2); finger 0 is the left one."""
        ...


class KinematicGripper:
    """Fingers that move at the commanded speed and stop at a rigid part or at the ends of the stroke.

    `part_width` [m] is the width of the part between the fingers, None without a part. The fingers press on the part
    or an end with the commanded force.
    """

    STROKE = LIMITS.gripper_width[1]  # [m]

    def __init__(self, clock: Clock, *, width: float = 0.050, part_width: float | None = None) -> None:
        if not 0 <= width <= self.STROKE:
            raise UsageError(f"width must be within 0 to {self.STROKE} m, got {width}")
        if part_width is not None and not 0 < part_width <= width:
            raise UsageError(f"part_width must be above 0 and at most the width {width} m, got {part_width}")
        self._clock = clock
        self._lock = threading.Lock()
        self._part = part_width
        self._width = width
        self._target = width
        self._speed = 0.0
        self._force = 0.0
        self._time = clock.now()

    def _stop_width(self) -> float:
        """Width at which the fingers stop [m]; the caller holds the lock."""
        reachable = min(max(self._target, 0.0), self.STROKE)
        # A part wider than the opening is not between the fingers.
        if self._part is not None and self._part <= self._width + 1e-9:
            reachable = max(reachable, self._part)
        return reachable

    def _advance(self) -> None:
        now = self._clock.now()
        travel = self._speed * (now - self._time)
        self._time = now
        gap = self._stop_width() - self._width
        self._width += float(np.clip(gap, -travel, travel))

    def gripper_state(self) -> tuple[float, float, float]:
        with self._lock:
            self._advance()
            gap = self._stop_width() - self._width
            speed = float(np.sign(gap)) * self._speed if abs(gap) > 1e-9 else 0.0
            pressing = speed == 0.0 and abs(self._target - self._width) > 1e-6
            return self._width, speed, self._force if pressing else 0.0

    def command_gripper(self, *, width: float, speed: float, force: float) -> None:
        with self._lock:
            self._advance()
            self._target, self._speed, self._force = width, speed, force

    def set_part(self, width: float | None) -> None:
        """Put a part of `width` [m] between the fingers, or remove it (None)."""
        with self._lock:
            self._advance()
            if width is not None and not 0 < width <= self._width:
                raise UsageError(f"a part of {width} m does not fit between fingers {self._width:.4f} m apart")
            self._part = width


class KinematicArm:
    """A tool that follows its reference with a first-order lag of time constant `lag` [s]."""

    def __init__(
        self, clock: Clock, *, position: NDArray[np.float64], quaternion: NDArray[np.float64], lag: float = 0.015
    ) -> None:
        if not lag > 0:
            raise UsageError(f"lag must be above 0 s, got {lag}")
        self._clock = clock
        self._lock = threading.Lock()
        self._lag = lag
        self._position, self._quaternion = _pose(position, quaternion)
        self._reference = self._position, self._quaternion
        self._time = clock.now()

    def _advance(self) -> None:
        now = self._clock.now()
        share = 1.0 - float(np.exp(-(now - self._time) / self._lag))
        self._time = now
        position, quaternion = self._reference
        self._position = self._position + share * (position - self._position)
        # Interpolate along the shorter rotation; linear interpolation is accurate for the small angles of one update.
        sign = 1.0 if float(quaternion @ self._quaternion) >= 0 else -1.0
        mixed = (1 - share) * self._quaternion + share * sign * quaternion
        self._quaternion = mixed / np.linalg.norm(mixed)

    def arm_pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        with self._lock:
            self._advance()
            return self._position.copy(), self._quaternion.copy()

    def command_arm(self, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> None:
        reference = _pose(position, quaternion)
        with self._lock:
            self._advance()
            self._reference = reference


def _pose(
    position: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    p = np.array(position, dtype=float)
    q = np.array(quaternion, dtype=float)
    if p.shape != (3,) or q.shape != (4,) or not np.isfinite(p).all() or not np.isfinite(q).all():
        raise UsageError(f"expected a finite position (3,) and quaternion w x y z (4,), got {p} and {q}")
    norm = float(np.linalg.norm(q))
    if norm < 0.5:
        raise UsageError(f"expected a quaternion of length 1, got length {norm:.3g}")
    return p, q / norm
