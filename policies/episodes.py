"""Complete episodes of a policy on a task, for evaluations: their success, length, return and randomized quantities.

The length of an episode is counted in `TaskBatch.length_unit`. Attempts include the first one, which the task makes
before the policy acts; an episode that it ends counts too, as in the paper. Corrections do not include it; an episode
that needs none is drawn again, as in training.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.networks.base import BatchPolicy
from gelflow.sim.tasks.task_batch import TaskBatch

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Episodes:
    """The episodes of an evaluation; arrays over the episodes, in the order of the environments."""

    success: Mask
    failed: Mask  # the simulation failed
    length: NDArray[np.int64]
    reward: Array  # return
    quantities: dict[str, Array] = field(default_factory=dict)  # randomized quantities
    quantity_units: dict[str, str] = field(default_factory=dict)
    length_unit: str = "steps"
    metrics: dict[str, Array] = field(default_factory=dict)  # at the end

    def result(self, name: str) -> EvaluationResult:
        """Means over the episodes.

        The mean return is that of the episodes with an action: one that the first attempt ends has none, and how many
        do so differs between evaluations by chance.
        """
        acted = self.length > _first_length(self.length_unit)
        mean_return = float(self.reward[acted].mean()) if acted.any() else 0.0
        lengths = self.length[self.success]
        mean = float(lengths.mean()) if len(lengths) else float("nan")
        counts = len(self.success), int(self.success.sum())
        metrics = {metric: float(values.mean()) for metric, values in self.metrics.items()}
        return EvaluationResult(name, *counts, mean, mean_return, self.length_unit, metrics)


@dataclass
class Film:
    """Pictures of one episode of an evaluation: the first one after its reset, then one after each step."""

    episode: int  # index in the arrays of `Episodes`
    frames: list[NDArray[np.uint8]] = field(default_factory=list)


class RandomPolicy(BatchPolicy):
    """Uniformly random actions within ± `reach` (k,)."""

    def __init__(self, count: int, reach: Array, seed: int) -> None:
        self._count, self._reach = count, reach
        self._rng = np.random.default_rng([seed, 2])

    def reset(self, which: Mask) -> None:
        """Does nothing: random actions have no memory."""

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, k), independent of the observations."""
        return self._rng.uniform(-self._reach, self._reach, (self._count, len(self._reach)))


class OraclePolicy(BatchPolicy):
    """The actions of `TaskBatch.oracle`, which knows the true state."""

    def __init__(self, task: TaskBatch) -> None:
        self._task = task

    def reset(self, which: Mask) -> None:
        """Does nothing: the true state is enough."""

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, k) of the oracle."""
        return np.asarray(self._task.oracle())


def evaluate_task(name: str, policy: BatchPolicy, task: TaskBatch, *, episodes: int, seed: int) -> EvaluationResult:
    """The means of `run_episodes`."""
    return run_episodes(policy, task, episodes=episodes, seed=seed).result(name)


def run_episodes(
    policy: BatchPolicy, task: TaskBatch, *, episodes: int, seed: int, report: Callable[[int], None] | None = None
) -> Episodes:
    """Runs `policy` for `episodes` episodes.

    Each environment contributes equally many episodes (± 1), so that short episodes are not favoured, and then rests.
    `seed` determines the episodes; `report` is called with the number of those that ended. Raises UsageError when
    episodes < 1.
    """
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(task.num_envs)]
    first = _first_length(task.length_unit)
    length, reward = np.zeros(task.num_envs, dtype=np.int64), np.zeros(task.num_envs)
    for event, which in _play(policy, task, episodes=episodes, seed=seed):
        if event == "start":
            length[which], reward[which] = first, 0
        elif event == "step":
            length[which] += 1
            reward[which] += task.reward[which]
        else:
            for row in np.flatnonzero(which):
                kept = [values[row] for values in (*task.quantities.values(), *task.metrics.values())]
                success, failed = task.info["success"][row], task.info["failed"][row]
                rows[row].append((success, failed, length[row], reward[row], *kept))
            if report:
                report(sum(map(len, rows)))
    columns = zip(*(row for of_env in rows for row in of_env), strict=True)
    success, failed, lengths, returns, *kept = columns
    names = (*task.quantities, *task.metrics)
    table = {name: np.array(values, dtype=float) for name, values in zip(names, kept, strict=True)}
    return Episodes(
        np.array(success, bool),
        np.array(failed, bool),
        np.array(lengths),
        np.array(returns),
        {name: table[name] for name in task.quantities},
        dict(task.quantity_units),
        task.length_unit,
        {name: table[name] for name in task.metrics},
    )


def record_films(
    policy: BatchPolicy, task: TaskBatch, films: Sequence[Film], *, episodes: int, seed: int, max_frames: int
) -> None:
    """Repeats the episodes of `run_episodes` with a new policy of the same network, until all `films` have ended."""
    first = np.cumsum([0, *_quota(task.num_envs, episodes)])
    present = first[:-1].copy()  # index of the present episode of each environment
    waiting = {film.episode: film for film in films}
    for event, which in _play(policy, task, episodes=episodes, seed=seed):
        for row in np.flatnonzero(which):
            film = waiting.get(int(present[row]))
            if film and event != "end" and len(film.frames) < max_frames:
                film.frames.append(task.render(int(row)))
            if film and event == "end":
                del waiting[film.episode]
        if event == "end":
            present[which] += 1
        if not waiting:
            return


def _quota(count: int, episodes: int) -> NDArray[np.int64]:
    """Number of episodes of each of `count` environments."""
    return np.full(count, episodes // count) + (np.arange(count) < episodes % count)


def _first_length(unit: str) -> int:
    """Length of an episode before its first action."""
    return 1 if unit == "attempts" else 0


def _play(
    policy: BatchPolicy, task: TaskBatch, *, episodes: int, seed: int
) -> Iterator[tuple[Literal["start", "step", "end"], Mask]]:
    """Plays `episodes` episodes; yields what has happened in which environments (N,)."""
    if episodes < 1:
        raise UsageError(f"episodes must be at least 1, got {episodes}")
    left = _quota(task.num_envs, episodes)
    rng = np.random.default_rng([seed, 1])
    keep_ended = task.length_unit != "corrections"
    starting = active = left > 0
    while active.any():
        if starting.any():
            task.reset(starting, rng, keep_ended=keep_ended)
            policy.reset(starting)
            yield "start", starting
        ended = active & (task.terminated | task.truncated)
        if not ended.any():
            task.step(policy.act(task.observation.copy()), rng, active=active)
            yield "step", active
            ended = active & (task.terminated | task.truncated)
        if ended.any():
            yield "end", ended
        left = left - ended
        active = left > 0
        starting = ended & active
