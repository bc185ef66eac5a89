"""Insertion attempts on a vector environment, seen one way by training and by evaluation.

An episode is one part. Its first observation is the flow map of a first attempt; each step corrects the pose and
makes another. Finished environments start the next part within the same step. The environment's info tells the true
pose (key "pose"), which training takes its reward from and the policy never sees.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.environment import PolicyEnv
from gelflow.policies.networks import Network

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EvaluationResult:
    """Figures of one way to act over complete episodes."""

    name: str
    episodes: int
    successes: int
    attempts: float  # mean over the successful episodes; nan when there is none
    reward: float  # mean over episodes of the summed reward

    @property
    def success(self) -> float:
        """Share of the episodes that ended inserted."""
        return self.successes / self.episodes

    def confidence_interval(self) -> tuple[float, float]:
        """The 95 % interval of the share (Wilson)."""
        n, z = self.episodes, 1.96
        middle = (self.success + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(self.success * (1 - self.success) / n + z * z / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)


class NetworkActor:
    """A network acting on all environments at once."""

    def __init__(self, network: Network, count: int) -> None:
        self._network = network
        self._history = network.history(count)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3) for the newest flow maps."""
        corrections = self._network.corrections(self._history.observe(self._network.encode(images)))
        self._history.record(corrections)
        return corrections

    def reset(self, done: NDArray[np.bool_]) -> None:
        """New parts where `done`."""
        self._history.reset(done)


class RandomActor:
    """Corrections drawn uniformly within ± `reach`."""

    def __init__(self, reach: tuple[float, float, float], count: int, seed: int) -> None:
        self._reach = np.asarray(reach)
        self._count = count
        self._rng = np.random.default_rng(seed)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3), whatever was felt."""
        return self._rng.uniform(-self._reach, self._reach, (self._count, 3))

    def reset(self, done: NDArray[np.bool_]) -> None:
        """Nothing is remembered."""


def evaluate(
    name: str, actor: NetworkActor | RandomActor, attempts: PolicyEnv, *, episodes: int, seed: int
) -> EvaluationResult:
    """Let `actor` insert at least `episodes` parts, equally many in every environment (short ones are not favoured).

    Returns figures of exactly `episodes` episodes. Raises UsageError when episodes < 1.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be at least 1, got {episodes}")
    count = attempts.count
    quota = np.full(count, episodes // count) + (np.arange(count) < episodes % count)
    finished, tries, reward = np.zeros(count, dtype=int), np.zeros(count), np.zeros(count)
    lengths: list[float] = []
    rewards: list[float] = []
    actor.reset(np.ones(count, dtype=bool))
    images = attempts.reset(seed)
    while (finished < quota).any():
        outcome = attempts.step(actor.act(images))
        tries += 1
        reward += outcome.reward
        counted = outcome.done & (finished < quota)
        lengths += list(tries[counted & outcome.success])
        rewards += list(reward[counted])
        finished += outcome.done
        tries[outcome.done] = reward[outcome.done] = 0
        actor.reset(outcome.done)
        images = outcome.images
    mean = float(np.mean(lengths)) if lengths else float("nan")
    return EvaluationResult(name, episodes, len(lengths), mean, float(np.mean(rewards)))
