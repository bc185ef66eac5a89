"""Limits of motion: the single table of numbers that the drivers, the supervisor and the lab file share.

The limits are checked independently in four layers (lab file, supervisor, driver, EGM process), so that an error in one
layer does not pass. The table in docs/reference/robot_limits.md shows which layer checks which limit. `LIMITS` contains
the hardware ranges and the defaults, `LAB_RANGES` the widest value that a lab file may give to each of its numbers.
"""

from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class MotionLimits:
    """Hardware ranges and default limits. Lengths [m], angles [°], times in robot time [s]."""

    # WSG-50: hardware ranges; `WsgLimits` and the device itself may narrow them.
    gripper_width: tuple[float, float] = (0.0, 0.110)  # opening between the fingers [m]
    gripper_speed: tuple[float, float] = (0.005, 0.420)  # [m/s]
    gripper_force: tuple[float, float] = (5.0, 80.0)  # grasping force [N]
    gripper_reply_time: float = 1.0  # first reply to a command [s]
    gripper_home_time: float = 4.0  # end of homing [s]
    gripper_motion_time: float = 6.0  # end of any other motion [s]

    # IRB 120: hardware ranges of joints 1 to 6 [°].
    joint_ranges_deg: tuple[tuple[float, float], ...] = (
        *((-165.0, 165.0), (-110.0, 110.0), (-110.0, 70.0)),
        *((-160.0, 160.0), (-120.0, 120.0), (-400.0, 400.0)),
    )

    # Tool motion: defaults of the lab file and of the EGM driver.
    tool_speed: float = 0.02  # [m/s]
    tool_turn_speed_deg: float = 10.0  # [°/s]
    joint_speed_deg: float = 1.0  # of each joint, as MaxSpeedDeviation in the RAPID program [°/s]
    target_distance: float = 0.050  # from the arm to a target [m]
    target_turn_deg: float = 35.0  # from the arm to a target, in the insertion runner [°]
    target_turn_driver_deg: float = 20.0  # the same for the EGM driver used without a lab file [°]
    reference_lead: float = 2e-3  # distance from the measured pose to the reference, in any direction [m]
    reference_turn_lead_deg: float = 1.0  # the same as an angle [°]
    # In the direction of motion the reference leads the measured pose by its speed times this time, plus a margin.
    reference_lead_time: float = 0.025  # [s]
    reference_lead_margin: float = 0.05e-3  # [m]
    reference_turn_lead_margin_deg: float = 0.05  # [°]

    # Workspace of the gripper about the taught hole.
    workspace_x: float = 0.016  # |x| [m]
    workspace_y: float = 0.016  # |y| [m]
    workspace_yaw_deg: float = 16.0  # |yaw| [°]
    workspace_tilt_deg: float = 1.0  # of the gripper's z axis [°]
    workspace_height: tuple[float, float] = (0.001, 0.060)  # of the part's lower face above the hole's floor [m]
    descent_depth: float = 4.5e-3  # below the start of an attempt [m]

    # One jog by hand (gelflow robot jog).
    jog_distance: float = 0.020  # [m]
    jog_turn_deg: float = 10.0  # [°]
    jog_speed: float = 0.005  # [m/s]

    # Age of data that motion relies on.
    pose_age: float = 0.020  # then the arm holds [s]
    pose_silence: float = 0.100  # then the arm stops [s]
    image_age: float = 0.250  # [s]
    gripper_age: float = 0.500  # [s]
    controller_age: float = 3.0  # of the state over Robot Web Services [s]
    target_lifetime: float = 0.100  # a target that is not renewed expires [s]
    longest_target_lifetime: float = 1.0  # [s]
    recording_delay: float = 1.0  # of the oldest record that is not stored yet [s]


LIMITS = MotionLimits()


class Range(NamedTuple):
    """The allowed values of a number in a lab file."""

    low: float
    high: float
    unit: str = ""
    time_limit: bool = False  # wider for a mock robot (`MOCK_TIME_SCALE`)

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}" + f" {self.unit}".rstrip()


# A mock robot and the runner share one computer, whose scheduling jitter does not shrink when the clock is scaled: the
# time limits of a lab file with time synchronization may be larger by this factor and by the clock factor.
MOCK_TIME_SCALE = 12

LAB_RANGES = {
    "clock_factor": Range(1, 1000),
    "gripper.grasp_force": Range(*LIMITS.gripper_force, "N"),
    "gripper.part_width": Range(0.001, LIMITS.gripper_width[1], "m"),
    "gripper.open_width": Range(0.001, LIMITS.gripper_width[1], "m"),
    "gripper.speed": Range(*LIMITS.gripper_speed, "m/s"),
    "arm.egm_port": Range(1, 65535),
    "arm.max_speed": Range(0.0001, 0.1, "m/s"),
    "arm.max_turn_speed_deg": Range(0.1, 45, "°/s"),
    "arm.joint_speed_deg": Range(0.1, 20, "°/s"),
    "arm.connect_timeout": Range(0.1, 60, "s"),
    "cameras.pitch_mm": Range(0.2, 10, "mm"),
    "cameras.pixels_per_mm": Range(1, 200, "px/mm"),
    "cameras.center_mm": Range(-30, 30, "mm"),
    "cameras.latency": Range(0, 0.2, "s"),
    "tool.position": Range(-0.5, 0.5, "m"),
    "hole.position": Range(-1, 1, "m"),
    "hole.yaw_deg": Range(-180, 180, "°"),
    "hole.height_error": Range(0, 0.01, "m"),
    "part.grasp_height": Range(0.001, 0.2, "m"),
    "part.load_height": Range(0.001, 0.2, "m"),
    "part.load_wait": Range(0, 60, "s"),
    "part.insert_to": Range(0.0001, 0.1, "m"),
    "part.max_slip": Range(0.0001, 0.005, "m"),
    "workspace.x": Range(0.0001, 0.05, "m"),
    "workspace.y": Range(0.0001, 0.05, "m"),
    "workspace.yaw_deg": Range(0.1, 45, "°"),
    "workspace.tilt_deg": Range(0.1, 5, "°"),
    "workspace.height_min": Range(0, 0.1, "m"),
    "workspace.height_max": Range(0.001, 0.2, "m"),
    "workspace.max_step": Range(0.001, 0.1, "m"),
    "workspace.max_turn_deg": Range(1, 60, "°"),
    "descent.speed": Range(0.00005, 0.005, "m/s"),
    "descent.settle": Range(0, 10, "s"),
    "descent.contact_shear_mm": Range(0.001, 1, "mm"),
    "descent.stop_shear_mm": Range(0.002, 2, "mm"),
    "descent.planned_stop_shear_mm": Range(0.002, 2, "mm"),
    "descent.max_overshoot": Range(0.00002, 0.0005, "m"),
    "descent.max_depth": Range(0.0001, 0.01, "m"),
    "limits.stale_pose": Range(0.008, 0.1, "s", time_limit=True),
    "limits.stale_frame": Range(0.05, 1, "s", time_limit=True),
    "limits.stale_gripper": Range(0.5, 2, "s", time_limit=True),
    "limits.target_lifetime": Range(0.02, LIMITS.longest_target_lifetime, "s"),
    "limits.gripper_reply": Range(0.5, 5, "s", time_limit=True),
    "limits.gripper_motion": Range(1, 30, "s", time_limit=True),
    "limits.attempt_time": Range(1, 600, "s", time_limit=True),
    "limits.recording_delay": Range(0.3, 10, "s", time_limit=True),
    "limits.retries": Range(0, 10),
}
