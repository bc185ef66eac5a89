"""The file of a soak test: one JSON object per line and plan; a run of the test continues where the last one ended."""

import json
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.session.records import to_plain

FORMAT = 1


class Ledger:
    """The rows of a soak test; `settings` are the options of its plans, which are part of each row.

    Raises UsageError when the file cannot be read, was written by another program, or has rows of other settings.
    """

    def __init__(self, path: Path, **settings: object) -> None:
        self._path, self._settings = path, settings
        self.rows: dict[int, dict[str, Any]] = {}  # by seed
        try:
            lines = path.read_bytes().split(b"\n") if path.exists() else []
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"cannot read {path}: {error.strerror}; name another folder with --out") from None
        for number, line in enumerate(lines[:-1], start=1):  # the last line is empty, or was cut by a crash
            try:
                row = json.loads(line)
                known = row["format"] == FORMAT
                self.rows[int(row["seed"])] = row
            except (ValueError, TypeError, KeyError):
                known = False
            if not known:
                raise UsageError(f"{path}, line {number}, is not a row of a soak test; name another folder with --out")
            if not settings.keys() <= row.keys():
                raise UsageError(f"{path} is of an earlier gelflow: its plans have no settings; name another --out")
            for key, value in settings.items():
                if row[key] != value:
                    raise UsageError(f"{path} has plans with --{key} {row[key]}, not {value}; name another --out")
        if lines and lines[-1]:
            self._cut(len(lines[-1]))

    def add(self, seed: int, row: Mapping[str, Any]) -> None:
        """Add the row of a seed, or replace it by a later one; it is on the disk when this returns."""
        whole = {"format": FORMAT, "seed": seed, **to_plain(self._settings), **to_plain(row)}
        try:
            with self._path.open("ab") as file:
                file.write(json.dumps(whole, allow_nan=False, separators=(",", ":")).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UsageError(f"cannot write {self._path}: {error.strerror}; name another folder with --out") from None
        self.rows[seed] = whole

    def counts(self) -> dict[str, dict[str, int]]:
        """Number of plans by outcome, by kind of fault, and by violated rule."""
        outcomes = Counter(row["outcome"] for row in self.rows.values())
        kinds = Counter(kind for row in self.rows.values() for kind in row["kinds"])
        broken = Counter(rule for row in self.rows.values() for rule in row["violations"])
        return {"outcomes": dict(outcomes), "kinds": dict(kinds), "violations": dict(broken)}

    def failing(self) -> list[int]:
        """Seeds of the plans under which a rule was violated."""
        return sorted(seed for seed, row in self.rows.items() if row["violations"])

    def _cut(self, count: int) -> None:
        with self._path.open("r+b") as file:
            file.truncate(self._path.stat().st_size - count)
