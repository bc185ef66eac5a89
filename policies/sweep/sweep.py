"""A sweep: starts the runs of a grid that are not complete on an engine, and again those that are lost."""

import contextlib
import dataclasses
import os
import platform
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.policies.sweep.engines.engine import Engine
from gelflow.policies.sweep.run import Run, RunRecord, read_record, write_record
from gelflow.policies.training.folder import try_lock

GRID = "grid.toml"  # copy of the grid file in the folder of a sweep
RESULTS = ("runs.csv", "summary.csv", "curves.csv", "curves.png")  # of `gelflow sweep`, beside it
Report = Callable[[Run, RunRecord, bool], None]  # a run that ended, its record, and whether it is started again


@contextlib.contextmanager
def sweep_folder(folder: Path) -> Iterator[None]:
    """Prepare the folder of a sweep and keep it locked for this process.

    Raises UsageError when it cannot be written, or another sweep uses it.
    """
    try:
        for name in ("runs", "records", "results", "logs", "locks"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        lock = (folder / "locks" / "sweep.lock").open("a+", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror}") from error
    with lock:
        if not try_lock(lock):
            lock.seek(0)
            raise UsageError(f"another sweep uses {folder}: {lock.read().strip()}")
        lock.truncate(0)
        lock.write(f"process {os.getpid()} on {platform.node()}\n")
        lock.flush()
        yield


def store_grid_file(folder: Path, grid_file: Path) -> None:
    """Copy the grid file into the folder of its sweep."""
    if grid_file.resolve() != (folder / GRID).resolve():
        shutil.copyfile(grid_file, folder / GRID)


def check_grid_file(folder: Path, grid_file: Path, runs: Sequence[Run]) -> None:
    """Raises UsageError where the sweep would replace files of another one, in a folder without any of the runs."""
    stored = folder / GRID
    if any(run.record.exists() for run in runs) or (stored.exists() and stored.read_bytes() == grid_file.read_bytes()):
        return
    for file in (folder / name for name in (GRID, *RESULTS)):
        if file.exists():
            raise UsageError(f"{file} is not of these runs; choose another folder or delete it")


def incomplete(runs: Sequence[Run]) -> list[Run]:
    """The runs that are not complete. Raises UsageError when the folder holds a run with other options."""
    return [run for run in runs if read_record(run).state != "complete"]


def execute_runs(runs: Sequence[Run], engine: Engine, *, tries: int, report: Report) -> None:
    """Execute runs until each is complete or has failed.

    Parameters
    ----------
    runs: those that are not complete
    engine: executes them; they have been submitted to it
    tries: starts of a run. No exit code excludes another start: a full disk has the same one as wrong input.
    report: called for each run that ended
    """
    tried = Counter({run.name: 1 for run in runs})
    remaining = len(runs)
    while remaining:
        for run, ended in engine.ended():
            record = ended if ended.exit_code is not None else _without_worker(run, ended.error)
            again = record.state == "failed" and tried[run.name] < tries
            report(run, record, again)
            if again:
                tried[run.name] += 1
                engine.submit([run])
            else:
                remaining -= 1


def _without_worker(run: Run, error: str) -> RunRecord:
    """Write the record of a run whose worker was lost or could not start it; one that is complete stays complete."""
    record = read_record(run)
    if record.state == "complete":
        return record
    record = dataclasses.replace(record, state="failed", error=error)
    write_record(run, record)
    return record
