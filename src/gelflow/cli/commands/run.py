"""`gelflow run insertion`: the insertion policy on the robot that a lab file describes, or on the mock robot."""

import argparse
import datetime
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from gelflow.errors import UsageError
from gelflow.task import INSERTION

if TYPE_CHECKING:
    from gelflow.real.runner.insertion_runner import Attempt, Insertion
    from gelflow.real.runner.motion_executor import MotionExecutor
    from gelflow.real.runner.preflight import PreflightItem
    from gelflow.real.runner.run_plan import RunPlan


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job", choices=("insertion",), help="what to run")
    parser.add_argument("--lab", type=Path, required=True, metavar="FILE", help="the lab file (docs/guide/robot.md)")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="the policy; default: gelflow's own")
    parser.add_argument("--insertions", type=int, default=1, metavar="N", help="how many parts (default 1)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the recording (default sessions/DATE-TIME)")
    parser.add_argument("--dry-run", action="store_true", help="connect, check and read; send no motion")


def run(args: argparse.Namespace) -> int:
    from gelflow.policies.checkpoint import default_checkpoint, load_policy
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.run_plan import RunPlan, run_insertions

    if args.insertions < 1:
        raise UsageError(f"--insertions must be at least 1, got {args.insertions}")
    # The default of 5 ms lets a computing thread keep those waiting that watch gripper and cameras.
    sys.setswitchinterval(5e-4)
    console = Console(highlight=False)
    lab = load_lab(args.lab)
    checkpoint = args.checkpoint or default_checkpoint()
    policy = load_policy(checkpoint, task=INSERTION)
    out = args.out or Path("sessions") / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    session = out / "session.mcap"
    plan = RunPlan(
        lab=lab,
        policy=policy,
        task=INSERTION,
        session=session,
        checkpoint=checkpoint,
        insertions=args.insertions,
        operator=(lambda motion: _Prompt(console, motion)) if lab.part.presentation == "prompt" else None,
        on_preflight=lambda items: console.print(preflight_table(items), ATTEMPT_HEADER, sep="\n"),
        on_attempt=lambda number, attempt: console.print(attempt_line(number, attempt), markup=False),
    )
    if args.dry_run:
        return _dry_run(console, plan)
    results = run_insertions(plan)
    console.print(_table(results))
    console.print(f"recorded: {session}; replay it with: gelflow replay {session}", markup=False, soft_wrap=True)
    return 0 if all(result.inserted for result in results) else 1


def preflight_table(items: "list[PreflightItem]") -> Table:
    """What was checked before anything moved."""
    table = Table(title="Preflight", show_header=False, box=None)
    for item in items:
        table.add_row("[green]ok[/]" if item.good else "[red]no[/]", item.name, item.text)
    return table


ATTEMPT_HEADER = "  part  try   x [mm]   y [mm]  yaw [°]  depth [mm]  shear [mm]"


def attempt_line(number: int, attempt: "Attempt") -> str:
    """One attempt in one line, under `ATTEMPT_HEADER`."""
    x, y, yaw = attempt.planar_pose
    where = f"{1e3 * x:+9.1f}{1e3 * y:+9.1f}{math.degrees(yaw):+9.1f}"
    felt = f"{1e3 * attempt.depth:12.2f}{attempt.shear:12.3f}"
    outcome = (
        "in the hole" if attempt.inserted else "stopped by touch" if attempt.stopped_by_contact else "not in the hole"
    )
    return f"{number + 1:6d}{attempt.number + 1:5d}{where}{felt}  {outcome}"


def _table(results: "list[Insertion]") -> Table:
    table = Table(title="Insertions, as the robot sees them")
    for name in ("part", "attempts", "outcome", "time [s]"):
        table.add_column(name, justify="left" if name == "outcome" else "right")
    for result in results:
        count = str(len(result.attempts))
        table.add_row(str(result.number + 1), count, result.outcome, f"{result.duration:.0f}")
    return table


def _dry_run(console: Console, plan: "RunPlan") -> int:
    from gelflow.real.runner.run_plan import dry_run

    found = dry_run(plan)
    console.print(preflight_table(found.items))
    console.print("targets of a run, checked: " + "; ".join(found.targets), markup=False)
    flow = f"largest shear at rest: {found.observation.divisor:.3f} {found.observation.unit}, at least the floor"
    console.print(f"{flow}; the policy would answer {found.action.round(5).tolist()} [m, m, rad]", markup=False)
    console.print("dry run: nothing was moved.")
    return 0


class _Prompt:
    """A person at the terminal hands the parts over."""

    def __init__(self, console: Console, motion: "MotionExecutor") -> None:
        self._console, self._motion = console, motion

    def present(self, number: int) -> None:
        self._ask(f"Hold part {number + 1} between the fingers, then press Enter.")

    def take(self, number: int) -> None:
        self._ask(f"Part {number + 1} could not be inserted. Hold it, then press Enter: the fingers will open.")

    def _ask(self, text: str) -> None:
        try:
            self._console.input(f"[bold]{text}[/] ")
        except EOFError:
            raise UsageError('the lab file says presentation = "prompt", but nobody can press Enter here') from None
        self._motion.wait(0.0)
