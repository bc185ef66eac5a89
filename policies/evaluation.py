"""Evaluation of policies over complete episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.environment import PolicyEnv
from gelflow.policies.networks.flow_map_policy import FlowMapNetwork

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EvaluationResult:
    """Results of an actor over complete episodes."""

    name: str
    episodes: int
    successes: int
    length: float  # mean length of the successful episodes; nan without any
    reward: float  # mean return
    length_unit: str = "corrections"  # "steps"; "attempts", the first included; or "corrections" between attempts
    metrics: Mapping[str, float] = field(default_factory=dict)  # means of `TaskBatch.metrics` at the end

    @property
    def success(self) -> float:
        """Success rate."""
        return self.successes / self.episodes

    def confidence_interval(self) -> tuple[float, float]:
        """95 % Wilson score interval of the success rate."""
        n, z = self.episodes, 1.96
        middle = (self.success + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(self.success * (1 - self.success) / n + z * z / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)

    def to_json(self) -> dict[str, Any]:
        """As JSON data; the length is stored under the name of its unit."""
        return {
            "name": self.name,
            "episodes": self.episodes,
            "successes": self.successes,
            "success": self.success,
            "success_95": list(self.confidence_interval()),
            self.length_unit: self.length if self.successes else None,
            "reward": self.reward,
            **({"metrics": dict(self.metrics)} if self.metrics else {}),
        }


class NetworkActor:
    """A network that acts in `count` environments."""

    def __init__(self, network: FlowMapNetwork, count: int) -> None:
        self._policy = network.batch_policy(count)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3) [m, m, rad] for the latest flow maps."""
        return self._policy.corrections(images)

    def reset(self, done: NDArray[np.bool_]) -> None:
        """Clears the history of the environments marked in `done`."""
        self._policy.reset(done)


class RandomActor:
    """Uniformly random corrections within ± `max_correction` [m, m, rad]."""

    def __init__(self, max_correction: tuple[float, float, float], count: int, seed: int) -> None:
        self._max_correction = np.asarray(max_correction)
        self._count = count
        self._rng = np.random.default_rng(seed)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3) [m, m, rad], independent of the flow maps."""
        return self._rng.uniform(-self._max_correction, self._max_correction, (self._count, 3))

    def reset(self, done: NDArray[np.bool_]) -> None:
        """Does nothing: random corrections have no history."""


def evaluate(
    name: str, actor: NetworkActor | RandomActor, env: PolicyEnv, *, episodes: int, seed: int
) -> EvaluationResult:
    """Evaluates `actor` over `episodes` episodes.

    Each environment contributes equally many episodes (± 1), so that short episodes are not favoured. Raises
    UsageError when episodes < 1.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be at least 1, got {episodes}")
    count = env.count
    quota = np.full(count, episodes // count) + (np.arange(count) < episodes % count)
    completed, attempts_made, reward = np.zeros(count, dtype=int), np.zeros(count), np.zeros(count)
    lengths: list[float] = []
    rewards: list[float] = []
    actor.reset(np.ones(count, dtype=bool))
    images = env.reset(seed)
    while (completed < quota).any():
        result = env.step(actor.act(images))
        attempts_made += 1
        reward += result.reward
        counted = result.done & (completed < quota)
        lengths += list(attempts_made[counted & result.success])
        rewards += list(reward[counted])
        completed += result.done
        attempts_made[result.done] = reward[result.done] = 0
        actor.reset(result.done)
        images = result.images
    mean = float(np.mean(lengths)) if lengths else float("nan")
    return EvaluationResult(name, episodes, len(lengths), mean, float(np.mean(rewards)))
