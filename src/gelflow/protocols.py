"""Protocols of cameras, arms, grippers and policies, which drivers and mocks implement.

Units are SI: metres, radians, newtons, seconds; quaternions w x y z. Times are robot time (`gelflow.clock`).
Every method has its own time limit and raises `gelflow.errors.PeerError` (or a subclass) when it is exceeded.
"""

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import FlowMap


@dataclass(frozen=True)
class CameraImage:
    """A camera image as received. The compressed bytes are recorded; decoding them is deterministic."""

    data: bytes  # JPEG or PNG
    stamp: float  # robot time of reception, less the known part of the transmission's delay [s]
    sequence: int  # counts the images received from this camera
    encoding: str = "jpeg"
    camera_time: float | None = None  # on the camera's own clock, if the camera sends it [s]


@dataclass(frozen=True)
class ArmState:
    """Measured state of the arm."""

    position: NDArray[np.float64]  # tool in the robot's base frame [m], shape (3,)
    quaternion: NDArray[np.float64]  # w x y z, shape (4,)
    joints: NDArray[np.float64]  # [rad], shape (6,)
    stamp: float  # robot time of reception [s]
    motors_on: bool
    running: bool  # the controller follows references
    operating_mode: str = "auto"  # "auto", "manual reduced", "manual full", "unknown"
    fault: str = ""  # empty, or the controller's description of the fault


@dataclass(frozen=True)
class GripperState:
    """Measured state of the gripper."""

    width: float  # opening between the fingers [m]
    speed: float  # [m/s]
    force: float  # [N]
    referenced: bool  # homed
    grasp: str  # idle, grasping, no part, part lost, holding, releasing, positioning, error
    fault: str  # empty, or the fault's name
    stamp: float  # robot time of reception [s]


@runtime_checkable
class Camera(Protocol):
    """A tactile camera whose stream is running."""

    name: str

    def latest(self) -> CameraImage:
        """The newest image. Raises PeerTimeout when none has arrived within the time limit."""
        ...

    def next(self, after: int, timeout: float) -> CameraImage:
        """The newest image with a `sequence` above `after`; images in between are skipped.

        Waits at most `timeout` [s, robot time]. Raises PeerTimeout when no such image arrives.
        """
        ...

    def close(self) -> None: ...


@runtime_checkable
class Arm(Protocol):
    """A position-controlled arm that follows a stream of references and can be stopped during a motion.

    `target` may be called at any rate. The newest reference replaces the previous one and expires after `lifetime`
    seconds; the arm then holds its position. The driver limits the change per cycle.
    """

    abortable: bool  # False: a motion cannot be stopped once it was sent (text-protocol drivers)

    def state(self) -> ArmState:
        """The newest measured state."""
        ...

    def target(
        self,
        position: NDArray[np.float64],
        quaternion: NDArray[np.float64],
        *,
        lifetime: float,
        speed: float | None = None,
        turn_speed: float | None = None,
    ) -> None:
        """Set the reference of the tool: position [m], shape (3,), and quaternion w x y z, shape (4,).

        `speed` [m/s] and `turn_speed` [rad/s] lower the driver's own limits. Raises SafetyError for a target beyond
        the limits; it is never clamped.
        """
        ...

    def hold(self) -> None:
        """Come to rest and keep the position."""
        ...

    def stop(self, reason: str) -> None:
        """Stop sending, so that the controller's own time limit ends the motion. Latched until `reset`."""
        ...

    def reset(self) -> None:
        """Allow motion again after a stop, on the operator's command."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper with force-limited grasping. Widths [m], speeds [m/s], forces [N].

    A driver does no I/O before `with`, which connects at its start and calls `close` at its end. For the recording of a
    session (`real/runner/cell.py`) its constructor also takes two callbacks: `on_command(name, values)`, called before
    a command is sent, and `on_measurement(state)`, called for every new measured state.
    """

    def __enter__(self) -> Self:
        """Connect. Raises PeerError when the gripper cannot be reached."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close, after any error too."""
        ...

    def state(self) -> GripperState:
        """The newest measured state."""
        ...

    def home(self) -> None:
        """Reference the fingers; returns when done."""
        ...

    def grasp(self, *, width: float, speed: float, force: float) -> None:
        """Close on a part; returns when it is held. Raises PeerRefused when there is no part between the fingers."""
        ...

    def release(self, *, width: float, speed: float) -> None:
        """Open to release a held part; returns when done."""
        ...

    def move(self, *, width: float, speed: float) -> None:
        """Move the fingers without a part; returns when done."""
        ...

    def stop(self) -> None:
        """Stop the motion of the fingers."""
        ...

    def forbid_motion(self, reason: str) -> bool:
        """Refuse every motion until `close`, also one that is not sent yet; returns whether one is in progress."""
        ...

    def close(self) -> None:
        """Announce the disconnect, then close."""
        ...


class Policy(Protocol):
    """Maps the observation of an attempt to a correction of the pose."""

    def reset(self) -> None:
        """Clear the state before a new part."""
        ...

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        """The correction (dx [m], dy [m], dyaw [rad]) of the gripper in its own frame, shape (3,)."""
        ...
