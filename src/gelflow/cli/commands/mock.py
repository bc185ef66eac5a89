"""`gelflow mock`: start the mock robot with its network protocols, and write a lab file for it."""

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, cast

from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_part, add_preset, add_seed, check_at_least, part_task
from gelflow.cli.output import Output
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.hardware_mocks.robot import MockRobot, Rotation

_LAB_TITLE = "Written by gelflow mock for the running mock robot."


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--factor", type=float, default=1.0, metavar="X", help="robot time over wall time (default 1)")
    parser.add_argument("--egm-port", type=int, default=6510, metavar="PORT", help="UDP port of the EGM client (6510)")
    parser.add_argument("--tcp-port", type=int, default=0, metavar="PORT", help="port of the gripper (0: a free one)")
    parser.add_argument(
        "--truth-port", type=int, default=0, metavar="PORT", help="port of the true state over HTTP (0: a free one)"
    )
    for side in ("left", "right"):
        text = f"clockwise rotation of the {side} camera's image: 0, 90, 180 or 270 (default 0)"
        parser.add_argument(f"--turn-{side}", type=int, choices=(0, 90, 180, 270), default=0, metavar="DEG", help=text)
    parser.add_argument(
        "--world",
        type=Path,
        metavar="FILE",
        help="TOML file of a world that differs from training (docs/guide/mock.md)",
    )
    parser.add_argument("--faults", type=Path, metavar="FILE", help="TOML file of a fault plan (docs/guide/mock.md)")
    parser.add_argument(
        "--jitter",
        type=float,
        metavar="S",
        help="time limits of the lab file: those of a robot plus S seconds (default: twelve times as long)",
    )
    add_part(parser)
    parser.add_argument("--attached", action="store_true", help="end when standard input is closed")
    add_seed(parser)
    add_preset(parser)
    add_out(parser, "write a lab file for this mock robot")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Run the mock robot until Ctrl-C, SIGTERM, or with --attached the end of standard input."""
    from gelflow.hardware_mocks.faults.plan import FaultPlan
    from gelflow.hardware_mocks.faults.plan_file import load_fault_plan
    from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
    from gelflow.hardware_mocks.simulated_cell.cell import preset_config
    from gelflow.hardware_mocks.simulated_cell.world import load_world
    from gelflow.mock_lab.lab import lab_for
    from gelflow.real.runner.lab_file import save_lab

    check_at_least(args, seed=0, jitter=0)
    if args.out is not None:
        _check_replaceable(args.out)
    task = part_task(args.part)
    world = load_world(args.world, task.part) if args.world is not None else None
    config = MockRobotConfig(
        cell=preset_config(args.preset, seed=args.seed, world=world, task=task),
        egm_port=args.egm_port,
        tcp_port=args.tcp_port,
        truth_port=args.truth_port,
        faults=load_fault_plan(args.faults) if args.faults is not None else FaultPlan(),
        rotations=(cast("Rotation", args.turn_left), cast("Rotation", args.turn_right)),
    )
    # With the default of 5 ms one busy thread delays the 4 ms cycles of the others.
    sys.setswitchinterval(5e-4)
    with MockRobot(args.factor, config) as robot:
        if args.out is not None:
            save_lab(lab_for(robot, jitter=args.jitter), args.out, title=_LAB_TITLE)
        _show(Output(args.json), robot, args.out)
        _wait_for_end(robot, attached=args.attached)
    return SUCCESS


def _check_replaceable(path: Path) -> None:
    """Raise UsageError when `path` exists and is not the lab file of an earlier mock robot."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            first = file.readline().strip()
    except FileNotFoundError:
        return
    except OSError as error:
        raise UsageError(f"cannot replace {path}: {error.strerror}; name another file with --out") from None
    if first != f"# {_LAB_TITLE}":
        raise UsageError(f"{path} exists, and gelflow mock did not write it; name another file with --out")


def _wait_for_end(robot: "MockRobot", *, attached: bool) -> None:
    """Wait for Ctrl-C, or until a process of the robot has ended; `MockRobot.stop` then raises the reason."""
    ending = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ending.set()

    def wait_for_end_of_input() -> None:
        while sys.stdin.buffer.read(4096):
            pass
        ending.set()

    if attached:
        threading.Thread(target=wait_for_end_of_input, daemon=True).start()
    # Signals that were ignored, as by nohup, stay ignored.
    signals = [n for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, end) for number in signals}
    try:
        while robot.running and not ending.wait(0.5):
            pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _show(output: Output, robot: "MockRobot", lab_file: Path | None) -> None:
    arm = f"{robot.config.host}:{robot.config.egm_port}"
    cameras = [camera.url for camera in robot.cameras]
    if output.json:
        output.result(
            {
                "gripper": robot.gripper.addresses,
                "arm": arm,
                "cameras": cameras,
                "truth": robot.truth_url,
                "lab_file": lab_file,
            }
        )
        sys.stdout.flush()  # the command goes on until it is ended
        return
    table = Table(title="Mock robot", show_header=False, box=None)
    for address in robot.gripper.addresses:
        table.add_row("gripper", address)
    table.add_row("arm", f"EGM over UDP to {arm}")
    for name, url in zip(("left camera", "right camera"), cameras, strict=True):
        table.add_row(name, url)
    table.add_row("true state", f"{robot.truth_url} (GET; POST ?seed=N chooses the next part)")
    if lab_file is not None:
        table.add_row("lab file", str(lab_file))
    output.console.print(table)
    output.text("Ctrl-C ends it.")
