"""Contents of a lab file: the description of one robot cell (`lab_example.toml` explains each key).

SI units, unless the name of a key ends in `_deg` or `_mm`. `gelflow.real.runner.lab_file` reads and writes the file.
"""

import dataclasses
import ipaddress
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, load_gel
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.perception.camera_calibration import load_calibration
from gelflow.perception.force.estimator import check_force_grid
from gelflow.perception.frames import CameraMount
from gelflow.real.addresses import is_host
from gelflow.real.camera.driver import MjpegCamera
from gelflow.real.limits import LAB_RANGES, LIMITS, MOCK_TIME_SCALE, Range
from gelflow.real.transport import transport_for
from gelflow.real.web_services.client import WebServicesClient
from gelflow.real.wsg.checks import motion_time

FORMAT = 1
_MOST_LINES = 100  # of markers in one direction
Vector = tuple[float, float, float]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise UsageError(message)


def _check_ranges(table: Any, path: str, *, skip: str = "") -> None:
    """Raise UsageError when a number of `table`, whose keys start with `path`, is outside `LAB_RANGES`, or NaN.

    Time limits are not checked here, because their range depends on the whole lab file.
    """
    for field_ in dataclasses.fields(table):
        allowed = LAB_RANGES.get(path + field_.name)
        if allowed is not None and not allowed.time_limit and field_.name != skip:
            _check_range(field_.name, getattr(table, field_.name), allowed)


def _check_range(name: str, value: Any, allowed: Range) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    # The comparison is false for NaN.
    valid = all(allowed.low <= number <= allowed.high * (1 + 1e-9) for number in numbers)
    _require(valid, f"{name} must be {allowed}, got {_toml(value)}")


@dataclass(frozen=True)
class GripperSettings:
    """A WSG-50 and the parameters of a grasp."""

    address: str  # "serial:/dev/ttyUSB0" or "tcp:HOST:PORT"
    grasp_force: float  # per finger [N], 5 to 80
    part_width: float  # of the part between the pads [m]
    open_width: float  # opening before grasping and after releasing [m]
    speed: float = 0.02  # of the fingers [m/s], 0.005 to 0.42
    home_at_start: bool = False  # home outwards when not referenced; requires that nothing is between the fingers

    def __post_init__(self) -> None:
        known = self.address.startswith(("serial:", "tcp:"))
        _require(known, f"address must be serial:DEVICE or tcp:HOST:PORT, got {self.address!r}")
        transport_for(self.address, clock=ScaledClock())  # checks the address
        _check_ranges(self, "gripper.")
        text = f"part_width must be below open_width, got {self.part_width} and {self.open_width} m"
        _require(self.part_width < self.open_width, text)


@dataclass(frozen=True)
class ArmSettings:
    """An ABB arm that follows references over EGM."""

    egm_port: int = 6510  # UDP port on which this computer listens
    max_speed: float = LIMITS.tool_speed  # of the tool, in moves between attempts [m/s]
    max_turn_speed_deg: float = LIMITS.tool_turn_speed_deg  # angular speed of the tool [°/s]
    joint_speed_deg: float = LIMITS.joint_speed_deg  # of each joint [°/s]: MaxSpeedDeviation of the RAPID program
    connect_timeout: float = 5.0  # for the first message of the robot [s]
    host: str = "0.0.0.0"  # address of this computer to listen on; 0.0.0.0: all
    robot: str = ""  # IP address of the controller; empty: the first sender
    # "http://HOST" of the controller's Robot Web Services; empty: mode and program are not supervised.
    web_services: str = ""

    def __post_init__(self) -> None:
        _check_ranges(self, "arm.")
        _require(is_host(self.host), f"host must be an IPv4 address of this computer or its name, got {self.host!r}")
        try:
            ipaddress.IPv4Address(self.robot or "0.0.0.0")
        except ValueError:
            text = f"robot must be the IP address of the controller (IPv4), or empty, got {self.robot!r}"
            raise UsageError(text) from None
        if self.web_services:
            WebServicesClient(self.web_services)  # checks the address


@dataclass(frozen=True)
class CameraSettings:
    """One GelSlim sensor: source of its images and geometry of its view."""

    source: str  # "http://HOST:PORT/path" of an MJPEG stream, "uvc:INDEX" or "uvc:/dev/videoN"
    rows: int  # markers from the finger's base to its tip
    cols: int  # markers across the finger
    pitch_mm: float  # distance between neighbouring markers on the gel [mm]
    calibration: str = ""  # file of gelflow calibrate-camera, relative to the lab file or absolute
    pixels_per_mm: float = 0.0  # without a calibration: uniform scale of the image on the gel [px/mm]
    center_mm: tuple[float, float] = (0.0, 0.0)  # centre of the marker grid on the pad, x towards the fingertip [mm]
    rotation_deg: int = 0  # of the image, clockwise; at 0 the fingertip is at the bottom [°]: 0, 90, 180 or 270
    mirrored: bool = True  # the camera views the gel from behind
    gel: str = ""  # file of gelflow calibrate-gel, relative to the lab file or absolute; empty: no forces
    latency: float = 0.0  # constant time from the exposure to the reception of an image [s], 0 to 0.2
    # First and last row and column that the image shows, from 1; [0, 0]: those of the calibration, without one all.
    visible_rows: tuple[int, int] = (0, 0)
    visible_cols: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        known = self.source.startswith("http://") or re.fullmatch(r"uvc:(\d{1,4}|/dev/.+)", self.source)
        text = f"source must be http://HOST:PORT/…, uvc:INDEX or uvc:/dev/videoN, got {self.source!r}"
        _require(bool(known), text)
        if self.source.startswith("http://"):
            MjpegCamera(self.source, "source", ScaledClock())  # checks the address
        turned = self.rotation_deg in (0, 90, 180, 270)
        _require(turned, f"rotation_deg must be 0, 90, 180 or 270, got {self.rotation_deg}")
        lines = min(self.rows, self.cols) >= 3 and max(self.rows, self.cols) <= _MOST_LINES
        _require(lines, f"rows and cols must be 3 to {_MOST_LINES}, got {self.rows}, {self.cols}")
        one = bool(self.calibration) != bool(self.pixels_per_mm)
        _require(one, "give either calibration, a file of gelflow calibrate-camera, or pixels_per_mm")
        _check_ranges(self, "cameras.", skip="pixels_per_mm" if self.calibration else "")

    @property
    def mount(self) -> CameraMount:
        """Geometry of the view. Raises UsageError when the calibration cannot be read or does not fit."""
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
            visible_rows=self.visible_rows if any(self.visible_rows) else None,
            visible_cols=self.visible_cols if any(self.visible_cols) else None,
        )

    @property
    def elastic_gel(self) -> ElasticGel | None:
        """The gel of the pad; None without one.

        Raises UsageError when its file cannot be read, or when forces cannot be estimated on the grid of markers.
        """
        if not self.gel:
            return None
        check_force_grid(*self.mount.image_grid)
        return load_gel(Path(self.gel))


@dataclass(frozen=True)
class CamerasSettings:
    """The two GelSlim sensors; left is the finger at −x of the gripper."""

    left: CameraSettings
    right: CameraSettings

    def __post_init__(self) -> None:
        same = _camera_identity(self.left.source) == _camera_identity(self.right.source)
        _require(not same, f"left and right must be two cameras, got the same source {self.right.source!r} for both")
        for key in ("rows", "cols", "pitch_mm", "center_mm"):
            left, right = getattr(self.left, key), getattr(self.right, key)
            text = f"left and right must have the same grid of markers, got {key} = {_toml(left)} and {_toml(right)}"
            _require(left == right, text)


def _toml(value: Any) -> str:
    return str(list(value) if isinstance(value, tuple) else value)


def _camera_identity(source: str) -> str:
    """A text that is equal for two sources of the same camera."""
    if not source.startswith("uvc:"):
        try:
            url = urlsplit(source)
            return f"{url.hostname}:{url.port or 80}{url.path or '/'}?{url.query}"
        except ValueError:  # an invalid address, which the driver refuses
            return source
    device = source.removeprefix("uvc:")
    # Links such as those in /dev/v4l/by-id name a device that has another name too.
    return os.path.realpath(f"/dev/video{int(device)}" if device.isdigit() else device)


@dataclass(frozen=True)
class ToolSettings:
    """Pose of the gripper frame in the tool frame of the controller.

    The origin of the gripper frame lies between the pad centres, x points from the left to the right finger, z points
    up (away from the part) when the gripper hangs down.
    """

    position: Vector  # [m]
    quaternion: tuple[float, float, float, float]  # w x y z

    def __post_init__(self) -> None:
        _check_ranges(self, "tool.")
        length = math.sqrt(sum(c * c for c in self.quaternion))
        _require(abs(length - 1) < 1e-3, f"quaternion must have length 1, got {length:.4f}")

    @property
    def pose(self) -> Pose:
        """The gripper frame in the tool frame of the controller."""
        return Pose(np.array(self.position), np.array(self.quaternion) / np.linalg.norm(self.quaternion))


@dataclass(frozen=True)
class HoleSettings:
    """The taught hole, accurate to a few millimetres and degrees; the policy corrects the remaining misalignment."""

    position: Vector  # centre of the hole's floor in the robot's base frame [m]
    yaw_deg: float  # of the gripper about the base's z axis, when the part fits [°]
    height_error: float = 4e-3  # largest error of the taught height, within which the rim is searched by touch [m]

    def __post_init__(self) -> None:
        _check_ranges(self, "hole.")

    @property
    def pose(self) -> Pose:
        """The hole frame in the robot's base frame: z up, origin at the centre of the floor."""
        return Pose(np.array(self.position), yaw_quaternion(math.radians(self.yaw_deg)))


@dataclass(frozen=True)
class PartSettings:
    """The part and its hand-over."""

    grasp_height: float  # of the pad centres above the part's lower face [m]
    load_height: float = 0.040  # of the lower face above the hole's floor at the hand-over [m]
    presentation: str = "prompt"  # "prompt": the operator presses Enter; "wait": the part is present after load_wait
    load_wait: float = 2.0  # [s]
    insert_to: float = 0.002  # height of the lower face above the hole's floor at the release [m]
    max_slip: float = 1e-3  # slip in the grip, summed over the attempts on a part, after which it is handed back [m]

    def __post_init__(self) -> None:
        _require(
            self.presentation in ("prompt", "wait"),
            f'presentation must be "prompt" or "wait", got {self.presentation!r}',
        )
        _check_ranges(self, "part.")


@dataclass(frozen=True)
class WorkspaceSettings:
    """Allowed targets of the gripper about the taught hole. A target outside is refused, never clamped."""

    x: float = LIMITS.workspace_x  # largest |x| in the hole frame [m]
    y: float = LIMITS.workspace_y  # largest |y| [m]
    yaw_deg: float = LIMITS.workspace_yaw_deg  # largest |yaw| [°]
    tilt_deg: float = LIMITS.workspace_tilt_deg  # largest angle between the z axes of gripper and hole [°]
    height_min: float = LIMITS.workspace_height[0]  # lowest lower face above the hole's floor [m]
    height_max: float = LIMITS.workspace_height[1]  # highest lower face [m]
    max_step: float = LIMITS.target_distance  # largest distance from the arm to a target [m]
    max_turn_deg: float = LIMITS.target_turn_deg  # largest rotation from the arm to a target [°]

    def __post_init__(self) -> None:
        _check_ranges(self, "workspace.")
        _require(self.height_min < self.height_max, "height_min must be below height_max")


@dataclass(frozen=True)
class DescentSettings:
    """The descent of an attempt and its stop conditions."""

    speed: float = 0.5e-3  # [m/s]
    settle: float = 0.5  # rest before the reference images [s]
    # Thresholds of the mean change of shear along the finger since the reference, the larger of both pads [mm].
    contact_shear_mm: float = 0.04  # contact: the part is not in the hole
    stop_shear_mm: float = 0.12  # the descent stops at once
    planned_stop_shear_mm: float = 0.25  # largest stop_shear_mm of a motion plan, if above stop_shear_mm
    weight_check: bool = True  # both pads must show the part's weight at every grasp, which scales the thresholds
    max_overshoot: float = 0.1e-3  # largest travel of the arm after contact [m]; limits the speed of lowering
    max_depth: float = LIMITS.descent_depth  # largest depth below the start of an attempt [m]

    def __post_init__(self) -> None:
        _check_ranges(self, "descent.")
        _require(self.stop_shear_mm > self.contact_shear_mm, "stop_shear_mm must be above contact_shear_mm")

    @property
    def largest_stop_shear_mm(self) -> float:
        """Largest shear at which a motion plan may stop a descent [mm]."""
        return max(self.stop_shear_mm, self.planned_stop_shear_mm)


@dataclass(frozen=True)
class LimitsSettings:
    """Time-outs of the runner in robot time [s]."""

    stale_pose: float = LIMITS.pose_age  # a measured pose older than this: hold, then stop
    stale_frame: float = LIMITS.image_age  # a camera image older than this: hold, then stop
    stale_gripper: float = LIMITS.gripper_age  # a gripper state older than this: hold, then stop
    target_lifetime: float = LIMITS.target_lifetime  # a target that is not renewed expires, and the arm holds
    gripper_reply: float = LIMITS.gripper_reply_time  # for the first reply of the gripper to a command
    gripper_motion: float = LIMITS.gripper_motion_time  # for the end of a gripper motion
    attempt_time: float = 60.0  # for one attempt
    recording_delay: float = LIMITS.recording_delay  # a record that is not stored after this time ends the run
    retries: int = 1  # repetitions of a reference whose markers are not readable

    def __post_init__(self) -> None:
        _check_ranges(self, "limits.")


@dataclass(frozen=True)
class Lab:
    """A whole lab file."""

    gripper: GripperSettings
    arm: ArmSettings
    cameras: CamerasSettings
    tool: ToolSettings
    hole: HoleSettings
    part: PartSettings
    workspace: WorkspaceSettings = field(default_factory=WorkspaceSettings)
    descent: DescentSettings = field(default_factory=DescentSettings)
    limits: LimitsSettings = field(default_factory=LimitsSettings)
    clock_factor: float = 1.0  # robot time over wall time: 1 for a robot, larger only for a mock robot
    time_sync: str = ""  # time-sync file of a mock robot; empty for a robot
    format: int = FORMAT

    def __post_init__(self) -> None:
        _check_ranges(self, "")
        real_time = self.clock_factor == 1 or bool(self.time_sync)
        text = f"clock_factor must be 1 without time_sync (a robot runs in real time), got {self.clock_factor}"
        _require(real_time, text)
        for key, allowed in LAB_RANGES.items():
            if allowed.time_limit:
                value = getattr(self.limits, key.removeprefix("limits."))
                _check_range(key, value, allowed._replace(high=self.time_scale * allowed.high))
        self._check_heights()
        self._check_times()

    def _check_heights(self) -> None:
        part, space = self.part, self.workspace
        text = f"part.insert_to must be at least workspace.height_min, got {part.insert_to} and {space.height_min} m"
        _require(part.insert_to >= space.height_min, text)
        text = f"part.load_height must be at most workspace.height_max, got {part.load_height} and {space.height_max} m"
        _require(part.load_height <= space.height_max, text)

    def _check_times(self) -> None:
        gripper, limits = self.gripper, self.limits
        farthest = max(LIMITS.gripper_width[1] - gripper.open_width, gripper.open_width)  # from open or closed fingers
        needed = motion_time(farthest, gripper.speed)
        text = (
            f"gripper.speed {gripper.speed} m/s is too low: {1e3 * farthest:.0f} mm take {needed:.1f} s, and "
            f"limits.gripper_motion is {limits.gripper_motion} s"
        )
        _require(needed <= limits.gripper_motion, text)
        for side, camera in (("left", self.cameras.left), ("right", self.cameras.right)):
            text = f"cameras.{side}.latency must be below limits.stale_frame, got {camera.latency} and "
            _require(camera.latency < limits.stale_frame, f"{text}{limits.stale_frame} s")

    @property
    def clock(self) -> ScaledClock:
        """The clock of the cell."""
        return ScaledClock(self.clock_factor, self.time_sync)

    def to_json(self) -> dict[str, Any]:
        """Plain data for recordings."""
        return dataclasses.asdict(self)

    @property
    def time_scale(self) -> float:
        """Factor of all time limits: above 1 for a mock robot."""
        return MOCK_TIME_SCALE * self.clock_factor if self.time_sync else 1.0

    def gripper_at(self, x: float, y: float, yaw: float, height: float) -> Pose:
        """Gripper frame in the base frame, for a planar pose [m, m, rad] about the taught hole.

        `height` is that of the part's lower face above the floor of the hole [m].
        """
        return self.hole.pose @ Pose(np.array([x, y, height + self.part.grasp_height]), yaw_quaternion(yaw))

    def tool_pose(self, gripper: Pose) -> Pose:
        """Tool pose of the controller, in the base frame, that brings the gripper frame to `gripper`."""
        return gripper @ self.tool.pose.inverse()

    def gripper_pose(self, position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Pose:
        """Gripper frame in the robot's base frame, from the tool pose that the controller reports."""
        return Pose(position, quaternion) @ self.tool.pose
