"""`gelflow bench rolling`: how fast the simulator is on the ball rolling run."""

import argparse
import dataclasses
import json
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.sim.benchmark import Speed

SIDES = (10, 50, 200)
EVERY = (5, 20)


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("run", choices=["rolling"], help="what is timed: the ball rolling run, 350 steps of 5 ms")
    parser.add_argument(
        "--repeats", type=int, default=15, metavar="N", help="timed runs, of which the median counts (%(default)s)"
    )
    parser.add_argument("--friction", choices=["viscous", "elastic"], default="viscous", help="law (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print an array of objects instead of a table")


def run(args: argparse.Namespace) -> int:
    """Measure; prints a table, or JSON."""
    if args.repeats < 1:
        raise UsageError(f"--repeats must be at least 1, got {args.repeats}")
    from gelflow.sim.benchmark import processor, rolling_speed

    bar = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    errors = Console(stderr=True)  # what is piped out of the command stays clean
    with Progress(*bar, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task("timing", total=len(SIDES) * len(EVERY) * (args.repeats + 1))
        speeds = rolling_speed(
            sides=SIDES,
            every=EVERY,
            repeats=args.repeats,
            friction=args.friction,
            done=lambda: progress.advance(task),
        )
    if args.json:
        print(json.dumps([plain(speed) | {"friction": args.friction} for speed in speeds], indent=2))
    else:
        console = Console()
        console.print(_table(speeds, f"Ball rolling, {args.friction} friction, one thread of {processor()}"))
        console.print(
            f"Medians of {args.repeats} runs for each row, the rows taken in turn. per CPU s: steps per second of "
            "processor time. × paper: against the paper's own simulator on a comparable processor. Newton: iterations "
            "of Newton's method per step.",
            highlight=False,
        )
    return 0


def plain(speed: "Speed") -> dict[str, object]:
    """A measurement as what JSON can hold."""
    return dataclasses.asdict(speed) | {"ratio": speed.ratio}


def _table(speeds: "list[Speed]", title: str) -> Table:
    table = Table(title=title)
    for heading in ("markers", "read every", "steps/s", "quartiles", "per CPU s", "× paper", "Newton"):
        table.add_column(heading, justify="right", no_wrap=True)
    for speed in speeds:
        ratio = "" if speed.ratio is None else f"{speed.ratio:.1f}"
        low, high = speed.quartiles
        table.add_row(
            f"{speed.markers}",
            f"{speed.every}",
            f"{speed.steps_per_second:.0f}",
            f"[dim]{low:.0f}-{high:.0f}[/dim]",
            f"{speed.steps_per_cpu_second:.0f}",
            ratio,
            f"{speed.newton_iterations:.2f}",
        )
    return table
