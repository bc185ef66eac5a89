"""The record of a reproduction: rows of each variant over its seeds, beside those of paper, oracle and chance."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gelflow.measurement.machine import processor, versions
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.reproduction.trials import Curve, Effort, run_trial
from gelflow.policies.reproduction.variants import Reproduction, Variant
from gelflow.policies.sweep.curves import combine
from gelflow.policies.training.run import locked

FORMAT = 1
LENGTHS = ("attempts", "corrections", "steps")

# Variant, seed, what is done, completed part of the trials of the task.
Report = Callable[[str, int, str, float], None]


def reproduce(
    plan: Reproduction,
    folder: Path,
    *,
    effort: Effort,
    command: Sequence[str],
    report: Report = lambda variant, seed, text, part: None,
) -> dict[str, Any]:
    """Trains and evaluates what is missing in `folder`, and returns the record of the task as JSON data.

    Raises UsageError when the folder cannot be written, is in use, or holds trainings with other settings.
    """
    count = len(plan.variants) * len(effort.seeds)

    def trial(index: int, variant: Variant, seed: int) -> dict[str, Any]:
        def progress(text: str, part: float) -> None:
            report(variant.name, seed, text, (index + part) / count)

        return run_trial(plan, variant, seed, folder=folder, effort=effort, command=command, report=progress)

    rows, n = [], len(effort.seeds)
    with locked(folder):
        for i, variant in enumerate(plan.variants):
            results = [trial(i * n + j, variant, seed) for j, seed in enumerate(effort.seeds)]
            rows.append(variant_row(plan, variant, results))
    return {
        "format": FORMAT,
        "task": plan.task,
        "command": list(command),
        "quick": effort.shorter > 1,
        "seeds": list(effort.seeds),
        "processor": processor(),
        "versions": versions(),
        "curve": plan.curve,
        "variants": rows,
    }


def variant_row(plan: Reproduction, variant: Variant, trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The row of a variant: our policies over the seeds, the paper's figure, oracle and random actions."""
    actors = {row["name"]: [trial["rows"][i] for trial in trials] for i, row in enumerate(trials[0]["rows"])}
    ours = over_seeds(actors["policy"])
    return {
        "name": variant.name,
        "recipe": variant.recipe,
        "options": {**variant.options},
        "evaluation": {**variant.evaluation},
        "trained_as": variant.trained_as,
        "ours": ours,
        "paper": None if variant.paper is None else {**vars(variant.paper)},
        **{name: over_seeds(rows) for name, rows in actors.items() if name != "policy"},
        "training_minutes": [trial["training_minutes"] for trial in trials],
        "processors": sorted({trial["processor"] for trial in trials}),
        "curves": {name: _over_seeds([trial["curves"][name] for trial in trials]) for name in trials[0]["curves"]},
    }


def _over_seeds(curves: Sequence[Curve]) -> dict[str, list[float]] | None:
    """Median and range over the seeds; None without points."""
    pairs = [pair for pair in curves if len(pair[0])]
    if not pairs:
        return None
    curve = combine({}, pairs)
    return {name: getattr(curve, name).tolist() for name in ("x", "median", "low", "high")}


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Success over the episodes of all seeds, with its interval, and means and deviations over the seeds."""
    episodes, successes = (sum(row[name] for row in rows) for name in ("episodes", "successes"))
    pooled = EvaluationResult("", episodes, successes, float("nan"), float("nan"))
    unit = next(name for name in LENGTHS if name in rows[0])
    lengths = [row[unit] for row in rows if row[unit] is not None]
    metrics = {name: statistics.fmean(row["metrics"][name] for row in rows) for name in rows[0].get("metrics", {})}
    return {
        "episodes": episodes,
        "success": pooled.success,
        "success_95": list(pooled.confidence_interval()),
        "success_of_seeds": [row["success"] for row in rows],
        "success_deviation": _deviation([row["success"] for row in rows]),
        unit: statistics.fmean(lengths) if lengths else None,
        f"{unit}_deviation": _deviation(lengths),
        "reward": statistics.fmean(row["reward"] for row in rows),
        "reward_deviation": _deviation([row["reward"] for row in rows]),
        **({"metrics": metrics} if metrics else {}),
    }


def length_of(row: Mapping[str, Any]) -> tuple[str, float | None]:
    """Unit and mean length of the successful episodes in a result of `over_seeds`."""
    unit = next(name for name in LENGTHS if name in row)
    return unit, row[unit]


def _deviation(values: Sequence[float]) -> float | None:
    """Standard deviation over the seeds (n − 1); None for fewer than two."""
    return statistics.stdev(values) if len(values) > 1 else None
