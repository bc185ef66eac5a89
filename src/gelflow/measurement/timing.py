"""Timing of workloads: interleaved repeats, medians, and reports.

Workloads are run in turn, repeat after repeat, so that a disturbance of the machine affects all of them. Results are
medians over the repeats. A speed-up is the median of the ratios within each repeat, because the two runs of a pair
follow each other closely.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from gelflow.errors import UsageError

MIN_RUN_SECONDS = 5e-3  # shorter workloads run several times per repeat: clocks and interrupts are coarse [s]
QUICK_REPEATS, REPEATS = 5, 15
IDLE_CPU_SHARE = 0.95  # minimum share of a core that a thread gets on an otherwise idle machine


class ProgressReporter(Protocol):
    """Receives the progress of a measurement."""

    def begin(self, what: str, total: int) -> None:
        """A measurement `what` with `total` parts starts."""

    def advance(self) -> None:
        """One part is done."""


class SilentProgress:
    """A progress reporter without output."""

    def begin(self, what: str, total: int) -> None: ...

    def advance(self) -> None: ...


@dataclass(frozen=True)
class BenchmarkOptions:
    """Extent of a measurement. Raises UsageError when `repeats` is below 1."""

    quick: bool = False  # fewer sizes and shorter runs
    repeats: int = REPEATS
    progress: ProgressReporter = field(default_factory=SilentProgress)

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise UsageError(f"repeats must be at least 1, got {self.repeats}")


@dataclass(frozen=True)
class Report:
    """Result of a measurement: a table for the terminal, and records for a file."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str
    results: list[dict[str, Any]]  # JSON data
    violations: list[str]  # one line for each run whose error exceeds its bound

    def to_dict(self) -> dict[str, Any]:
        """JSON data of the report."""
        return {"title": self.title, "note": self.note, "outside": self.violations, "results": self.results}


@dataclass(frozen=True)
class Workload:
    """A function to time."""

    run: Callable[[], object]
    units: int  # units of work (steps, markers, …) in one run
    prepare: Callable[[], object] = lambda: None  # called before each run, not timed


@dataclass(frozen=True)
class Timing:
    """Seconds per unit of a workload, one entry per repeat."""

    seconds: tuple[float, ...]  # wall-clock time
    cpu_seconds: tuple[float, ...]  # processor time of all threads; less than wall-clock time on a busy machine

    @property
    def median(self) -> float:
        """Median wall-clock seconds per unit."""
        return statistics.median(self.seconds)

    @property
    def rate(self) -> float:
        """Median rate, units per second."""
        return 1 / self.median

    @property
    def quartiles(self) -> tuple[float, float]:
        """Lower and upper quartile of the rate, units per second."""
        slow, fast = np.percentile(self.seconds, (75, 25))
        return float(1 / slow), float(1 / fast)

    @property
    def spread(self) -> str:
        """Half of the interquartile range, relative to the median."""
        slow, fast = self.quartiles
        return f"{(fast - slow) / 2 / self.rate:.0%}"

    @property
    def cpu_share(self) -> float:
        """Processor seconds per wall-clock second."""
        return statistics.median(cpu / wall for cpu, wall in zip(self.cpu_seconds, self.seconds, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """JSON data of the timing."""
        return {
            "per_second": self.rate,
            "quartiles": self.quartiles,
            "cpu_share": self.cpu_share,
            "repeats": len(self.seconds),
        }


def load_note(timings: Sequence[Timing]) -> str:
    """Warning for the note of single-thread timings taken on a busy machine; empty on an idle one."""
    share = statistics.median(timing.cpu_share for timing in timings)
    return "" if share > IDLE_CPU_SHARE else f" The machine was busy, runs had {share:.0%} of a core: rough figures."


def speedup(one: Timing, other: Timing) -> float:
    """Rate of `one` relative to `other`, for timings of the same `time_interleaved` call."""
    return statistics.median(b / a for a, b in zip(one.seconds, other.seconds, strict=True))


def time_interleaved(workloads: Sequence[Workload], options: BenchmarkOptions) -> list[Timing]:
    """Time workloads in turn: one untimed run of each, then `options.repeats` timed rounds.

    Advances `options.progress` by (repeats + 1) × workloads.
    """
    loops = []
    for workload in workloads:
        loops.append(math.ceil(MIN_RUN_SECONDS / max(_run_once(workload)[0], 1e-9)))
        options.progress.advance()
    samples: list[list[tuple[float, float]]] = [[] for _ in workloads]
    for _ in range(options.repeats):
        for workload, count, own in zip(workloads, loops, samples, strict=True):
            wall, cpu = np.sum([_run_once(workload) for _ in range(count)], axis=0) / (count * workload.units)
            own.append((float(wall), float(cpu)))
            options.progress.advance()
    return [Timing(*(tuple(values) for values in zip(*own, strict=True))) for own in samples]


def _run_once(workload: Workload) -> tuple[float, float]:
    """Wall-clock and processor time of one run [s]."""
    workload.prepare()
    wall, cpu = time.perf_counter(), time.process_time()
    workload.run()
    return time.perf_counter() - wall, time.process_time() - cpu
