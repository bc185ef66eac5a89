"""The lab file: everything the runner must know of one robot cell, as TOML (`lab_example.toml` explains each key).

SI units, except where a key's name says otherwise (`_deg`, `_mm`). `lab_file` reads and writes it.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.perception.calibration import load_calibration
from gelflow.perception.frames import CameraMount

FORMAT = 1
Vector = tuple[float, float, float]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise UsageError(message)


def _positive(table: object, *names: str) -> None:
    for name in names:
        value = getattr(table, name)
        _require(value > 0, f"{name} must be above 0, got {value}")


@dataclass(frozen=True)
class GripperLab:
    """A WSG-50 and how to grasp with it."""

    address: str  # "serial:/dev/ttyUSB0" or "tcp:HOST:PORT"
    grasp_force: float  # per finger [N]; a WSG-50 gives 5 to 80
    part_width: float  # of the part between the pads [m]
    open_width: float  # opening that lets the part in and out [m]
    speed: float = 0.02  # of the fingers [m/s]; a WSG-50 gives 0.005 to 0.42
    home_at_start: bool = False  # home outwards when not referenced; only with nothing between the fingers

    def __post_init__(self) -> None:
        known = self.address.startswith(("serial:", "tcp:"))
        _require(known, f"address must be serial:DEVICE or tcp:HOST:PORT, got {self.address!r}")
        _require(5 <= self.grasp_force <= 80, f"grasp_force must be 5 to 80 N, got {self.grasp_force}")
        _require(0.005 <= self.speed <= 0.42, f"speed must be 0.005 to 0.42 m/s, got {self.speed}")
        widths = 0 < self.part_width < self.open_width <= 0.110
        _require(widths, f"0 < part_width < open_width ≤ 0.110 m must hold, got {self.part_width}, {self.open_width}")


@dataclass(frozen=True)
class ArmLab:
    """An ABB arm that follows references over EGM."""

    egm_port: int = 6510  # UDP port on which this computer listens
    max_speed: float = 0.02  # of the tool, in moves between attempts [m/s]
    max_turn_speed_deg: float = 10.0  # of the tool [°/s]
    connect_timeout: float = 5.0  # how long to wait for the robot's first message [s]
    host: str = "0.0.0.0"  # address of this computer to listen on; 0.0.0.0: all of them
    robot: str = ""  # the controller's IP address; empty: whoever sends first

    def __post_init__(self) -> None:
        _require(0 < self.egm_port < 65536, f"egm_port must be 1 to 65535, got {self.egm_port}")
        _positive(self, "max_speed", "max_turn_speed_deg", "connect_timeout")


@dataclass(frozen=True)
class CameraLab:
    """One GelSlim: where its images come from, and how its view lies on the pad."""

    source: str  # "http://HOST:PORT/path" of an MJPEG stream, or "uvc:INDEX"
    rows: int  # markers from the finger's base to its tip
    cols: int  # markers across the finger
    pitch_mm: float  # distance between neighbouring markers on the gel [mm]
    calibration: str = ""  # file of gelflow calibrate-camera for this camera, beside the lab file or by its full path
    pixels_per_mm: float = 0.0  # without a calibration: one scale of the image on the gel [px/mm]
    center_mm: tuple[float, float] = (0.0, 0.0)  # the marker grid's centre on the pad, x to the tip [mm]
    rotation_deg: int = 0  # of the image, clockwise; at 0 the finger's tip is at the bottom [°]: 0, 90, 180 or 270
    mirrored: bool = True  # the camera sees the gel from behind

    def __post_init__(self) -> None:
        known = self.source.startswith(("http://", "uvc:"))
        _require(known, f"source must be http://HOST:PORT/… or uvc:INDEX, got {self.source!r}")
        if self.source.startswith("uvc:"):
            _require(self.source[4:].isdigit(), f"source must be uvc:INDEX with a whole number, got {self.source!r}")
        turned = self.rotation_deg in (0, 90, 180, 270)
        _require(turned, f"rotation_deg must be 0, 90, 180 or 270, got {self.rotation_deg}")
        _require(self.rows >= 3 and self.cols >= 3, f"rows and cols must be at least 3, got {self.rows}, {self.cols}")
        _positive(self, "pitch_mm")
        one = bool(self.calibration) != bool(self.pixels_per_mm) and self.pixels_per_mm >= 0
        _require(one, "give either calibration, a file of gelflow calibrate-camera, or pixels_per_mm, above 0")

    @property
    def mount(self) -> CameraMount:
        """How the camera looks at its pad. Raises UsageError when the calibration can't be read or does not fit."""
        rotation = cast(Literal[0, 90, 180, 270], self.rotation_deg)
        return CameraMount(
            rows=self.rows,
            cols=self.cols,
            pitch=self.pitch_mm,
            center=self.center_mm,
            rotation=rotation,
            mirrored=self.mirrored,
            pixels_per_mm=self.pixels_per_mm or None,
            calibration=load_calibration(self.calibration) if self.calibration else None,
        )


@dataclass(frozen=True)
class CamerasLab:
    """The two GelSlims; left is the finger at the gripper's −x."""

    left: CameraLab
    right: CameraLab


@dataclass(frozen=True)
class ToolLab:
    """The gripper frame in the frame that the controller reports: origin between the pads' centres, x from the left
    finger to the right one, z up (away from the part) when the gripper hangs down."""

    position: Vector  # [m]
    quaternion: tuple[float, float, float, float]  # w x y z

    def __post_init__(self) -> None:
        length = math.sqrt(sum(c * c for c in self.quaternion))
        _require(abs(length - 1) < 1e-3, f"quaternion must have length 1, got {length:.4f}")

    @property
    def pose(self) -> Pose:
        return Pose(np.array(self.position), np.array(self.quaternion) / np.linalg.norm(self.quaternion))


@dataclass(frozen=True)
class HoleLab:
    """The hole as taught: right to a few millimetres and degrees, the policy does the rest."""

    position: Vector  # centre of the hole's floor in the robot's base frame [m]
    yaw_deg: float  # of the gripper about base z, when the part fits [°]

    @property
    def pose(self) -> Pose:
        return Pose(np.array(self.position), yaw_quaternion(math.radians(self.yaw_deg)))


@dataclass(frozen=True)
class PartLab:
    """The part and how it is handed over."""

    grasp_height: float  # of the pads' centres above the part's lower face [m]
    load_height: float = 0.040  # of the lower face above the hole's floor where parts are handed over [m]
    presentation: str = "prompt"  # "prompt": the operator presses Enter; "wait": the part is there after load_wait
    load_wait: float = 2.0  # [s]
    insert_to: float = 0.002  # lower face above the hole's floor when the part is let go [m]

    def __post_init__(self) -> None:
        _require(
            self.presentation in ("prompt", "wait"),
            f'presentation must be "prompt" or "wait", got {self.presentation!r}',
        )
        _positive(self, "grasp_height", "load_height", "insert_to")
        _require(self.load_wait >= 0, f"load_wait must be at least 0, got {self.load_wait}")


@dataclass(frozen=True)
class WorkspaceLab:
    """Where the gripper may be told to go, about the taught hole pose. A target outside is refused, never clamped."""

    x: float = 0.016  # |x| at most, in the hole's frame [m]
    y: float = 0.016  # |y| at most [m]
    yaw_deg: float = 16.0  # |yaw| at most [°]
    tilt_deg: float = 1.0  # of the gripper's z from the base's z, at most [°]
    height_min: float = 0.001  # lowest lower face above the hole's floor [m]
    height_max: float = 0.060  # highest [m]
    max_step: float = 0.050  # farthest a target may lie from where the arm is [m]
    max_turn_deg: float = 35.0  # largest turn to a target [°]

    def __post_init__(self) -> None:
        _positive(self, "x", "y", "yaw_deg", "tilt_deg", "max_step", "max_turn_deg")
        _require(self.height_min < self.height_max, "height_min must be below height_max")


@dataclass(frozen=True)
class DescentLab:
    """One attempt: lowering, feeling, and when to stop."""

    speed: float = 0.5e-3  # [m/s]
    settle: float = 0.5  # rest before the reference frame is taken [s]
    # Mean change of shear along the finger since the reference frame, the larger of both pads [mm].
    contact_shear_mm: float = 0.04  # above this the part touches something: it is not in the hole
    stop_shear_mm: float = 0.12  # above this the descent stops at once
    max_depth: float = 1.5e-3  # an attempt that goes deeper than this below its start is ended [m]

    def __post_init__(self) -> None:
        _positive(self, "speed", "settle", "contact_shear_mm", "max_depth")
        _require(self.stop_shear_mm > self.contact_shear_mm, "stop_shear_mm must be above contact_shear_mm")


@dataclass(frozen=True)
class LimitsLab:
    """When the runner gives up. Times in robot time [s]."""

    stale_pose: float = 0.020  # a measured pose older than this: hold, then stop
    stale_frame: float = 0.250  # a camera frame older than this: hold, then stop
    stale_gripper: float = 0.500  # a gripper state older than this: hold, then stop
    target_lifetime: float = 0.100  # a target that is not renewed for this long becomes a hold
    gripper_reply: float = 1.0  # for the gripper's first answer to a command
    gripper_motion: float = 6.0  # for the end of a gripper's motion
    attempt_time: float = 60.0  # for one attempt
    retries: int = 1  # repeats of an attempt whose frames could not be read

    def __post_init__(self) -> None:
        _positive(self, "stale_pose", "stale_frame", "stale_gripper", "target_lifetime")
        _positive(self, "gripper_reply", "gripper_motion", "attempt_time")
        _require(self.retries >= 0, f"retries must be at least 0, got {self.retries}")


@dataclass(frozen=True)
class Lab:
    """A whole lab file."""

    gripper: GripperLab
    arm: ArmLab
    cameras: CamerasLab
    tool: ToolLab
    hole: HoleLab
    part: PartLab
    workspace: WorkspaceLab = field(default_factory=WorkspaceLab)
    descent: DescentLab = field(default_factory=DescentLab)
    limits: LimitsLab = field(default_factory=LimitsLab)
    clock_factor: float = 1.0  # robot time over wall time: 1 for a robot, more only for a mock
    time_sync: str = ""  # the file with which a mock robot holds robot time back; none for a robot
    format: int = FORMAT

    @property
    def clock(self) -> ScaledClock:
        return ScaledClock(self.clock_factor, self.time_sync)

    def to_json(self) -> dict[str, Any]:
        """As plain data, for recordings."""
        return dataclasses.asdict(self)

    def tool_pose(self, gripper: Pose) -> Pose:
        """What the controller must report for the gripper frame to be at `gripper`."""
        return gripper @ self.tool.pose.inverse()

    def gripper_pose(self, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Pose:
        """The gripper frame in the robot's base, from what the controller reports."""
        return Pose(position, quaternion) @ self.tool.pose
