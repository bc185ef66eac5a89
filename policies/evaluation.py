"""The result of an evaluation of a policy over complete episodes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Any

import numpy as np


@dataclass(frozen=True)
class EvaluationResult:
    """Results of an actor over complete episodes."""

    name: str
    episodes: int
    successes: int
    length: float  # mean length of the successful episodes; nan without any
    reward: float  # mean return of the episodes with an action
    length_unit: str = "corrections"  # "steps"; "attempts", the first included; or "corrections" between attempts
    metrics: Mapping[str, float] = field(default_factory=dict)  # means of `TaskBatch.metrics` at the end

    @property
    def success(self) -> float:
        """Success rate."""
        return self.successes / self.episodes

    def confidence_interval(self, *, comparisons: int = 1) -> tuple[float, float]:
        """95 % Wilson score interval of the success rate.

        With several `comparisons`, all their intervals together hold with 95 % (Bonferroni).
        """
        n, z = self.episodes, 1.96 if comparisons == 1 else NormalDist().inv_cdf(1 - 0.025 / comparisons)
        middle = (self.success + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(self.success * (1 - self.success) / n + z * z / (4 * n * n))
        # Rounding must not move a limit off 0 without a success, nor off 1 without a failure.
        low = max(0.0, middle - half) if self.successes else 0.0
        return low, min(1.0, middle + half) if self.successes < n else 1.0

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
