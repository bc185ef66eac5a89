"""What the runner needs of hardware and policies. A driver, or a stand-in for one, is anything that fits.

Units are SI: metres, radians, newtons, seconds; quaternions w x y z. Times are robot time (`gelflow.clock`).
Every method has a time-out of its own and raises `gelflow.errors.PeerError` (or a subclass) rather than hang.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import FlowMap


@dataclass(frozen=True)
class CameraImage:
    """One frame as received: the compressed bytes are what is recorded, and decoding them is repeatable."""

    data: bytes  # JPEG or PNG
    stamp: float  # robot time of reception [s]
    sequence: int  # counts frames received from this camera
    encoding: str = "jpeg"


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
    fault: str = ""  # empty, or what is wrong in the controller's words


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
    """A tactile camera that is already streaming."""

    name: str

    def latest(self) -> CameraImage:
        """The newest frame; raises PeerTimeout when none has come within its time-out."""
        ...

    def next(self, after: int, timeout: float) -> CameraImage:
        """The first frame whose `sequence` is greater than `after`; waits up to `timeout` [s, robot time]."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Arm(Protocol):
    """A position-controlled arm that follows a stream of references and can be stopped in mid-move.

    `target` may be called at any rate; the newest reference replaces the one before and expires after
    `lifetime` seconds, whereupon the arm holds where it is. The driver bounds each cycle's change.
    """

    abortable: bool  # False: a move that was sent can not be stopped (text-protocol drivers)

    def state(self) -> ArmState: ...

    def target(self, position: NDArray[np.float64], quaternion: NDArray[np.float64], *, lifetime: float) -> None: ...

    def hold(self) -> None:
        """Freeze the reference where it is, within one cycle."""
        ...

    def stop(self, reason: str) -> None:
        """Cease sending: the controller's own time-out ends motion. Latches until `reset`."""
        ...

    def close(self) -> None: ...


@runtime_checkable
class Gripper(Protocol):
    """A parallel gripper with force-limited grasping. Widths [m], speeds [m/s], forces [N]."""

    def state(self) -> GripperState: ...

    def home(self) -> None: ...

    def grasp(self, *, width: float, speed: float, force: float) -> None:
        """Close on a part; returns when it is held. Raises PeerRefused when nothing is between the fingers."""
        ...

    def release(self, *, width: float, speed: float) -> None: ...

    def move(self, *, width: float, speed: float) -> None: ...

    def stop(self) -> None: ...

    def close(self) -> None:
        """Announce the disconnect, then close."""
        ...


class Policy(Protocol):
    """Turns what was felt in one attempt into a correction of the pose."""

    def reset(self) -> None:
        """Forget everything: a new part is to be inserted."""
        ...

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        """One correction: (dx [m], dy [m], dtheta [rad]) of the gripper, in the gripper's frame."""
        ...
