"""The lab file's content for a running mock robot."""

import math
from typing import TYPE_CHECKING, cast

from gelflow.real.runner import lab

if TYPE_CHECKING:
    from gelflow.hardware_mocks.robot import MockRobot

# Mock robot and runner share one computer, whose scheduling jitter does not shrink when the clock is scaled. In wall
# time the limits are therefore this many times those of a robot.
_TIMEOUT_SCALE = 12


def lab_for(robot: "MockRobot") -> lab.Lab:
    """Addresses, calibration, taught poses and time limits of `robot`."""
    cell = robot.config.cell
    factor, time_sync = robot.clock.settings
    return lab.Lab(
        gripper=lab.GripperSettings(
            address=robot.gripper.addresses[0],
            grasp_force=12.0,
            part_width=0.035,
            open_width=0.06,
            speed=0.05,
            home_at_start=True,
        ),
        # EGM's own limit is 1°/s per joint: the arm could not follow faster references.
        arm=lab.ArmSettings(
            egm_port=robot.config.egm_port, host=robot.config.host, max_speed=5e-3, max_turn_speed_deg=0.9
        ),
        cameras=lab.CamerasSettings(_camera(robot, 0), _camera(robot, 1)),
        tool=lab.ToolSettings(
            cast("lab.Vector", tuple(cell.tool.position.tolist())),
            cast("tuple[float, float, float, float]", tuple(cell.tool.quaternion.tolist())),
        ),
        hole=lab.HoleSettings(cast("lab.Vector", tuple(cell.hole.position.tolist())), math.degrees(cell.hole.yaw)),
        part=lab.PartSettings(
            grasp_height=cell.grasp_height, load_height=cell.load_height, presentation="wait", load_wait=1.0
        ),
        limits=_limits(_TIMEOUT_SCALE * max(1.0, factor)),
        clock_factor=factor,
        time_sync=time_sync,
    )


def _camera(robot: "MockRobot", finger: int) -> lab.CameraSettings:
    grid, look = robot.config.cell.grid, robot.config.look
    return lab.CameraSettings(
        source=robot.cameras[finger].url,
        rows=grid.rows,
        cols=grid.cols,
        pitch_mm=grid.pitch,
        pixels_per_mm=look.pixels_per_mm,
        center_mm=grid.center,
        rotation_deg=robot.config.rotations[finger],
        mirrored=look.mirrored,
    )


def _limits(scale: float) -> lab.LimitsSettings:
    return lab.LimitsSettings(
        stale_pose=0.020 * scale,
        stale_frame=0.250 * scale,
        stale_gripper=0.500 * scale,
        target_lifetime=min(1.0, 0.100 * scale),
        gripper_reply=1.0 * scale,
        gripper_motion=6.0 * scale,
        attempt_time=60.0 * scale,
    )
