"""Where the failures of an evaluation lie: their share in ranges of each randomized quantity."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.figures import BLUE, save, set_log_axis
from gelflow.policies.episodes import Episodes
from gelflow.policies.evaluation import EvaluationResult

QUANTILES = 5  # ranges of equally many episodes in which failures are counted
# Unit → unit and factor in text and pictures.
_SHOWN = {"m": ("mm", 1e3), "kg": ("g", 1e3), "rad": ("°", 180 / math.pi)}
_SMALL_FORCE = 0.2  # [N] below it forces are shown in mN
_COLUMNS = 4  # of the picture
_DECADES = 20.0  # ratio of the ends of a range above which its axis is logarithmic


@dataclass(frozen=True)
class FailureRange:
    """Failures of the episodes whose quantity lies between `low` and `high`."""

    quantity: str
    unit: str
    low: float
    high: float
    episodes: int
    failures: int

    @property
    def rate(self) -> float:
        """Failures per episode."""
        return self.failures / self.episodes

    def confidence_interval(self, *, comparisons: int = 1) -> tuple[float, float]:
        """95 % interval of the rate, or of those of several `comparisons` together."""
        result = EvaluationResult("", self.episodes, self.failures, math.nan, math.nan)
        return result.confidence_interval(comparisons=comparisons)

    def to_json(self) -> dict[str, object]:
        """As JSON data."""
        low, high = self.confidence_interval()
        return dataclasses.asdict(self) | {"rate": self.rate, "rate_low": low, "rate_high": high}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "FailureRange":
        """From the data of `to_json`. Raises KeyError when one is missing."""
        return cls(**{item.name: values[item.name] for item in dataclasses.fields(cls)})


def failure_ranges(episodes: Episodes) -> list[FailureRange]:
    """Failures by ranges of each quantity that hold equally many episodes; quantities that are fixed are omitted.

    The quantities on which failures depend most come first.
    """
    found: dict[str, list[FailureRange]] = {}
    for name, values in episodes.quantities.items():
        edges = np.unique(np.quantile(values, np.linspace(0, 1, QUANTILES + 1)))
        if len(edges) < 2:
            continue
        index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        unit, rows = episodes.quantity_units.get(name, ""), []
        for i in range(len(edges) - 1):
            inside = index == i
            failures = int((~episodes.success[inside]).sum())
            if inside.any():
                rows.append(FailureRange(name, unit, float(edges[i]), float(edges[i + 1]), int(inside.sum()), failures))
        found[name] = rows
    order = sorted(found, key=lambda name: -_spread(found[name]))
    return [row for name in order for row in found[name]]


def worst_ranges(ranges: Sequence[FailureRange], count: int = 3) -> list[str]:
    """A line for each of up to `count` quantities with a range in which failures are more frequent than overall.

    The rate of the range must exceed the overall rate by more than its interval, which holds with 95 % for all ranges
    together: of evaluations whose failures depend on no quantity, about 5 % have a line.
    """
    lines = []
    for name, rows in _by_quantity(ranges).items():
        worst = max(rows, key=lambda row: row.rate)
        overall = sum(row.failures for row in rows) / sum(row.episodes for row in rows)
        unit, factor = _shown_unit(rows)
        limits = f"{factor * worst.low:.4g} and {factor * worst.high:.4g} {unit}"
        text = f"{worst.failures} of {worst.episodes} between {limits}".rstrip()
        if worst.confidence_interval(comparisons=len(ranges))[0] > overall:
            lines.append(f"most failures by {name}: {text}")
    return lines[:count]


def _by_quantity(ranges: Sequence[FailureRange]) -> dict[str, list[FailureRange]]:
    names = dict.fromkeys(entry.quantity for entry in ranges)
    return {name: [entry for entry in ranges if entry.quantity == name] for name in names}


def _shown_unit(rows: Sequence[FailureRange]) -> tuple[str, float]:
    """Unit to show a quantity in, and the factor to it."""
    unit = rows[0].unit
    if unit == "N" and max(abs(row.high) for row in rows) < _SMALL_FORCE:
        return "mN", 1e3
    return _SHOWN.get(unit, (unit, 1.0))


def _spread(rows: Sequence[FailureRange]) -> float:
    """Largest minus smallest rate of failures."""
    rates = [row.rate for row in rows]
    return max(rates) - min(rates)


def draw_failures(path: Path, ranges: Sequence[FailureRange]) -> None:
    """Failure rate over each quantity, with 95 % confidence intervals."""
    save(failure_figure(ranges), path, dpi=100)


def failure_figure(ranges: Sequence[FailureRange]) -> Any:
    """The figure of `draw_failures`."""
    from matplotlib.figure import Figure  # deferred: slow to import

    groups = _by_quantity(ranges)
    columns = min(_COLUMNS, len(groups))
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(max(3.2 * columns, 6.4), 2.6 * rows + 0.5), layout="constrained")
    figure.suptitle("Failures in ranges of equally many episodes, with 95 % confidence intervals")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes, (name, own) in zip(grid.ravel(), groups.items(), strict=False):
        unit, factor = _shown_unit(own)
        limits = factor * np.array([(row.low, row.high) for row in own])
        logarithmic = limits.min() > 0 and limits.max() > _DECADES * limits.min()
        middle = np.sqrt(limits.prod(1)) if logarithmic else limits.mean(1)
        rate = np.array([100 * row.rate for row in own])
        bounds = 100 * np.array([row.confidence_interval() for row in own]).T
        axes.errorbar(middle, rate, np.abs(bounds - rate), fmt="o-", color=BLUE, capsize=3)
        axes.set_xlabel(f"{name} [{unit or '-'}]")
        if logarithmic:
            set_log_axis(axes, "x", subs=(1,))
        else:
            axes.locator_params(axis="x", nbins=5)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    for axes in grid.ravel()[len(groups) :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("failures [%]")
    return figure
