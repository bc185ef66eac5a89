"""One run of a sweep: its command, its files, and the record of its state."""

import dataclasses
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gelflow.errors import UsageError

FORMAT = 1
GELFLOW = ("-P", "-m", "gelflow.cli")  # -P: a file in the working folder must not replace an imported module


@dataclass(frozen=True)
class Run:
    """One run: a command with one seed that writes into one folder and continues there when it is started again."""

    name: str
    folder: Path  # of the sweep, absolute
    working_folder: Path  # of the command, absolute
    arguments: tuple[str, ...]  # of `gelflow`
    values: dict[str, Any]  # of the options that differ between configurations
    seed: int
    cpus: int = 1
    program: tuple[str, ...] = GELFLOW  # arguments of the Python interpreter, which start the command

    @property
    def record(self) -> Path:
        """File with the `RunRecord`."""
        return self.folder / "records" / f"{self.name}.json"

    @property
    def output(self) -> Path:
        """File with the standard output of the last start: a JSON object, printed at the end."""
        return self.folder / "results" / f"{self.name}.json"

    @property
    def log(self) -> Path:
        """File with the standard error of all starts."""
        return self.folder / "logs" / f"{self.name}.txt"

    @property
    def lock(self) -> Path:
        """File that the process that executes the run keeps locked."""
        return self.folder / "locks" / self.name


@dataclass(frozen=True)
class RunRecord:
    """State of a run, written when it starts and when it ends."""

    name: str
    arguments: tuple[str, ...]
    state: Literal["started", "complete", "failed"]
    starts: int = 0  # in this folder, by all sweeps
    machine: str = ""
    seconds: float = 0.0  # duration of the last start, wall time
    exit_code: int | None = None  # negative: the number of the signal; None: its worker was lost or could not start it
    error: str = ""
    result: dict[str, Any] = field(default_factory=dict)  # the JSON object that the command printed


def read_record(run: Run) -> RunRecord:
    """The record of a run; `starts` is 0 when it was never started.

    Raises UsageError when the folder holds a run of this name with other options, or a record of a newer format.
    """
    try:
        values = json.loads(run.record.read_text(encoding="utf-8"))
        version = values.pop("format")
        if version > FORMAT:
            raise UsageError(f"{run.record} has format {version}; this gelflow reads format {FORMAT}: update gelflow")
        record = RunRecord(**values | {"arguments": tuple(values["arguments"])})
    except FileNotFoundError:
        return RunRecord(run.name, run.arguments, "started")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(
            f"{run.record} is damaged ({type(error).__name__}); delete it and runs/{run.name} to start the run again"
        ) from error
    check_arguments(run, record.arguments)
    return record


def check_arguments(run: Run, stored: tuple[str, ...]) -> None:
    """Raises UsageError when the run of this name in the folder has other arguments, those in `stored`."""
    if stored != run.arguments:
        raise UsageError(
            f"{run.folder} holds a run {run.name!r} with other options: {_difference(stored, run.arguments)};"
            " choose another --out"
        )


def write_record(run: Run, record: RunRecord) -> None:
    """Replace the record of a run as a whole, so that no reader finds half of it."""
    partial = run.record.with_name(f"{run.record.name}.{os.getpid()}.part")
    partial.write_text(json.dumps({"format": FORMAT, **dataclasses.asdict(record)}, indent=2) + "\n", encoding="utf-8")
    partial.replace(run.record)


def _difference(old: tuple[str, ...], new: tuple[str, ...]) -> str:
    """The words of two commands that differ, as `old, now new`."""
    removed = [word for word in old if word not in new]
    added = [word for word in new if word not in old]
    return f"{' '.join(removed) or 'nothing'}, now {' '.join(added) or 'nothing'}"
