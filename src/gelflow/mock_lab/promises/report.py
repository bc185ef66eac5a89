"""Table and JSON of measured promises."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from gelflow.errors import UsageError
from gelflow.measurement.machine import processor
from gelflow.mock_lab.promises.outcome import Row
from gelflow.session.records import to_plain


def table(rows: Sequence[Row]) -> Table:
    """One line for each promise."""
    shown = Table(title="Promises of the runner")
    for column in ("promise", "held", "measured", "at most"):
        shown.add_column(column, justify="right" if column in ("measured", "at most") else "left", no_wrap=True)
    shown.add_column("quantity")
    for row in rows:
        promise = row.promise
        values = row.outcome.value, promise.bound
        measured, bound = (f"{round(value, 3):.4g} {promise.unit}".strip() for value in values)
        shown.add_row(promise.name, "yes" if row.held else "NO", measured, bound, promise.measured)
    return shown


def remarks(rows: Sequence[Row]) -> list[str]:
    """One line for each promise that was broken or has a note."""
    lines = []
    for row in rows:
        texts = [f"not so: {', '.join(row.outcome.broken)}"] if row.outcome.broken else []
        texts += [row.outcome.note] if row.outcome.note else []
        if texts:
            lines.append(f"{row.promise.name}: {'; '.join(texts)}")
    return lines


def to_json(rows: Sequence[Row]) -> dict[str, Any]:
    """The results as JSON data, with the computer and its load."""
    return {
        "processor": processor(),
        "load": load(),
        "promises": [
            {
                "name": row.promise.name,
                "text": row.promise.text,
                "held": row.held,
                "quantity": row.promise.measured,
                "measured": row.outcome.value,
                "bound": row.promise.bound,
                "unit": row.promise.unit,
                "broken": list(row.outcome.broken),
                "note": row.outcome.note,
                "seconds": row.seconds,
                "tests": list(row.promise.tests),
            }
            for row in rows
        ],
    }


def load() -> float | None:
    """Mean number of processes that wanted to run in the last minute; None where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write JSON data. Raises UsageError when the file cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(to_plain(values), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}; name another folder with --out") from None
