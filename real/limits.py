"""Limits of motion: the single table of numbers that the drivers, the supervisor and the lab file share.

The limits are checked independently in four layers (lab file, supervisor, driver, EGM process), so that an error in
one layer does not pass. The table in docs/guide/robot.md shows which layer checks which limit.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class MotionLimits:
    """Hardware ranges and default limits. Lengths [m], angles [°], times in robot time [s]."""

    # WSG-50: hardware ranges; a lab file and the device itself may narrow them.
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
    target_distance: float = 0.050  # from the arm to a target [m]
    target_turn_deg: float = 35.0  # from the arm to a target, in the insertion runner [°]
    target_turn_driver_deg: float = 20.0  # the same for the EGM driver used without a lab file [°]
    reference_lead: float = 2e-3  # of the reference over the measured pose [m]
    reference_turn_lead_deg: float = 1.0  # the same as an angle [°]

    # Workspace of the gripper about the taught hole.
    workspace_x: float = 0.016  # |x| [m]
    workspace_y: float = 0.016  # |y| [m]
    workspace_yaw_deg: float = 16.0  # |yaw| [°]
    workspace_tilt_deg: float = 1.0  # of the gripper's z axis [°]
    workspace_height: tuple[float, float] = (0.001, 0.060)  # of the part's lower face above the hole's floor [m]
    descent_depth: float = 1.5e-3  # below the start of an attempt [m]

    # Age of data that motion relies on.
    pose_age: float = 0.020  # then the arm holds [s]
    pose_silence: float = 0.100  # then the arm stops [s]
    image_age: float = 0.250  # [s]
    gripper_age: float = 0.500  # [s]
    target_lifetime: float = 0.100  # a target that is not renewed expires [s]
    longest_target_lifetime: float = 1.0  # [s]


LIMITS = MotionLimits()
