"""`gelflow eval TASK`: success of a policy in simulation, compared with an oracle and with random actions."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table

from gelflow.cli.commands.training.task_training import TASKS, refuse, task_options
from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import (
    DEFAULT_RANDOMIZATION,
    add_checkpoint,
    add_json,
    add_out,
    add_part,
    add_preset,
    add_randomization,
    add_seed,
    check_at_least,
    checkpoint_for,
    part_task,
)
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult
    from gelflow.policies.networks.base import Network
    from gelflow.sim.tasks.task_batch import TaskBatch


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=list(TASKS), help="task of the policy")
    add_part(parser)
    add_randomization(parser, default=None, text="of the training; of the insertion: default")
    add_checkpoint(parser, default="the included insertion policy")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="episodes (default %(default)s)")
    parser.add_argument("--envs", type=int, default=64, metavar="N", help="parallel environments (default %(default)s)")
    add_seed(parser, default=1)
    add_preset(parser)
    add_out(parser, "folder for tables, films of a success and a failure, and where failures lie", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate the policy, the oracle and random actions, then print a table; with --out, films and failures too."""
    check_at_least(args, envs=1, episodes=1, seed=0)
    if args.task != "insertion":
        refuse(args, part=None)
    path, network, batch = _insertion(args) if args.task == "insertion" else _recipe_task(args)
    from gelflow.policies.reports.evaluation_report import evaluate_all

    with progress_bar() as progress:
        bar = progress.add_task("evaluating", total=None)
        report = evaluate_all(
            network,
            batch,
            episodes=args.episodes,
            seed=args.seed,
            out=args.out,
            started=lambda name: progress.update(bar, description=f"evaluating: {name}"),
        )
    output = Output(args.json)
    if output.json:
        rows = [result.to_json() for result in report.results]
        failures = [entry.to_json() for entry in report.failures]
        output.result(
            {"task": args.task, "checkpoint": path, "results": rows, "failures": failures, "files": report.files}
        )
    else:
        output.console.print(result_table(report.results, args.task, path, args.episodes))
    for line in report.worst_ranges():
        output.text(line)
    for file in report.files:
        output.text(f"wrote {file}")
    if report.error is not None:
        raise report.error
    return SUCCESS


def _insertion(args: argparse.Namespace) -> "tuple[Path, Network, TaskBatch]":
    """Checkpoint, network and environments of the insertion."""
    from gelflow.policies.checkpoint import load_policy

    task = part_task(args.part)
    path = checkpoint_for(task, args.checkpoint)
    network = load_policy(path, task=task).network
    from gelflow.sim.tasks.registry import make_task

    options = {"preset": args.preset, "randomization": args.randomization or DEFAULT_RANDOMIZATION}
    return path, network, make_task("insertion", min(args.envs, args.episodes), task=task, **options)


def _recipe_task(args: argparse.Namespace) -> "tuple[Path, Network, TaskBatch]":
    """Checkpoint, network and environments of a task that a recipe trains, as in the training unless options differ."""
    if args.checkpoint is None:
        raise UsageError(f"eval {args.task} requires --checkpoint FILE; create one with: gelflow train {args.task}")
    from gelflow.policies import recipes
    from gelflow.policies.checkpoint import load_checkpoint, load_network

    training = load_checkpoint(args.checkpoint).training
    options = {**training.get("options", {}), **task_options(args)}
    if args.randomization is not None:  # "default" too
        options["randomization"] = args.randomization
    recipe = recipes.recipe_for(args.task, training.get("recipe", recipes.DEFAULT))
    batch = recipe.make_task(min(args.envs, args.episodes), **options)
    return args.checkpoint, load_network(args.checkpoint, task=batch.description), batch


def result_table(results: "list[EvaluationResult]", task: str, path: Path, episodes: int) -> Table:
    """The results as a table, one row each; `episodes` is their number, `path` the checkpoint."""
    unit = results[0].length_unit
    title = f"{task} in simulation: {episodes} episodes, {path.name}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    headings = ("actions", "success", "95 % interval", unit, "return", *results[0].metrics)
    rows = [_cells(result) for result in results]
    for column, heading in enumerate(headings):
        word = max(len(text) for row in rows for text in row[column].split())  # numbers are never cut off
        table.add_column(heading, justify="left" if column == 0 else "right", min_width=word)
    for row in rows:
        table.add_row(*row)
    return table


def _cells(result: "EvaluationResult") -> list[str]:
    low, high = result.confidence_interval()
    length = f"{result.length:.2f}" if result.successes else "none"
    metrics = [f"{value:.2f}" for value in result.metrics.values()]
    interval = f"{low:.1%} to {high:.1%}"
    return [result.name, f"{result.success:.1%}", interval, length, f"{result.reward:.1f}", *metrics]
