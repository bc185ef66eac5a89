"""The report of an evaluation: policy, oracle and random actions, pictures of episodes, and where failures lie."""

import csv
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.figures import BLUE, save
from gelflow.policies.episodes import Episodes, RandomPolicy, first_attempts, run_episodes
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.networks.base import BatchPolicy, Network
from gelflow.sim.tasks.task_batch import TaskBatch

QUANTILES = 5  # ranges of equally many episodes in which failures are counted
EPISODES, FAILURES, FAILURE_PICTURE = "episodes.csv", "failures.csv", "failures.png"
_MAX_FRAMES = 200  # of a video


@dataclass
class Report:
    """Results by actor, the files that were written, and the range of each quantity with the most failures."""

    results: list[EvaluationResult] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    worst_ranges: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class FailureRange:
    """Failures of the episodes whose quantity lies between `low` and `high`."""

    quantity: str
    low: float
    high: float
    episodes: int
    failures: int

    def result(self) -> EvaluationResult:
        """As a result, for its confidence interval."""
        return EvaluationResult(self.quantity, self.episodes, self.failures, float("nan"), float("nan"))


class OraclePolicy(BatchPolicy):
    """The actions of `TaskBatch.oracle`, which knows the true state."""

    def __init__(self, task: TaskBatch) -> None:
        self._task: Any = task

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Does nothing: the true state is enough."""

    def act(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Actions (n, k) of the oracle."""
        return np.asarray(self._task.oracle())


def evaluate_all(
    network: Network,
    task: TaskBatch,
    *,
    episodes: int,
    seed: int,
    out: Path | None = None,
    started: Callable[[str], None] = lambda name: None,
) -> Report:
    """Evaluates the policy, the oracle (where the task has one) and random actions on the same episodes.

    With `out`, writes the episodes and their failures as tables, a picture of the failures, and a picture and a video
    of one success and one failure into this folder. `started` is called with the name of each evaluation.
    """
    n, first = task.num_envs, first_attempts(task)
    actors: dict[str, BatchPolicy] = {"policy": network.batch_policy(n)}
    if _has_oracle(task):
        actors["oracle"] = OraclePolicy(task)
    actors["random"] = RandomPolicy(n, np.ones(task.action_space.shape), seed)
    report = Report()
    for name, actor in actors.items():
        started(name)
        found = run_episodes(actor, task, episodes=episodes, seed=seed)
        report.results.append(found.result(name, first))
        if name == "policy":
            ranges = failure_ranges(found)
            report.worst_ranges = _worst(ranges)
            if out is not None:
                report.files += _write_tables(out, found, ranges)
    if out is not None:
        for outcome in (True, False):
            started("video of a success" if outcome else "video of a failure")
            report.files += record(network, task, out, seed=seed, success=outcome, episodes=episodes)
    return report


def _has_oracle(task: Any) -> bool:
    """Whether the task has actions of an oracle."""
    try:
        task.oracle()
    except (AttributeError, UsageError):
        return False
    return True


def failure_ranges(episodes: Episodes) -> list[FailureRange]:
    """Failures by ranges of each quantity that hold equally many episodes; quantities that are fixed are omitted."""
    ranges = []
    for name, values in episodes.quantities.items():
        edges = np.unique(np.quantile(values, np.linspace(0, 1, QUANTILES + 1)))
        if len(edges) < 2:
            continue
        index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        for i in range(len(edges) - 1):
            inside = index == i
            failures = int((~episodes.success[inside]).sum())
            ranges.append(FailureRange(name, float(edges[i]), float(edges[i + 1]), int(inside.sum()), failures))
    return ranges


def _worst(ranges: Sequence[FailureRange]) -> list[str]:
    """A line for each of the three quantities whose failures depend most on it."""
    spread: dict[str, tuple[float, FailureRange]] = {}
    for name in {entry.quantity for entry in ranges}:
        own = [entry for entry in ranges if entry.quantity == name and entry.episodes]
        worst = max(own, key=lambda entry: entry.failures / entry.episodes)
        spread[name] = max(e.failures / e.episodes for e in own) - min(e.failures / e.episodes for e in own), worst
    order = sorted(spread.items(), key=lambda item: (-item[1][0], item[0]))
    return [
        f"most failures by {name}: {worst.failures} of {worst.episodes} between {worst.low:.4g} and {worst.high:.4g}"
        for name, (difference, worst) in order[:3]
        if difference > 0
    ]


def _write_tables(out: Path, episodes: Episodes, ranges: Sequence[FailureRange]) -> list[Path]:
    out.mkdir(parents=True, exist_ok=True)
    with (out / EPISODES).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["success", "failed", "steps", "return", *episodes.quantities])
        columns = (episodes.success, episodes.failed, episodes.steps, episodes.reward, *episodes.quantities.values())
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
    if not ranges:
        return [out / EPISODES]
    with (out / FAILURES).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([entry.name for entry in dataclasses.fields(FailureRange)])
        writer.writerows([dataclasses.astuple(entry) for entry in ranges])
    _draw_failures(out / FAILURE_PICTURE, ranges)
    return [out / EPISODES, out / FAILURES, out / FAILURE_PICTURE]


def _draw_failures(path: Path, ranges: Sequence[FailureRange]) -> None:
    """Failure rate over each quantity, with 95 % confidence intervals."""
    from matplotlib.figure import Figure  # deferred: slow to import

    names = list(dict.fromkeys(entry.quantity for entry in ranges))
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.6 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes, name in zip(grid.ravel(), names, strict=False):
        own = [entry for entry in ranges if entry.quantity == name and entry.episodes]
        middle = [(entry.low + entry.high) / 2 for entry in own]
        rate = np.array([100 * entry.failures / entry.episodes for entry in own])
        bounds = 100 * np.array([entry.result().confidence_interval() for entry in own]).T
        axes.errorbar(middle, rate, np.abs(bounds - rate), fmt="o-", color=BLUE, capsize=3)
        axes.set_xlabel(name)
        axes.grid(alpha=0.3)
    for axes in grid.ravel()[len(names) :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("failures [%]")
    save(figure, path, dpi=100)


def record(network: Network, task: TaskBatch, out: Path, *, seed: int, success: bool, episodes: int) -> list[Path]:
    """Writes a video (GIF) and the last picture of the first episode of environment 0 that ends in `success`.

    Searches `episodes` episodes of environment 0, with the seeds of the evaluation; no file if there is none.
    """
    from PIL import Image  # deferred: slow to import

    policy, rng = network.batch_policy(task.num_envs), np.random.default_rng([seed, 1])
    only = np.arange(task.num_envs) == 0
    for _ in range(episodes):
        start = rng.bit_generator.state
        ended = _play(policy, task, only, rng, None)
        if ended != success:
            continue
        after, rng.bit_generator.state = rng.bit_generator.state, start
        frames: list[NDArray[np.uint8]] = []
        _play(policy, task, only, rng, frames)
        rng.bit_generator.state = after
        name = "success" if success else "failure"
        pictures = [Image.fromarray(frame) for frame in frames]
        duration = [1000 / min(task.frames_per_second, 25)] * (len(pictures) - 1) + [2000]
        out.mkdir(parents=True, exist_ok=True)
        pictures[0].save(out / f"{name}.gif", save_all=True, append_images=pictures[1:], duration=duration, loop=0)
        pictures[-1].save(out / f"{name}.png")
        return [out / f"{name}.gif", out / f"{name}.png"]
    return []


def _play(
    policy: BatchPolicy,
    task: TaskBatch,
    only: NDArray[np.bool_],
    rng: np.random.Generator,
    frames: list[NDArray[np.uint8]] | None,
) -> bool:
    """One episode of environment 0; returns its success, and appends pictures to `frames`."""
    task.reset(only, rng, keep_ended=True)
    policy.reset(np.ones(task.num_envs, dtype=bool))
    if frames is not None:
        frames.append(task.render(0))
    while not (task.terminated[0] or task.truncated[0]):
        task.step(policy.act(task.observation.copy()), rng, active=only)
        if frames is not None and len(frames) < _MAX_FRAMES:
            frames.append(task.render(0))
    return bool(task.info["success"][0])


def plain(result: EvaluationResult) -> dict[str, object]:
    """A result as JSON data."""
    return dataclasses.asdict(result) | {
        "attempts": result.attempts if result.successes else None,
        "success": result.success,
        "success_95": list(result.confidence_interval()),
    }
