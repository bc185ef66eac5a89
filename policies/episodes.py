"""Complete episodes of a policy on a task, for evaluations: their success, length, return and randomized quantities.

An episode counts from its reset. Where a task makes a first attempt before the policy acts (grasp, insertion), an
episode that this attempt ends counts too; `steps` are the actions of the policy, `attempts` are one more.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.networks.base import BatchPolicy
from gelflow.sim.tasks.gripper.attempt_task import AttemptTask
from gelflow.sim.tasks.task_batch import TaskBatch

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Episodes:
    """The episodes of an evaluation; arrays over the episodes, in the order of the environments."""

    success: NDArray[np.bool_]
    failed: NDArray[np.bool_]  # the simulation failed
    steps: NDArray[np.int64]  # actions of the policy
    reward: Array  # return
    quantities: dict[str, Array] = field(default_factory=dict)  # randomized quantities

    def result(self, name: str, first: int) -> EvaluationResult:
        """Means; `first` is the number of attempts before the first action."""
        steps = self.steps[self.success] + first
        mean = float(steps.mean()) if len(steps) else float("nan")
        return EvaluationResult(name, len(self.success), int(self.success.sum()), mean, float(self.reward.mean()))


class RandomPolicy(BatchPolicy):
    """Uniformly random actions within ± `reach` (k,)."""

    def __init__(self, count: int, reach: Array, seed: int) -> None:
        self._count, self._reach = count, reach
        self._rng = np.random.default_rng([seed, 2])

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Does nothing: random actions have no memory."""

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, k), independent of the observations."""
        return self._rng.uniform(-self._reach, self._reach, (self._count, len(self._reach)))


def evaluate_task(name: str, policy: BatchPolicy, task: TaskBatch, *, episodes: int, seed: int) -> EvaluationResult:
    """The means of `run_episodes`."""
    return run_episodes(policy, task, episodes=episodes, seed=seed).result(name, first_attempts(task))


def run_episodes(
    policy: BatchPolicy, task: TaskBatch, *, episodes: int, seed: int, report: Callable[[int], None] | None = None
) -> Episodes:
    """Runs `policy` for `episodes` episodes.

    Each environment contributes equally many episodes (± 1), so that short episodes are not favoured, and then rests.
    `seed` determines the episodes; `report` is called with the number of those that ended. Raises UsageError when
    episodes < 1.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be at least 1, got {episodes}")
    n = task.num_envs
    left = np.full(n, episodes // n) + (np.arange(n) < episodes % n)
    rng = np.random.default_rng([seed, 1])
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(n)]
    steps, reward = np.zeros(n, dtype=np.int64), np.zeros(n)
    starting = active = left > 0
    while active.any():
        if starting.any():
            task.reset(starting, rng, keep_ended=True)
            policy.reset(starting)
            steps[starting] = reward[starting] = 0
        ended = active & (task.terminated | task.truncated)
        if not ended.any():
            task.step(policy.act(task.observation.copy()), rng, active=active)
            steps[active] += 1
            reward[active] += task.reward[active]
            ended = active & (task.terminated | task.truncated)
        for row in np.flatnonzero(ended):
            drawn = {key: values[row] for key, values in quantities(task).items()}
            rows[row].append((task.info["success"][row], task.info["failed"][row], steps[row], reward[row], drawn))
        left = left - ended
        active = left > 0
        starting = ended & active
        if report and ended.any():
            report(episodes - int(left.sum()))
    success, failed, made, returns, drawn_rows = zip(*(row for of_env in rows for row in of_env), strict=True)
    table = {key: np.array([values[key] for values in drawn_rows], dtype=float) for key in drawn_rows[0]}
    return Episodes(np.array(success, bool), np.array(failed, bool), np.array(made), np.array(returns), table)


def quantities(task: TaskBatch) -> dict[str, Array]:
    """The randomized quantities of the present episodes: name → (N,)."""
    return {name: np.asarray(values, dtype=float) for name, values in getattr(task, "quantities", {}).items()}


def first_attempts(task: TaskBatch) -> int:
    """Attempts of an episode before the first action: 1 for tasks of attempts, 0 for tasks of control."""
    return 1 if isinstance(task, AttemptTask) else 0
