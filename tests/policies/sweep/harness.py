"""Sweeps of the stand-in for `gelflow train`, and their interruption at a known point."""

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from tests.common.processes import is_running
from tests.policies.sweep.fake_training import STEPS

from gelflow.errors import UsageError
from gelflow.policies.sweep.engines.engine import Engine, lost
from gelflow.policies.sweep.grid import CommandOptions, read_grid
from gelflow.policies.sweep.run import Run, RunRecord, read_record
from gelflow.policies.sweep.run_process import execute
from gelflow.policies.sweep.sweep import execute_runs, incomplete, sweep_folder

PROGRAM = (str(Path(__file__).with_name("fake_training.py")),)
TWO_SEEDS = 'task = "fake"\nseeds = [0, 1]\n[options]\nrate = 2.0\n'


def check(arguments: Sequence[str]) -> None:
    """As the parser of `gelflow train`: refuses text as rate."""
    for word in arguments[2:3]:
        try:
            float(word)
        except ValueError:
            raise UsageError(f"argument --rate: invalid float value: {word!r}") from None


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends processes together with their parent")
OPTIONS = CommandOptions(
    names={"rate": "rate", "fast": "fast"},
    flags=["fast"],
    reserved={"seed": "list them as seeds = [0, 1, 2]"},
    check=check,
    curve_columns=lambda arguments: ["success"],
)


def make_runs(folder: Path, text: str = TWO_SEEDS) -> list[Run]:
    """The runs of a grid file with this text; the sweep is in `folder`/sweep."""
    path = folder / "grid.toml"
    path.write_text(text)
    return read_grid(path, OPTIONS).runs(folder / "sweep", program=PROGRAM)


def sweep(runs: Sequence[Run], engine: Callable[[], Engine], *, tries: int = 3) -> list[tuple[str, str, bool]]:
    """Execute the runs that are not complete; name, state and whether it is started again of each that ended."""
    ended: list[tuple[str, str, bool]] = []

    def report(run: Run, record: RunRecord, again: bool) -> None:
        ended.append((run.name, record.state, again))

    folder = runs[0].folder
    with sweep_folder(folder), engine() as made:
        remaining = incomplete(runs)
        made.submit(remaining)
        execute_runs(remaining, made, tries=tries, report=report)
    return ended


class Worker(Engine):
    """Executes runs one after the other, as a worker of Ray or SLURM on the machine `node7`."""

    def __init__(self, *, loses_results: bool = False) -> None:
        self._runs: list[Run] = []
        self._loses_results = loses_results

    def submit(self, runs: Sequence[Run]) -> None:
        self._runs.extend(runs)

    def ended(self) -> list[tuple[Run, RunRecord]]:
        run = self._runs.pop(0)
        record = execute(run, "node7")
        return [(run, lost(run, "no connection") if self._loses_results else record)]

    def close(self) -> None:
        self._runs.clear()


def steps(run: Run) -> list[tuple[int, int]]:
    """The steps of a run until now, each with the id of the process that made it."""
    try:
        text = (run.folder / "runs" / run.name / "state.json").read_text()
    except FileNotFoundError:
        return []
    return [(step, process) for step, _, process in json.loads(text)]


def is_held(run: Run) -> bool:
    """Whether the run waits in its middle, which it does while the file `hold` exists."""
    return len(steps(run)) > STEPS // 2


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for a condition; a test that waits for ever is ended by pytest's time limit."""
    while not condition():
        time.sleep(0.02)


@contextlib.contextmanager
def held(runs: Sequence[Run], then: Callable[[], None], *, release: bool = True) -> Iterator[None]:
    """In this block runs wait in their middle until `then` was called, which happens when all of `runs` wait."""
    hold = runs[0].folder / "hold"
    hold.parent.mkdir(parents=True, exist_ok=True)
    hold.touch()

    def act() -> None:
        wait_until(lambda: all(map(is_held, runs)))
        try:
            then()
        finally:  # an error of `then` must not leave the runs waiting
            if release:
                hold.unlink()

    with ThreadPoolExecutor(1) as threads:
        acting = threads.submit(act)
        yield
        acting.result()


def kill(run: Run) -> None:
    """Kill the process of a run, as the operating system does when memory is short."""
    os.kill(steps(run)[-1][1], signal.SIGKILL)


def signal_worker(run: Run, number: signal.Signals) -> None:
    """Send a signal to the worker of a run, and wait until the process of the run has ended with it."""
    process = steps(run)[-1][1]
    worker = Path(f"/proc/{process}/status").read_text().split("PPid:")[1].split()[0]
    os.kill(int(worker), number)
    wait_until(lambda: not is_running(process))


def assert_resumed(run: Run) -> None:
    """The run is complete, was started twice, and made each step once: the second start continued the first."""
    record = read_record(run)
    assert record.state == "complete" and record.starts == 2
    made = steps(run)
    assert [step for step, _ in made] == list(range(STEPS))
    assert len({process for _, process in made}) == 2
