"""Failure rates and costs of random steps far outside the normal range (`gelflow.sim.validation.stress`)."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from gelflow.sim import _core
from gelflow.sim.validation.reference_motions import SCENES
from gelflow.sim.validation.stress import KINDS, StepStatistics, StressTest, stress_batches

ENVS, STEPS = 250, 20
ALLOWED_FAILURES = 0.01  # share of all steps; none in the normal range

Key = tuple[str, str]  # "kind", "scene" or "precision", and its value; ("", "everything")


@dataclass(frozen=True)
class StressSurvey:
    """Statistics of all batches, grouped by kind, scene and precision."""

    statistics: dict[Key, StepStatistics]
    seconds: dict[Key, float]

    @property
    def total(self) -> StepStatistics:
        return self.statistics["", "everything"]

    @property
    def passed(self) -> bool:
        """No failure in the normal range, few failures overall, and no step above the iteration limit."""
        normal, total = self.statistics["kind", "normal"], self.total
        few = total.failed <= ALLOWED_FAILURES * total.steps
        return normal.failed == 0 and few and total.most_iterations <= iteration_limit()

    def records(self) -> list[dict[str, Any]]:
        """JSON data, one entry per group."""
        return [
            {"of": key[0], "name": key[1], "steps": s.steps, "failed": s.failed, "halved": s.halved}
            | {"iterations": s.iterations, "most_iterations": s.most_iterations}
            | {"us_per_step": round(1e6 * self.seconds[key] / s.steps, 1)}
            for key, s in self.statistics.items()
        ]


def iteration_limit() -> int:
    """Maximum number of Newton iterations of a step, including its substeps."""
    return int(_core.ModelSpec().max_step_iterations)


def count(rounds: int) -> int:
    """Number of batches in `rounds` rounds."""
    return len(stress_batches(rounds))


def survey(rounds: int, progress: Callable[[float], None], *, seed: int = 0) -> StressSurvey:
    """Run all batches of `rounds` rounds, 100 000 steps each. `progress` is advanced by 1 after each batch."""
    test = StressTest(envs=ENVS, steps=STEPS, seed=seed)
    statistics: dict[Key, StepStatistics] = {}
    seconds: dict[Key, float] = {}
    for batch in stress_batches(rounds):
        start = time.perf_counter()
        result = test.run(batch)
        elapsed = time.perf_counter() - start
        keys = (("kind", batch.kind), ("scene", batch.scene), ("precision", batch.precision), ("", "everything"))
        for key in keys:
            statistics.setdefault(key, StepStatistics()).add(result)
            seconds[key] = seconds.get(key, 0.0) + elapsed
        progress(1)
    order = [("kind", kind) for kind in KINDS] + [("scene", scene) for scene in SCENES]
    order += [("precision", "double"), ("precision", "single"), ("", "everything")]
    return StressSurvey({key: statistics[key] for key in order if key in statistics}, seconds)


def table(result: StressSurvey) -> Table:
    """Steps, failures, substeps, Newton iterations and time of each group."""
    out = Table(title="Random steps outside the normal range", title_justify="left")
    for heading in ("", "steps", "failed", "substeps", "Newton", "most", "µs/step"):
        out.add_column(heading, justify="right" if heading else "left")
    for key, s in result.statistics.items():
        shares = (f"{s.failed / s.steps:.3%}", f"{s.halved / s.steps:.2%}")
        costs = (f"{s.iterations / s.steps:.1f}", str(s.most_iterations), f"{1e6 * result.seconds[key] / s.steps:.1f}")
        out.add_row(" ".join(key).strip(), str(s.steps), *shares, *costs)
    return out
