"""`gelflow robot`: state of the devices, and manual actions after a stop. Each of them asks before anything moves."""

import argparse
import contextlib
import datetime
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.table import Table

from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.options import add_json, add_out
from gelflow.cli.output import Output, yes_or_no
from gelflow.cli.prompt import confirmed
from gelflow.cli.stop_hint import with_lab_option
from gelflow.errors import GelflowError, UsageError
from gelflow.interrupts import interruptible

if TYPE_CHECKING:
    from gelflow.real.runner.manual.jog import Axis, Jog
    from gelflow.real.runner.manual.question import Session
    from gelflow.real.runner.motion_executor import MotionExecutor

_ACTIONS = {
    "status": "print the state of arm, gripper and cameras; sends no motion",
    "home": "home the fingers outwards",
    "open": "open the fingers and release the part",
    "acknowledge": "acknowledge the fault of the gripper",
    "jog": "move the gripper by a bounded distance or angle, or to the hand-over",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Sub-commands and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, text in _ACTIONS.items():
        sub = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == "jog":
            sub.add_argument("axis", nargs="?", choices=("x", "y", "z", "yaw"), help="axis of the gripper; z is up")
            sub.add_argument("amount", nargs="?", type=float, help="distance in mm, or angle in degrees for yaw")
            sub.add_argument("--to", choices=("load",), help="move to the hand-over above the taught hole")
        sub.add_argument("--lab", type=Path, required=True, metavar="FILE", help="lab file (docs/guide/robot.md)")
        if name != "status":
            sub.add_argument("--yes", action="store_true", help="do not ask: every question is answered with yes")
            sub.add_argument("--dry-run", action="store_true", help="connect and check; send nothing that moves")
            add_out(sub, "folder of the recording (default sessions/DATE-TIME-robot-ACTION)", folder=True)
        add_json(sub)


def run(args: argparse.Namespace) -> int:
    """Run the action. A negative result: a device is not ready, or the operator did not agree."""
    output = Output(args.json)
    if args.action == "status":
        return _status(args, output)
    action = _manual_action(args)
    try:
        with _session(args, output) as session:
            result = action(session)
    except GelflowError as error:
        error.args = (with_lab_option(str(error), args.lab),)
        raise
    text = "done" if result["done"] else "nothing was sent" if args.dry_run else "not agreed: nothing more was moved"
    output.text(f"{args.action}: {text}")
    output.result({"action": args.action, "dry_run": args.dry_run, **result})
    return SUCCESS if result["done"] or args.dry_run else NEGATIVE_RESULT


def _status(args: argparse.Namespace, output: Output) -> int:
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.manual.status import read_status

    lab = load_lab(args.lab)
    with interruptible():  # the gripper takes a disconnect without announcement for a fault
        devices = read_status(lab)
    table = Table(title="State of the robot", show_header=False, box=None)
    for name, values in devices.items():
        table.add_row(yes_or_no(values["ready"]), name, values["text"])
    output.console.print(table)
    ready = all(values["ready"] for values in devices.values())
    output.result({"action": "status", "ready": ready, **devices})
    return SUCCESS if ready else NEGATIVE_RESULT


def _manual_action(args: argparse.Namespace) -> "Callable[[Session], dict[str, Any]]":
    from gelflow.real.runner.manual.gripper_actions import acknowledge, home, open_fingers
    from gelflow.real.runner.manual.jog import jog

    if args.action == "jog":
        wanted = _wanted_jog(args)
        return lambda session: jog(session, wanted)
    return {"home": home, "open": open_fingers, "acknowledge": acknowledge}[args.action]


def _wanted_jog(args: argparse.Namespace) -> "Jog":
    from gelflow.real.runner.manual.jog import Jog

    if (args.to is None) == (args.axis is None) or (args.axis is None) != (args.amount is None):
        raise UsageError("give an axis and an amount, such as z +10 or yaw -2, or --to load; upward is z +")
    if args.to is not None:
        return Jog("load")
    return Jog(cast("Axis", args.axis), math.radians(args.amount) if args.axis == "yaw" else 1e-3 * args.amount)


@contextlib.contextmanager
def _session(args: argparse.Namespace, output: Output) -> "Iterator[Session]":
    """The lab, the recording and the operator of one action; signals hold the arm and end it."""
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.manual.question import Session
    from gelflow.session.recorder import SessionRecorder

    lab = load_lab(args.lab)
    clock = lab.clock

    def ask(question: str, check: Callable[[], object]) -> bool:
        if not args.yes:
            return confirmed(output.console, question, check=check)
        output.text(f"{question} yes (--yes)")
        check()
        return True

    with contextlib.ExitStack() as stack:
        at_once = stack.enter_context(interruptible())
        recorder = None
        if not args.dry_run:
            stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
            folder = args.out or Path("sessions") / f"{stamp}-robot-{args.action}"
            recorder = SessionRecorder(folder / "session.mcap", clock, max_delay=lab.limits.recording_delay)
            stack.enter_context(recorder.open())
            recorder.metadata({"manual": args.action, "lab": lab.to_json()})

        def on_motion(motion: "MotionExecutor") -> None:
            at_once.append(motion.hold)

        yield Session(lab, clock, recorder, ask, attended=not args.yes, say=output.text, on_motion=on_motion)
