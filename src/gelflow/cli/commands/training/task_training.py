"""`gelflow train` and `gelflow eval` for the tasks that recipes train; the insertion has options of its own."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import TaskProgressColumn, TimeElapsedColumn
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import check_at_least
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult
    from gelflow.policies.training.run import Progress

DEFAULT_RECIPE = "default"
TASKS = ("cap", "grasp", "pushing")  # those of `gelflow.policies.recipes`, which is slow to import


def refuse(args: argparse.Namespace, **unset: object) -> None:
    """Raises UsageError for an option that only the insertion has; `unset` are the values without it."""
    for name, value in unset.items():
        if getattr(args, name, value) != value:
            raise UsageError(f"--{name.replace('_', '-')} is for the insertion, not for {args.task}")


def train_task(args: argparse.Namespace) -> int:
    """Train a policy with a progress bar, then print the result."""
    check_at_least(args, envs=1, seed=0)
    from gelflow.policies import recipes  # deferred: torch is slow to import

    recipe = recipes.recipe_for(args.task, args.recipe)
    steps = recipe.steps if args.attempts is None else args.attempts
    folder = args.out or Path("runs") / args.task
    output = Output(args.json)
    with progress_bar(TaskProgressColumn(), TimeElapsedColumn()) as progress:
        bar = progress.add_task("training", total=steps)

        def report(point: "Progress") -> None:
            numbers = "  ".join(f"{name} {value:.3g}" for name, value in list(point.numbers.items())[:2])
            progress.update(bar, completed=point.steps, description=numbers)
            if point.evaluation is not None:
                progress.console.print(
                    f"after {point.steps:>9,} steps, {point.minutes:5.1f} min: {_line(point.evaluation)}"
                )

        result = recipes.train(
            args.task,
            folder,
            recipe=args.recipe,
            seed=args.seed,
            steps=steps,
            envs=args.envs,
            minutes=float("inf") if args.minutes is None else args.minutes,
            options={} if args.preset is None else {"preset": args.preset},
            command=_command(args, steps, folder),
            report=report,
        )
    shares = ", ".join(f"{name} {share:.0%}" for name, share in result.shares.items())
    output.text(f"best on validation: {_line(result.best)}")
    output.text(f"{result.steps:,} steps in {result.minutes:.1f} min: {shares}")
    output.text(f"checkpoint {result.checkpoint}, progress and learning curve in {folder}")
    output.text(f"evaluate it with: gelflow eval {args.task} --checkpoint {shlex.quote(str(result.checkpoint))}")
    output.result(
        {
            "checkpoint": result.checkpoint,
            "folder": folder,
            "steps": result.steps,
            "minutes": result.minutes,
            "shares": result.shares,
            "validation": {"success": result.best.success, "attempts": result.best.attempts},
        }
    )
    return SUCCESS


def evaluate_task(args: argparse.Namespace) -> int:
    """Evaluate a policy, the oracle and random actions, then print a table; with --out, pictures and failures too."""
    check_at_least(args, envs=1, episodes=1, seed=0)
    if args.checkpoint is None:
        raise UsageError(f"eval {args.task} requires --checkpoint FILE; create one with: gelflow train {args.task}")
    from gelflow.policies import evaluation_report, recipes
    from gelflow.policies.checkpoint import load_checkpoint, load_network

    training = load_checkpoint(args.checkpoint).training
    options: dict[str, Any] = {**training.get("options", {})}
    if args.preset is not None:
        options["preset"] = args.preset
    recipe = recipes.recipe_for(args.task, training.get("recipe", recipes.DEFAULT))
    batch = recipe.make_task(min(args.envs, args.episodes), **options)
    network = load_network(args.checkpoint, task=batch.description)
    with progress_bar() as progress:
        bar = progress.add_task("evaluating", total=None)
        report = evaluation_report.evaluate_all(
            network,
            batch,
            episodes=args.episodes,
            seed=args.seed,
            out=args.out,
            started=lambda name: progress.update(bar, description=f"evaluating: {name}"),
        )
    output = Output(args.json)
    if output.json:
        rows = [evaluation_report.plain(result) for result in report.results]
        output.result({"task": args.task, "checkpoint": args.checkpoint, "results": rows, "files": report.files})
        return SUCCESS
    output.console.print(_table(report.results, args.task, args.checkpoint, args.episodes))
    for line in report.worst_ranges:
        output.text(line)
    for file in report.files:
        output.text(f"wrote {file}")
    return SUCCESS


def _line(result: "EvaluationResult") -> str:
    low, high = result.confidence_interval()
    return f"success {result.success:.1%} ({low:.1%} to {high:.1%}), {result.attempts:.2f} attempts or steps"


def _table(results: "list[EvaluationResult]", task: str, path: Path, episodes: int) -> Table:
    table = Table(title=f"{task} in simulation: {episodes} episodes, {path.name}")
    for heading in ("actions", "success", "95 % interval", "attempts or steps", "return"):
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for result in results:
        low, high = result.confidence_interval()
        attempts = f"{result.attempts:.2f}" if result.successes else "none"
        table.add_row(
            result.name, f"{result.success:.1%}", f"{low:.1%} to {high:.1%}", attempts, f"{result.reward:.1f}"
        )
    return table


def _command(args: argparse.Namespace, steps: int, folder: Path) -> list[str]:
    """The command that repeats this training, with all defaults written out."""
    values = {"recipe": args.recipe, "steps": steps, "minutes": args.minutes, "envs": args.envs, "seed": args.seed}
    values |= {"preset": args.preset, "out": folder}
    given = [(f"--{name}", str(value)) for name, value in values.items() if value is not None]
    return ["gelflow", "train", args.task, *(word for pair in given for word in pair)]
