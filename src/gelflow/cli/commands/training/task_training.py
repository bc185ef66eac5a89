"""`gelflow train` for the tasks that recipes train; the insertion has options and an output of its own."""

import argparse
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import TaskProgressColumn, TimeElapsedColumn

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import DEFAULT_RANDOMIZATION
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult
    from gelflow.policies.training.run import Progress

DEFAULT_RECIPE = "default"
TASKS = ("cap", "grasp", "insertion", "pushing")  # those of `gelflow.policies.recipes`, which is slow to import
UNTRAINED = ("rolling",)  # without a recipe; the error states the reason


def refuse(args: argparse.Namespace, **unset: object) -> None:
    """Raises UsageError for an option that only the insertion has; `unset` are the values without it."""
    for name, value in unset.items():
        if getattr(args, name, value) != value:
            raise UsageError(f"--{name.replace('_', '-')} is for the insertion, not for {args.task}")


def task_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of the environments that `--preset` and `--randomization` set; empty where they have their defaults."""
    options = {} if args.preset is None else {"preset": args.preset}
    if args.randomization not in (None, DEFAULT_RANDOMIZATION):
        options["randomization"] = args.randomization
    return options


def train_task(args: argparse.Namespace) -> int:
    """Train a policy with a progress bar, then print the result."""
    from gelflow.policies import recipes  # deferred: torch is slow to import

    recipe = recipes.recipe_for(args.task, args.recipe)
    steps = recipe.steps if args.attempts is None else args.attempts
    folder = args.out or Path("runs") / args.task
    options = task_options(args)
    output = Output(args.json)
    with progress_bar(TaskProgressColumn(), TimeElapsedColumn()) as progress:
        bar = progress.add_task("training", total=steps)

        def report(point: "Progress") -> None:
            first = [(name, value) for name, value in list(point.numbers.items())[:2] if math.isfinite(value)]
            numbers = "  ".join(f"{name} {value:.3g}" for name, value in first)
            progress.update(bar, completed=point.steps, description=numbers)
            if point.evaluation is not None:
                progress.console.print(
                    f"after {point.steps:>9,} steps, {point.minutes:5.1f} min: {_line(point.evaluation)}",
                    soft_wrap=True,
                )

        result = recipes.train(
            args.task,
            folder,
            recipe=args.recipe,
            seed=args.seed,
            steps=steps,
            envs=args.envs,
            minutes=float("inf") if args.minutes is None else args.minutes,
            options=options,
            command=_command(args, steps, folder),
            report=report,
        )
    shares = ", ".join(f"{name} {share:.0%}" for name, share in result.shares.items())
    if result.stored:
        output.text(f"{folder} holds this training already, finished; its result:")
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
            "learning_curve": result.curve,
            "validation": result.best.to_json(),
        }
    )
    return SUCCESS


def _line(result: "EvaluationResult") -> str:
    low, high = result.confidence_interval()
    length = f", {result.length:.2f} {result.length_unit}" if result.successes else ""
    return f"success {result.success:.1%} ({low:.1%} to {high:.1%}){length}"


def _command(args: argparse.Namespace, steps: int, folder: Path) -> list[str]:
    """The command that repeats this training, with all defaults written out."""
    values = {"recipe": args.recipe, "steps": steps, "minutes": args.minutes, "envs": args.envs, "seed": args.seed}
    return command_with(args.task, {**values, **task_options(args), "out": folder})


def command_with(task: str, values: Mapping[str, Any]) -> list[str]:
    """The words of `gelflow train` with these options; an option that is None is omitted."""
    words = [(f"--{name}", str(value)) for name, value in values.items() if value is not None]
    return ["gelflow", "train", task, *(word for pair in words for word in pair)]
