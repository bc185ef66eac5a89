"""`gelflow reproduce TASK`: train and evaluate the paper's experiments again, beside the paper's own figures."""

import argparse
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.progress import TimeElapsedColumn
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_quick, add_seed, check_at_least
from gelflow.cli.output import Output, progress_bar

TASKS = ("grasp", "pushing", "cap", "insertion")  # those of `gelflow.policies.reproduction`, which is slow to import


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=[*TASKS, "all"], help="task, or all of them one after another")
    parser.add_argument(
        "--seeds", type=int, metavar="N", help="trainings of each variant (default: 3, for a short run 1)"
    )
    add_seed(parser)
    add_quick(parser)
    add_out(parser, "folder of trainings and results (default runs/reproduce); the same command continues", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Do what is missing in the folder, then write and print the rows of each task."""
    check_at_least(args, seeds=1, seed=0)
    count = args.seeds or (1 if args.quick else 3)
    out = args.out or Path("runs") / ("reproduce_quick" if args.quick else "reproduce")
    from gelflow.policies.reproduction import picture
    from gelflow.policies.reproduction.record import reproduce
    from gelflow.policies.reproduction.trials import Effort
    from gelflow.policies.reproduction.variants import reproduction_for
    from gelflow.session.records import to_plain

    output = Output(args.json)
    seeds = tuple(range(args.seed, args.seed + count))
    effort = Effort(seeds, shorter=100, max_episodes=32) if args.quick else Effort(seeds)
    records, files = [], []
    for task in TASKS if args.task == "all" else (args.task,):
        with progress_bar(TimeElapsedColumn()) as progress:
            bar = progress.add_task(task, total=1.0)

            def report(variant: str, seed: int, text: str, part: float) -> None:
                progress.update(bar, completed=part, description=f"{task}, {variant}, seed {seed}: {text}")  # noqa: B023

            record = reproduce(
                reproduction_for(task), out / task, effort=effort, command=_command(args, task, count), report=report
            )
        records.append(record)
        files += [out / f"reproduce_{task}.json", out / f"reproduce_{task}.png"]
        files[-2].write_text(json.dumps(to_plain(record), indent=1) + "\n", "utf-8")
        picture.draw(record, files[-1])
        output.console.print(_table(record))
    for file in files:
        output.text(f"wrote {file}")
    output.result({"records": records, "files": files})
    return SUCCESS


def _command(args: argparse.Namespace, task: str, seeds: int) -> list[str]:
    """The command that repeats the reproduction of a task; its folder is of no importance."""
    quick = ["--quick"] if args.quick else []
    return shlex.split(f"gelflow reproduce {task} --seeds {seeds} --seed {args.seed}") + quick


def _table(record: Mapping[str, Any]) -> Table:
    from gelflow.policies.reproduction.record import length_of

    unit = length_of(record["variants"][0]["ours"])[0]
    table = Table(title=f"{record['task']}: success [%] ± deviation over the seeds, {unit} in parentheses")
    last = "return" if record["curve"] == "reward" else "95 % of these\npolicies"
    for heading in ("variant", "ours", "paper", "oracle", "random", last, "min"):
        table.add_column(heading, justify="left" if heading == "variant" else "right")
    for variant in record["variants"]:
        ours, paper, minutes = variant["ours"], variant["paper"], variant["training_minutes"]
        others = [variant.get(name) for name in ("oracle", "random")]
        table.add_row(
            variant["name"],
            _cell(ours["success"], ours["success_deviation"], length_of(ours)[1]),
            "" if paper is None else _cell(paper["success"], paper["spread"], paper["length"]),
            *("-" if row is None else _cell(row["success"], None, length_of(row)[1]) for row in others),
            f"{ours['reward']:.1f}"
            if last == "return"
            else " to ".join(f"{100 * bound:.1f}" for bound in ours["success_95"]),
            f"{sum(minutes) / len(minutes):.1f}" if variant["trained_as"] is None else "",
        )
    return table


def _cell(success: float, deviation: float | None, length: float | None) -> str:
    text = f"{100 * success:.1f}" + ("" if deviation is None else f" ± {100 * deviation:.1f}")
    return text + ("" if length is None else f" ({length:.2f})")
