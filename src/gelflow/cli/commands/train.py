"""`gelflow train insertion`: train a policy in simulation with PPO."""

import argparse
import shlex
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gelflow.cli.presets import PRESET_HELP
from gelflow.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=["insertion"], help="what to learn")
    parser.add_argument("--attempts", type=int, metavar="N", help="total attempts (default: docs/guide/training.md)")
    parser.add_argument("--minutes", type=float, metavar="M", help="stop after this time; such a run is not repeatable")
    parser.add_argument("--envs", type=int, default=64, metavar="N", help="simulated robots side by side (default 64)")
    parser.add_argument("--seed", type=int, default=0, help="decides every random number (default 0)")
    parser.add_argument("--preset", metavar="NAME", help=PRESET_HELP)
    parser.add_argument("--out", type=Path, default=Path("runs/insertion"), help="folder for what is made")


def run(args: argparse.Namespace) -> int:
    """Train, with a progress bar; says where the checkpoint is."""
    if args.envs < 1 or args.seed < 0:
        raise UsageError(f"--envs must be at least 1 and --seed at least 0, got {args.envs} and {args.seed}")
    from gelflow.policies.environment import (
        FlowMapNoise,  # here: torch takes seconds to import
        make_insertion_env,
    )
    from gelflow.policies.learning_curve import LearningCurvePoint
    from gelflow.policies.ppo import PPOSettings, train

    given = {name: getattr(args, name) for name in ("attempts", "minutes") if getattr(args, name) is not None}
    settings = PPOSettings(seed=args.seed, **given)
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console) as bars:
        bar = bars.add_task("training", total=settings.attempts)

        def report(point: LearningCurvePoint) -> None:
            text = f"reward {point.reward:6.2f}  inserted {point.success:4.0%}"
            if point.evaluation is None:
                bars.update(bar, completed=point.attempts, description=text)
            else:
                evaluation = point.evaluation
                bars.console.print(
                    f"after {point.attempts:>9,} attempts, {point.minutes:5.1f} min:"
                    f" inserted {evaluation.success:6.1%} in {evaluation.attempts:.1f} attempts"
                )

        made = train(
            make_insertion_env(args.envs, noise=FlowMapNoise(), preset=args.preset),
            make_insertion_env(args.envs, noise=FlowMapNoise(), preset=args.preset),
            out=args.out,
            settings=settings,
            command=_command(args, settings.attempts),
            report=report,
        )
    console.print(f"best on validation: {made.best.success:.1%} inserted in {made.best.attempts:.1f} attempts")
    console.print(f"checkpoint {made.checkpoint}, learning curve {made.picture} and {made.curve.name}", soft_wrap=True)
    console.print(f"judge it with: gelflow eval insertion --checkpoint {shlex.quote(str(made.checkpoint))}")
    return 0


def _command(args: argparse.Namespace, attempts: int) -> list[str]:
    """The command that makes the same again, whatever the defaults become."""
    names = ("minutes", "envs", "seed", "preset", "out")
    values = {"attempts": attempts} | {name: getattr(args, name) for name in names}
    given = [(f"--{name}", str(value)) for name, value in values.items() if value is not None]
    return ["gelflow", "train", args.task, *(word for pair in given for word in pair)]
