"""`gelflow mock`: the mock robot on the wire, for any client; writes the lab file that fits it."""

import argparse
import math
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, cast

from rich.console import Console
from rich.table import Table

from gelflow.cli.presets import PRESET_HELP

if TYPE_CHECKING:
    from gelflow.hardware_mocks.robot import MockRobot, Rotation
    from gelflow.real.runner.lab import Lab


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--lab-out", type=Path, metavar="FILE", help="write the lab file for this mock robot")
    parser.add_argument("--factor", type=float, default=1.0, help="robot time over wall time (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the first part's misalignment; later ones follow on")
    parser.add_argument("--preset", metavar="NAME", help=PRESET_HELP)
    parser.add_argument("--egm-port", type=int, default=6510, metavar="PORT", help="UDP port of the client (6510)")
    parser.add_argument("--tcp-port", type=int, default=0, metavar="PORT", help="of the gripper; 0 takes a free one")
    parser.add_argument("--truth-port", type=int, default=0, metavar="PORT", help="of the side channel with the truth")
    for side in ("left", "right"):
        text = f"the {side} camera's image is turned clockwise by this: 0, 90, 180 or 270 (default 0)"
        parser.add_argument(f"--turn-{side}", type=int, choices=(0, 90, 180, 270), default=0, metavar="DEG", help=text)
    parser.add_argument("--attached", action="store_true", help="end when standard input is closed")


def run(args: argparse.Namespace) -> int:
    from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
    from gelflow.hardware_mocks.simulated_cell.cell import preset_config
    from gelflow.real.runner.lab_file import save_lab

    config = MockRobotConfig(
        cell=preset_config(args.preset, seed=args.seed),
        egm_port=args.egm_port,
        tcp_port=args.tcp_port,
        truth_port=args.truth_port,
        rotations=(cast("Rotation", args.turn_left), cast("Rotation", args.turn_right)),
    )
    ending = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ending.set()

    # The default of 5 ms lets one busy thread keep the others' 4 ms cycles waiting.
    sys.setswitchinterval(5e-4)
    with MockRobot(args.factor, config) as robot:
        lab = lab_for(robot)
        if args.lab_out is not None:
            save_lab(lab, args.lab_out, title="Written by gelflow mock: fits the mock robot that is running.")
        _tell(robot, args.lab_out)
        if args.attached:
            threading.Thread(target=_wait_for_end_of_input, args=(ending,), daemon=True).start()
        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            while not ending.wait(0.5):
                pass
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    return 0


def lab_for(robot: "MockRobot") -> "Lab":
    """The lab file's content for a running mock robot."""
    from gelflow.real.runner import lab

    cell, look = robot.config.cell, robot.config.look
    factor, time_sync = robot.clock.settings
    # One computer plays robot and runner at once, and its jitter does not shrink when the clock is scaled: in wall time
    # the limits are twelve times those for a robot.
    scale = 12 * max(1.0, factor)

    def camera(finger: int) -> lab.CameraSettings:
        return lab.CameraSettings(
            source=robot.cameras[finger].url,
            rows=cell.grid.rows,
            cols=cell.grid.cols,
            pitch_mm=cell.grid.pitch,
            pixels_per_mm=look.pixels_per_mm,
            center_mm=cell.grid.center,
            rotation_deg=robot.config.rotations[finger],
            mirrored=look.mirrored,
        )

    def numbers(values: object) -> tuple[float, ...]:
        return tuple(float(v) for v in cast("list[float]", values))

    return lab.Lab(
        gripper=lab.GripperSettings(
            address=robot.gripper.addresses[0], grasp_force=12.0, part_width=0.035, open_width=0.06, speed=0.05,
            home_at_start=True,
        ),
        # EGM's own speed limit is 1°/s a joint: faster references would only run ahead of the arm.
        arm=lab.ArmSettings(
            egm_port=robot.config.egm_port, host=robot.config.host, max_speed=5e-3, max_turn_speed_deg=0.9
        ),
        cameras=lab.CamerasSettings(camera(0), camera(1)),
        tool=lab.ToolSettings(
            cast("lab.Vector", numbers(cell.tool.position)),
            cast("tuple[float, float, float, float]", numbers(cell.tool.quaternion)),
        ),
        hole=lab.HoleSettings(cast("lab.Vector", numbers(cell.hole.position)), math.degrees(cell.hole.yaw)),
        part=lab.PartSettings(
            grasp_height=cell.grasp_height, load_height=cell.load_height, presentation="wait", load_wait=1.0
        ),
        limits=lab.LimitsSettings(
            stale_pose=0.020 * scale,
            stale_frame=0.250 * scale,
            stale_gripper=0.500 * scale,
            target_lifetime=min(1.0, 0.100 * scale),
            gripper_reply=1.0 * scale,
            gripper_motion=6.0 * scale,
            attempt_time=60.0 * scale,
        ),
        clock_factor=factor,
        time_sync=time_sync,
    )  # fmt: skip


def _tell(robot: "MockRobot", lab_out: Path | None) -> None:
    console = Console(highlight=False)
    table = Table(title="Mock robot", show_header=False, box=None)
    for address in robot.gripper.addresses:
        table.add_row("gripper", address)
    table.add_row("arm", f"EGM over UDP to {robot.config.host}:{robot.config.egm_port}")
    for name, camera in zip(("left camera", "right camera"), robot.cameras, strict=True):
        table.add_row(name, camera.url)
    table.add_row("truth", f"{robot.truth_url} (GET; POST ?seed=N chooses the next part)")
    if lab_out is not None:
        table.add_row("lab file", str(lab_out))
    console.print(table)
    console.print("Ctrl-C ends it.")


def _wait_for_end_of_input(ending: threading.Event) -> None:
    while sys.stdin.buffer.read(4096):
        pass
    ending.set()
