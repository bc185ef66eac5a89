"""`gelflow eval TASK`: success of a policy in simulation, compared with random actions."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from gelflow.cli.commands.training.task_training import TASKS, evaluate_task, refuse
from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import (
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


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=["insertion", *TASKS], help="task of the policy")
    add_part(parser)
    add_randomization(parser)
    add_checkpoint(parser)
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="episodes (default %(default)s)")
    parser.add_argument("--envs", type=int, default=64, metavar="N", help="parallel environments (default %(default)s)")
    add_seed(parser, default=1)
    add_preset(parser)
    add_out(parser, "folder for videos, pictures and a table of failures; not for the insertion", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate the policy and random actions, then print a table."""
    if args.task != "insertion":
        refuse(args, part=None)
        return evaluate_task(args)
    if args.out is not None:
        raise UsageError("--out is for other tasks than the insertion")
    check_at_least(args, envs=1, episodes=1, seed=0)
    from gelflow.policies.checkpoint import load_policy

    task = part_task(args.part)
    path = checkpoint_for(task, args.checkpoint)
    network = load_policy(path, task=task).network
    from gelflow.policies.environment import FlowMapNoise, PolicyEnv, make_insertion_env
    from gelflow.policies.evaluation import NetworkActor, RandomActor, evaluate

    output = Output(args.json)
    count = min(args.envs, args.episodes)
    plain, noisy = (
        make_insertion_env(count, noise=noise, preset=args.preset, task=task, randomization=args.randomization)
        for noise in (None, FlowMapNoise())
    )
    reach = network.reach
    cases: list[tuple[str, NetworkActor | RandomActor, PolicyEnv]] = [
        ("policy", NetworkActor(network, count), plain),
        ("policy, noisy flow maps", NetworkActor(network, count), noisy),
        ("random, policy's reach", RandomActor(reach, count, args.seed), plain),
        ("random, full range", RandomActor(task.action_scale, count, args.seed), plain),
    ]
    results = []
    with progress_bar() as progress:
        bar = progress.add_task("evaluating", total=len(cases))
        for name, actor, env in cases:
            progress.update(bar, description=f"evaluating: {name}")
            results.append(evaluate(name, actor, env, episodes=args.episodes, seed=args.seed))
            progress.advance(bar)
    if output.json:
        output.result({"task": args.task, "checkpoint": path, "results": [_plain(result) for result in results]})
    else:
        output.console.print(_table(results, path, args.episodes))
    return SUCCESS


def _plain(result: "EvaluationResult") -> dict[str, object]:
    return dataclasses.asdict(result) | {
        "attempts": result.attempts if result.successes else None,
        "success": result.success,
        "success_95": list(result.confidence_interval()),
    }


def _table(results: "list[EvaluationResult]", path: Path, episodes: int) -> Table:
    table = Table(title=f"Insertion in simulation: {episodes} parts, {path.name}")
    for heading in ("actions", "inserted", "95 % interval", "attempts", "reward"):
        table.add_column(heading, justify="left" if heading == "actions" else "right")
    for result in results:
        low, high = result.confidence_interval()
        attempts = f"{result.attempts:.1f}" if result.successes else "none"
        row = (f"{result.success:.1%}", f"{low:.0%} to {high:.0%}", attempts, f"{result.reward:.1f}")
        table.add_row(result.name, *row)
    return table
