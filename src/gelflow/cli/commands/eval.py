"""`gelflow eval insertion`: success of a policy in simulation, beside random actions."""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from gelflow.cli.presets import PRESET_HELP
from gelflow.errors import UsageError
from gelflow.task import INSERTION

if TYPE_CHECKING:
    from gelflow.policies.evaluation import EvaluationResult


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("task", choices=["insertion"], help="what was learned")
    parser.add_argument("--checkpoint", type=Path, help="the policy's file (default: the one that comes with gelflow)")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="parts to insert (default 200)")
    parser.add_argument("--envs", type=int, default=64, metavar="N", help="simulated robots side by side (default 64)")
    parser.add_argument("--seed", type=int, default=1, help="decides every random number (default 1)")
    parser.add_argument("--preset", metavar="NAME", help=PRESET_HELP)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(args: argparse.Namespace) -> int:
    """Evaluate; prints a table, or JSON."""
    if args.envs < 1 or args.episodes < 1 or args.seed < 0:
        raise UsageError("--envs and --episodes must be at least 1, --seed at least 0")
    from gelflow.policies.checkpoint import default_checkpoint, load_policy

    path = args.checkpoint or default_checkpoint()
    network = load_policy(path, task=INSERTION).network
    from gelflow.policies.environment import FlowMapNoise, PolicyEnv, make_insertion_env
    from gelflow.policies.evaluation import NetworkActor, RandomActor, evaluate

    console = Console()
    count = min(args.envs, args.episodes)
    plain, noisy = (make_insertion_env(count, noise=noise, preset=args.preset) for noise in (None, FlowMapNoise()))
    reach = network.architecture.reach
    ways: list[tuple[str, NetworkActor | RandomActor, PolicyEnv]] = [
        ("policy", NetworkActor(network, count), plain),
        ("policy, noisy flow maps", NetworkActor(network, count), noisy),
        ("random, policy's reach", RandomActor(reach, count, args.seed), plain),
        ("random, full range", RandomActor(INSERTION.action_scale, count, args.seed), plain),
    ]
    results = []
    with console.status("evaluating") as status:
        for name, actor, attempts in ways:
            status.update(f"evaluating: {name}")
            results.append(evaluate(name, actor, attempts, episodes=args.episodes, seed=args.seed))
    if args.json:
        print(json.dumps([_plain(result, str(path)) for result in results], indent=2))
    else:
        console.print(_table(results, path, args.episodes))
    return 0


def _plain(result: "EvaluationResult", path: str) -> dict[str, object]:
    low, high = result.confidence_interval()
    attempts = result.attempts if result.successes else None
    return dataclasses.asdict(result) | {
        "attempts": attempts,
        "success": result.success,
        "success_95": [low, high],
        "checkpoint": path,
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
