"""`gelflow train TASK`: train a policy in simulation; the insertion by imitation of the true pose or with PPO."""

import argparse
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import Progress, TaskProgressColumn, TimeElapsedColumn

from gelflow.cli.commands.training.task_training import (
    DEFAULT_RECIPE,
    TASKS,
    UNTRAINED,
    command_with,
    refuse,
    task_options,
    train_task,
)
from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import (
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
from gelflow.task import InsertionTask

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult
    from gelflow.policies.training.run import Progress as RunProgress
    from gelflow.policies.training.run import TrainingResult

_DEFAULT = "imitation"
_SHIPPED = Path("shipped")  # --start without a file
_STEPS = (
    "environment steps in total, for the insertion attempts (default: insertion 400000, with --start 60000, with "
    "--algorithm ppo 200000; grasp 20480; cap 400000, with --recipe published or published-no-touch 2400000; "
    "pushing 480000)"
)
_ALGORITHMS = (_DEFAULT, "ppo")


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=[*TASKS, *UNTRAINED], metavar="TASK", help=f"task to learn: {', '.join(TASKS)}")
    parser.add_argument("--recipe", metavar="NAME", help="settings of the training, such as paper; not for insertion")
    parser.add_argument("--steps", "--attempts", dest="attempts", type=int, metavar="N", help=_STEPS)
    parser.add_argument(
        "--minutes", type=float, metavar="M", help="stop after this time; such a run is not reproducible"
    )
    parser.add_argument("--envs", type=int, metavar="N", help="parallel environments (default: those of the recipe)")
    add_randomization(parser)
    add_seed(parser)
    add_preset(parser)
    add_out(parser, "folder of the run (default runs/TASK); the same command resumes an unfinished run", folder=True)
    add_json(parser)
    insertion = parser.add_argument_group("insertion only")
    insertion.add_argument(
        "--algorithm", choices=_ALGORITHMS, default=_DEFAULT, help="learning algorithm (default %(default)s)"
    )
    add_part(insertion)
    insertion.add_argument(
        "--calibration", type=Path, metavar="FILE", help="report.json of gelflow calibrate: the physical parameters"
    )
    insertion.add_argument(
        "--start", type=Path, nargs="?", const=_SHIPPED, metavar="FILE",
        help="fine-tuning: start from the weights of this checkpoint, without FILE of the included policy of the part",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Train with a progress bar, then print the paths of the results."""
    check(args)
    if args.task != "insertion":
        args.recipe = recipe_name(args)
        return train_task(args)
    args.out = args.out or Path("runs/insertion")
    output = Output(args.json)
    with progress_bar(TaskProgressColumn(), TimeElapsedColumn()) as progress:
        made = _train(args, progress)
    best = made.best
    if made.stored:
        output.text(f"{args.out} holds this training already, finished; its result:")
    output.text(f"best on validation: {_inserted(best)}")
    seconds = {name: made.seconds[name] for name in ("simulation", "learning")}
    total = sum(seconds.values())
    share = seconds["simulation"] / total
    output.text(f"{total / 60:.1f} min: simulation {share:.0%}, learning {1 - share:.0%}")
    output.text(f"checkpoint {made.checkpoint}, learning curve {made.picture} and {made.curve.name}")
    of_part = "" if args.part is None else f" --part {shlex.quote(args.part)}"
    output.text(f"evaluate it with: gelflow eval insertion{of_part} --checkpoint {shlex.quote(str(made.checkpoint))}")
    output.result(
        {
            "checkpoint": made.checkpoint,
            "learning_curve": made.curve,
            "picture": made.picture,
            "validation": best.to_json(),
            "seconds": seconds,
        }
    )
    return SUCCESS


def check(args: argparse.Namespace) -> None:
    """Raises UsageError for options that the task does not have, numbers out of range, and an unknown recipe."""
    insertion = args.task == "insertion"
    if insertion and args.recipe is not None:
        raise UsageError("--recipe is for other tasks than the insertion, which has --algorithm")
    if not insertion:
        refuse(args, part=None, algorithm=_DEFAULT, calibration=None, start=None)
    check_at_least(args, envs=1, seed=0)
    for name, value in (("attempts" if insertion else "steps", args.attempts), ("minutes", args.minutes)):
        if value is not None and not value > 0:
            raise UsageError(f"--{name} must be above 0, got {value}")
    if args.task in UNTRAINED or args.recipe is not None:
        from gelflow.policies.recipes import recipe_for  # deferred: torch is slow to import

        recipe_for(args.task, args.recipe or DEFAULT_RECIPE)


def recipe_name(args: argparse.Namespace) -> str:
    """The name of the recipe that the options select, without `--start`."""
    if args.task != "insertion":
        return args.recipe or DEFAULT_RECIPE
    return DEFAULT_RECIPE if args.algorithm == _DEFAULT else str(args.algorithm)


def _inserted(result: "EvaluationResult") -> str:
    corrections = f" in {result.length:.2f} corrections" if result.successes else ""
    return f"{result.success:.1%} inserted{corrections}"


def _train(args: argparse.Namespace, progress: Progress) -> "TrainingResult":
    from gelflow.policies import recipes  # deferred: torch is slow to import

    recipe = recipe_name(args)
    if args.start is not None:
        if args.algorithm != _DEFAULT:
            raise UsageError(f"--start is for --algorithm {_DEFAULT}, got {args.algorithm}")
        recipe = recipes.FINE_TUNING
        if args.start == _SHIPPED:
            args.start = _included_policy(part_task(args.part))
    defaults = recipes.recipe_for("insertion", recipe)
    args.envs = defaults.envs if args.envs is None else args.envs
    attempts = defaults.steps if args.attempts is None else args.attempts
    bar = progress.add_task("training", total=attempts)

    def report(point: "RunProgress") -> None:
        reward, success = point.numbers["reward"], point.numbers["success"]
        text = f"reward {reward:6.2f}" + (f"  inserted {success:4.0%}" if math.isfinite(success) else "")
        progress.update(bar, completed=point.steps, description=text)
        if evaluation := point.evaluation:
            progress.console.print(
                f"after {point.steps:>9,} attempts, {point.minutes:5.1f} min: {_inserted(evaluation)}", soft_wrap=True
            )

    return recipes.train(
        "insertion",
        args.out,
        recipe=recipe,
        seed=args.seed,
        steps=attempts,
        envs=args.envs,
        minutes=float("inf") if args.minutes is None else args.minutes,
        options={"task": part_task(args.part), **task_options(args), **_calibration_options(args)},
        start=args.start,
        command=_command(args, attempts),
        report=report,
    )


def _included_policy(task: InsertionTask) -> Path:
    """The included policy of the part of `task`, for `--start`. Raises UsageError when there is none."""
    try:
        return checkpoint_for(task, None)
    except UsageError:
        raise UsageError(
            f"no policy for part {task.part.name!r} comes with gelflow; give --start the checkpoint of another part"
        ) from None


def _calibration_options(args: argparse.Namespace) -> dict[str, Any]:
    """Ranges and samples of the randomization from `--calibration`."""
    if args.calibration is None:
        return {}
    from gelflow.policies.calibration.calibrated_randomization import read_randomization  # deferred: loads PyTorch

    return read_randomization(args.calibration, part_task(args.part))


def _command(args: argparse.Namespace, attempts: int) -> list[str]:
    """The command that repeats this training, with all defaults written out."""
    names = ("part", "calibration", "start", "minutes", "envs", "seed", "preset", "out")
    defaults = {"algorithm": _DEFAULT, "randomization": "default"}
    chosen = {name: getattr(args, name) for name, value in defaults.items() if getattr(args, name) != value}
    return command_with(args.task, chosen | {"attempts": attempts} | {name: getattr(args, name) for name in names})
