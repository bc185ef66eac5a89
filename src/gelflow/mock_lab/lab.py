"""The lab file's content for a running mock robot."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from gelflow.gel.gel_file import save_gel
from gelflow.perception.camera_calibration import fit_calibration, save_calibration
from gelflow.perception.frames import CameraMount
from gelflow.real.limits import LIMITS, MOCK_TIME_SCALE
from gelflow.real.runner import lab

if TYPE_CHECKING:
    from gelflow.hardware_mocks.robot import MockRobot

# Additional factor of the time limit of recordings, which depends on the disk of this computer and not on the robot: a
# write may take some tenths of a second.
_DISK_FACTOR = 4

_VISIBLE_LINE = 0.3  # fraction of the dots of a visible line that are inside the image


def lab_for(robot: "MockRobot", *, jitter: float | None = None) -> lab.Lab:
    """Addresses, calibration, taught poses and time limits of `robot`.

    The time limits are those of a robot plus `jitter` [s, wall], or `MOCK_TIME_SCALE` times as long without it.
    """
    cell = robot.config.cell
    taught = cell.taught_hole
    factor, time_sync = robot.clock.settings
    return lab.Lab(
        gripper=lab.GripperSettings(
            address=robot.gripper.addresses[0],
            grasp_force=12.0,
            part_width=cell.task.part.grasp_width,
            open_width=cell.start_width,
            speed=0.05,
            home_at_start=True,
        ),
        # The speeds are the defaults of a lab file: the joint speed of the controller, 1 °/s, limits the motion.
        arm=lab.ArmSettings(
            egm_port=robot.config.egm_port,
            host=robot.config.host,
            connect_timeout=min(60.0, 5.0 * factor),
        ),
        cameras=lab.CamerasSettings(_camera(robot, 0), _camera(robot, 1)),
        tool=lab.ToolSettings(
            cast("lab.Vector", tuple(cell.tool.position.tolist())),
            cast("tuple[float, float, float, float]", tuple(cell.tool.quaternion.tolist())),
        ),
        hole=lab.HoleSettings(cast("lab.Vector", tuple(taught.position.tolist())), math.degrees(taught.yaw)),
        part=lab.PartSettings(
            grasp_height=cell.grasp_height, load_height=cell.load_height, presentation="wait", load_wait=1.0
        ),
        limits=_limits(MOCK_TIME_SCALE * factor)
        if jitter is None
        else _limits(1.0, jitter * factor, disk=_DISK_FACTOR * factor),
        clock_factor=factor,
        time_sync=time_sync,
    )


def _camera(robot: "MockRobot", finger: int) -> lab.CameraSettings:
    grid, view = robot.config.cell.grid, robot.config.cell.world.cameras[finger]
    scale: dict[str, Any] = {"pixels_per_mm": view.pixels_per_mm}
    visible = _visible_lines(robot, finger)
    if view.calibrated and (visible or not view.lens.ideal):
        scale = {"calibration": str(_write_calibration(robot, finger))}
    return lab.CameraSettings(
        source=robot.cameras[finger].url,
        rows=grid.rows,
        cols=grid.cols,
        pitch_mm=grid.pitch,
        center_mm=grid.center,
        rotation_deg=robot.config.rotations[finger],
        mirrored=True,
        gel=_write_gel(robot, finger),
        **scale,
        **visible,
    )


def _visible_lines(robot: "MockRobot", finger: int) -> dict[str, Any]:
    """The visible rows and columns of a grid that the image border cuts; empty for a grid that is entirely visible."""
    appearance, lens = robot.config.view(finger)
    grid = robot.config.cell.grid
    in_image = lens.apply(appearance.to_pixels(grid.positions()), appearance)
    limit = np.array([appearance.width, appearance.height]) - 1 - appearance.radius
    inside = np.all((in_image >= appearance.radius) & (in_image <= limit), axis=1).reshape(grid.rows, grid.cols)
    rows, cols = (np.flatnonzero(inside.mean(axis=axis) >= _VISIBLE_LINE) + 1 for axis in (1, 0))
    if (len(rows) == grid.rows and len(cols) == grid.cols) or min(len(rows), len(cols)) < 3:
        return {}
    return {"visible_rows": (int(rows[0]), int(rows[-1])), "visible_cols": (int(cols[0]), int(cols[-1]))}


def _write_calibration(robot: "MockRobot", finger: int) -> Path:
    """Calibrate a camera from its marker positions at rest, as `gelflow calibrate-camera` does from an image."""
    config = robot.config
    grid = config.cell.grid
    appearance, lens = config.view(finger)
    mount = CameraMount(grid.rows, grid.cols, grid.pitch, grid.center, config.rotations[finger])
    on_pad = lens.apply(appearance.to_pixels(grid.positions() + config.print_error(finger)), appearance)
    in_image = np.empty_like(on_pad)
    in_image[mount.marker_order()] = on_pad
    size = (appearance.width, appearance.height)
    inside = np.all((in_image >= 0) & (in_image <= np.array(size) - 1), axis=1)
    rows, cols = mount.image_grid
    fit = fit_calibration(in_image, inside, rows=rows, cols=cols, spacing_mm=grid.pitch, size=size)
    path = robot.folder / f"camera_{finger}.json"
    path.unlink(missing_ok=True)
    save_calibration(fit, path)
    return path


def _write_gel(robot: "MockRobot", finger: int) -> str:
    """The path of a new file with the true gel of a pad; empty for a world without a gel file."""
    gel = robot.config.cell.world.true_gel(finger)
    if gel is None:
        return ""
    path = robot.folder / f"gel_{finger}.toml"
    path.unlink(missing_ok=True)
    save_gel(gel, path)
    return str(path)


def _limits(scale: float, jitter: float = 0.0, *, disk: float = 1.0) -> lab.LimitsSettings:
    """Limits of a robot, `scale` times as long plus `jitter` [s, robot time]; `disk` multiplies that of recordings."""
    robot = lab.LimitsSettings()
    return lab.LimitsSettings(
        stale_pose=robot.stale_pose * scale + jitter,
        stale_frame=robot.stale_frame * scale + jitter,
        stale_gripper=robot.stale_gripper * scale + jitter,
        target_lifetime=min(LIMITS.longest_target_lifetime, robot.target_lifetime * scale + jitter),
        gripper_reply=robot.gripper_reply * scale + jitter,
        gripper_motion=robot.gripper_motion * scale + jitter,
        attempt_time=robot.attempt_time * scale + jitter,
        recording_delay=robot.recording_delay * scale * disk + jitter,
    )
