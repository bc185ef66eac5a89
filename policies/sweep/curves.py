"""Learning curves of a sweep: median and range over the seeds of each configuration, as a table and as a picture."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.figures import SERIES, save
from gelflow.policies.sweep.results import Row, group, option_columns
from gelflow.policies.sweep.run import Run, RunRecord
from gelflow.toml_tables import suggestion

# Columns to draw; the first that holds numbers is taken.
PREFERRED = ("evaluated success", "evaluated_success", "success", "reward")
RESULT_KEY = "learning_curve"  # of the file in the JSON object that a run prints
_LINES = ("-", "--", ":", "-.")  # one per round through the colours

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """Learning curve of one configuration at the points where all its seeds have a value, shape (points,)."""

    values: dict[str, Any]
    seeds: int
    x: Array
    median: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Curves:
    """Learning curves of all configurations that have a complete run."""

    x_name: str
    y_name: str
    curves: list[Curve]

    def rows(self) -> list[Row]:
        """One flat table row per point."""
        return [
            option_columns(c.values)
            | {self.x_name: x, "median": median, "smallest": low, "largest": high, "seeds": c.seeds}
            for c in self.curves
            for x, median, low, high in zip(
                c.x.tolist(), c.median.tolist(), c.low.tolist(), c.high.tolist(), strict=True
            )
        ]


def read_curves(runs: Sequence[Run], records: Mapping[str, RunRecord], column: str | None = None) -> Curves | None:
    """The learning curves of the complete runs; None when no run has one.

    `column` is drawn over the first column of the tables; None chooses the first of `PREFERRED` that holds numbers.
    Raises UsageError when the tables do not have it.
    """
    tables = {}
    for run in runs:
        path = records[run.name].result.get(RESULT_KEY)
        if records[run.name].state == "complete" and isinstance(path, str) and Path(path).is_file():
            tables[run.name] = read_table(Path(path))
    tables = {name: table for name, table in tables.items() if table}
    if not tables:
        return None
    first = next(iter(tables.values()))
    x_name = next(iter(first))
    names = [name for name in first if name != x_name]
    if column is not None:
        check_column(column, names)
    candidates = [name for name in (*PREFERRED, *names) if name in names]
    y_name = column or next((name for name in candidates if np.isfinite(first[name]).any()), names[0])
    found = []
    for values, members in group(runs):
        pairs = [series(tables[run.name], x_name, y_name) for run in members if run.name in tables]
        pairs = [pair for pair in pairs if len(pair[0])]
        if pairs:
            found.append(combine(values, pairs))
    return Curves(x_name, y_name, found) if found else None


def check_column(column: str, names: Sequence[str], location: str = "") -> None:
    """Raises UsageError when `column` is not one of those of the learning curves; `location` starts its message."""
    if column not in names:
        raise UsageError(f"{location}learning curves have no column {column!r}; {suggestion(column, names)}")


def draw(path: Path, curves: Curves, task: str) -> None:
    """Draw the median of each configuration as a line, and the range over its seeds as a band."""
    from matplotlib.figure import Figure  # imported on use: slow

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for i, curve in enumerate(curves.curves):
        color, marker = SERIES[i % len(SERIES)]
        style = _LINES[i // len(SERIES) % len(_LINES)]
        every = max(1, len(curve.x) // 10)
        label = ", ".join(f"{key} {value}" for key, value in curve.values.items()) or "all seeds"
        axes.plot(curve.x, curve.median, style, color=color, marker=marker, markevery=every, markersize=4, label=label)
        if len(curve.x) == 1:
            axes.vlines(curve.x, curve.low, curve.high, color=color, alpha=0.4)
        axes.fill_between(curve.x, curve.low, curve.high, color=color, alpha=0.18, linewidth=0)
    axes.set(xlabel=f"{curves.x_name} [-]", ylabel=f"{curves.y_name} [-]", title=f"{task}: {curves.y_name}")
    seeds = sorted({curve.seeds for curve in curves.curves})
    counts = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    axes.legend(title=f"line: median, band: range of {counts} seed{'s' if seeds[-1] > 1 else ''}", fontsize="small")
    axes.grid(alpha=0.3)
    save(figure, path, dpi=120)


def read_table(path: Path) -> dict[str, Array]:
    """The columns of a CSV file; an empty cell is nan, and columns with text are left away."""
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    columns = {}
    for name in table[0] if table else ():
        try:
            columns[name] = np.array([float(row[name] or "nan") for row in table])
        except ValueError:
            continue
    return columns


def series(table: Mapping[str, Array], x_name: str, y_name: str) -> tuple[Array, Array]:
    """The points of a column that have a value; of several at one x the last."""
    if y_name not in table:
        return np.zeros(0), np.zeros(0)
    kept = np.isfinite(table[y_name]) & np.isfinite(table[x_name])
    points = dict(zip(table[x_name][kept].tolist(), table[y_name][kept].tolist(), strict=True))
    x = np.array(sorted(points))
    return x, np.array([points[value] for value in x.tolist()])


def combine(values: dict[str, Any], pairs: Sequence[tuple[Array, Array]]) -> Curve:
    """Interpolate the seeds to their common range of x, and take median and range at each point."""
    x = np.unique(np.concatenate([x for x, _ in pairs]))
    x = x[(x >= max(s[0] for s, _ in pairs)) & (x <= min(s[-1] for s, _ in pairs))]
    stack = np.array([np.interp(x, *pair) for pair in pairs])
    if not x.size:  # no common range
        return Curve(values, len(pairs), x, x, x, x)
    return Curve(values, len(pairs), x, np.median(stack, 0), stack.min(0), stack.max(0))
