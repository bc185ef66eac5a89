"""`gelflow run insertion`: run the insertion policy, or a motion plan, on the robot of a lab file or the mock robot."""

import argparse
import dataclasses
import datetime
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.insertion_text import (
    ATTEMPT_HEADER,
    attempt_line,
    insertion_table,
    insertion_to_json,
    preflight_table,
)
from gelflow.cli.options import (
    add_checkpoint,
    add_json,
    add_out,
    add_part,
    add_view,
    check_at_least,
    check_page_address,
    checkpoint_for,
    part_task,
)
from gelflow.cli.output import Output
from gelflow.cli.prompt import read_line
from gelflow.cli.stop_hint import hint_after_stop
from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.interrupts import interruptible
from gelflow.protocols import Policy
from gelflow.session.motion_plan import load_motion_plan
from gelflow.task import InsertionTask

if TYPE_CHECKING:
    from gelflow.real.runner.lab import Lab
    from gelflow.real.runner.motion_executor import MotionExecutor
    from gelflow.real.runner.preflight import PreflightItem
    from gelflow.real.runner.run_plan import RunPlan

_CLOSED = "standard output was closed, which stopped the run"


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=("insertion",), help="task to run")
    parser.add_argument("--lab", type=Path, required=True, metavar="FILE", help="lab file (docs/guide/robot.md)")
    add_part(parser)
    add_checkpoint(parser)
    parser.add_argument("--insertions", type=int, default=1, metavar="N", help="number of parts (default %(default)s)")
    parser.add_argument(
        "--plan", type=Path, metavar="FILE", help="make the motions of gelflow calibrate --plan on each part, no policy"
    )
    add_view(parser)
    parser.add_argument("--dry-run", action="store_true", help="connect, check and read; send no motion")
    add_out(parser, "folder of the recording (default sessions/DATE-TIME)", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Run the insertions and print each attempt. A negative result: a part not inserted, a plan not completed."""
    from gelflow.cli.live_page import live_page, motion_observer
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.run_plan import RunPlan, run_insertions

    check_at_least(args, insertions=1)
    check_page_address(args, "view")
    # With the default of 5 ms a computing thread delays the threads of gripper and cameras.
    sys.setswitchinterval(5e-4)
    output = Output(args.json)
    lab = load_lab(args.lab)
    task = part_task(args.part)
    policy, checkpoint = _policy(args, task, lab)
    out = args.out or Path("sessions") / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    session = out / "session.mcap"
    warnings: list[str] = []
    plan = RunPlan(
        lab=lab,
        policy=policy,
        task=task,
        session=session,
        checkpoint=checkpoint,
        insertions=args.insertions,
        operator=(lambda motion: _Prompt(output.console, motion)) if lab.part.presentation == "prompt" else None,
        on_attempt=lambda number, attempt: output.text(attempt_line(number, attempt)),
        on_warning=warnings.append,
    )
    if args.dry_run:
        if args.view:
            raise UsageError("--view shows a run, and --dry-run moves nothing; leave one of them out")
        with interruptible():
            return _dry_run(output, plan)
    passed = False

    def on_preflight(items: "list[PreflightItem]") -> None:
        nonlocal passed
        passed = True
        output.console.print(preflight_table(items), ATTEMPT_HEADER, sep="\n")

    with live_page(args, output) as view, interruptible() as at_once:
        if view is not None:
            view.show(session)
        try:
            plan = dataclasses.replace(plan, on_motion=motion_observer(view, at_once))
            results = run_insertions(dataclasses.replace(plan, on_preflight=on_preflight))
        except (GelflowError, BrokenPipeError) as caught:
            error = caught if isinstance(caught, GelflowError) else PeerError(_CLOSED)
            if hint := hint_after_stop(str(error), args.lab, moved=passed):
                error.add_note(hint)
            raise error from None
    output.console.print(insertion_table(results))
    for line in warnings:
        output.text(f"warning: {line}")
    name = shlex.quote(str(session))
    then = f"replay it with: gelflow replay {name}" if args.plan is None else f"then: gelflow calibrate {name}"
    output.text(f"recorded: {session}; {then}")
    insertions = [insertion_to_json(result) for result in results]
    output.result({"session": session, "insertions": insertions, "warnings": warnings})
    return SUCCESS if all(result.successful for result in results) else NEGATIVE_RESULT


def _policy(args: argparse.Namespace, task: InsertionTask, lab: "Lab") -> tuple[Policy, Path | None]:
    """The policy of the run and its checkpoint; a plan has none. Raises UsageError."""
    from gelflow.policies.checkpoint import load_policy
    from gelflow.real.runner.insertion.planned_motions import PlanPolicy, check_motions

    if args.plan is not None:
        if args.checkpoint is not None:
            raise UsageError("--plan replaces the policy of --checkpoint; leave one of them out")
        motions = load_motion_plan(args.plan)
        check_motions(motions, lab, task)
        return PlanPolicy(motions), None
    checkpoint = checkpoint_for(task, args.checkpoint)
    return load_policy(checkpoint, task=task), checkpoint


def _dry_run(output: Output, plan: "RunPlan") -> int:
    from gelflow.real.runner.run_plan import dry_run

    made = dry_run(plan)
    output.console.print(preflight_table(made.items))
    output.text("checked targets of a run: " + "; ".join(made.targets))
    flow = f"divisor of the flow map at rest: {made.observation.divisor:.3f} {made.observation.unit}"
    output.text(f"{flow}; correction of the policy: {made.correction.round(5).tolist()} [m, m, rad]")
    output.text("dry run: nothing was moved.")
    output.result(
        {
            "session": plan.session,
            "preflight": made.items,
            "targets": made.targets,
            "divisor": made.observation.divisor,
            "unit": made.observation.unit,
            "correction": made.correction,
        }
    )
    return SUCCESS


class _Prompt:
    """Operator that hands over the parts and confirms at the terminal."""

    def __init__(self, console: Console, motion: "MotionExecutor") -> None:
        self._console, self._motion = console, motion

    def present(self, number: int) -> None:
        self._ask(f"Hold part {number + 1} between the fingers, then press Enter.")

    def take(self, number: int) -> None:
        self._ask(f"Part {number + 1} could not be inserted. Hold it, then press Enter: the fingers will open.")

    def _ask(self, text: str) -> None:
        # A stopped arm, an old image or a gripper fault ends the run at once, and not when Enter is pressed.
        read_line(self._console, text, check=lambda: self._motion.wait(0.0))
