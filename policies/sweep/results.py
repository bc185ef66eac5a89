"""Results of a sweep: one row per run, and the median and range over the seeds of each configuration."""

import csv
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.policies.sweep.run import Run, RunRecord

Row = dict[str, Any]

# Names of the other columns of the tables: of a run, a configuration and a learning curve, and results of a training.
_OTHER_COLUMNS = {
    *("name", "seed", "state", "starts", "seconds", "machine", "error"),
    *("runs", "complete"),
    *("median", "smallest", "largest", "seeds"),
    *("steps", "minutes"),
}


@dataclass(frozen=True)
class Range:
    """Median, smallest and largest value over the seeds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Range":
        """The range of at least one value."""
        return cls(statistics.median(values), min(values), max(values))


@dataclass(frozen=True)
class Configuration:
    """All runs that differ in their seed only."""

    values: dict[str, Any]  # of the options that differ between configurations
    runs: int
    complete: int
    results: dict[str, Range]  # of the numbers that every complete run printed, by dotted key


def option_columns(values: Mapping[str, Any]) -> Row:
    """Options as columns of a table; one with the name of another column is named such as `option.steps`."""
    return {f"option.{name}" if name in _OTHER_COLUMNS else name: value for name, value in values.items()}


def rows(runs: Sequence[Run], records: Mapping[str, RunRecord]) -> list[Row]:
    """One flat table row per run: options, seed, state, and what the command printed under dotted keys."""
    found = []
    for run in runs:
        record = records[run.name]
        state = {key: getattr(record, key) for key in ("state", "starts", "seconds", "machine", "error")}
        options = option_columns(run.values)
        found.append({"name": run.name, **options, "seed": run.seed, **state, **flatten(record.result)})
    return found


def configurations(runs: Sequence[Run], records: Mapping[str, RunRecord]) -> list[Configuration]:
    """The configurations in the order of the grid."""
    found = []
    for values, members in group(runs):
        complete = [flatten(records[run.name].result) for run in members if records[run.name].state == "complete"]
        names = [
            name for name in (complete[0] if complete else {}) if all(_is_number(row.get(name)) for row in complete)
        ]
        results = {name: Range.of([row[name] for row in complete]) for name in names}
        found.append(Configuration(values, len(members), len(complete), results))
    return found


def group(runs: Sequence[Run]) -> list[tuple[dict[str, Any], list[Run]]]:
    """The runs of each configuration, with its values."""
    groups: dict[str, tuple[dict[str, Any], list[Run]]] = {}
    for run in runs:
        groups.setdefault(json.dumps(run.values), (run.values, []))[1].append(run)
    return list(groups.values())


def flatten(values: Mapping[str, Any], prefix: str = "") -> Row:
    """Nested tables as one table with dotted keys; lists become JSON text."""
    flat: Row = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = json.dumps(value) if isinstance(value, list) else value
    return flat


def write_csv(path: Path, table: Sequence[Row]) -> None:
    """Write rows as CSV; the columns are those of all rows, in the order of their first appearance."""
    columns = list(dict.fromkeys(key for row in table for key in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)


def summary_rows(found: Sequence[Configuration]) -> list[Row]:
    """One flat table row per configuration."""
    return [
        {
            **option_columns(configuration.values),
            "runs": configuration.runs,
            "complete": configuration.complete,
            **{
                f"{name} {statistic}": getattr(span, field)
                for name, span in configuration.results.items()
                for statistic, field in (("median", "median"), ("smallest", "low"), ("largest", "high"))
            },
        }
        for configuration in found
    ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
