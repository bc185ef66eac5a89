"""The one way in which things are timed: in turn, again and again, so that a disturbance of the machine hits all alike.

Figures are medians over the repeats. How many times as fast one thing is as another is the median of the repeats' own
ratios: the two of a pair ran within moments of each other.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from gelflow.errors import UsageError

MIN_RUN_SECONDS = 5e-3  # what takes less [s] is run several times in one repeat: clocks and interrupts are coarse
QUICK_REPEATS, REPEATS = 5, 15
IDLE_CPU_SHARE = 0.95  # share of a core that a thread gets on a machine that does nothing else, at least


class ProgressReporter(Protocol):
    """Is told how far a measurement is."""

    def begin(self, what: str, total: int) -> None:
        """`what` is being measured; `advance` will be called `total` times."""

    def advance(self) -> None:
        """One part of it is done."""


class SilentProgress:
    """A watch that nobody looks at."""

    def begin(self, what: str, total: int) -> None: ...

    def advance(self) -> None: ...


@dataclass(frozen=True)
class BenchmarkOptions:
    """How long a measurement may take."""

    quick: bool = False  # fewer sizes and shorter runs
    repeats: int = REPEATS
    progress: ProgressReporter = field(default_factory=SilentProgress)

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise UsageError(f"repeats must be at least 1, got {self.repeats}")


@dataclass(frozen=True)
class Report:
    """A measurement: a table for the terminal, and all of it for a file."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str
    results: list[dict[str, Any]]  # what JSON can hold
    violations: list[str]  # runs that were off by more than allowed, a line each

    def plain(self) -> dict[str, Any]:
        return {"title": self.title, "note": self.note, "outside": self.violations, "results": self.results}


@dataclass(frozen=True)
class Workload:
    """Something to time."""

    run: Callable[[], object]
    units: int  # steps, markers, … that one run does
    prepare: Callable[[], object] = lambda: None  # before each run, not timed


@dataclass(frozen=True)
class Timing:
    """What a unit of a work took in each repeat [s]."""

    seconds: tuple[float, ...]  # by the clock on the wall
    cpu_seconds: tuple[float, ...]  # of all threads: tells a load_note machine from a slow one

    @property
    def median(self) -> float:
        """Seconds per unit."""
        return statistics.median(self.seconds)

    @property
    def rate(self) -> float:
        """Units per second."""
        return 1 / self.median

    @property
    def quartiles(self) -> tuple[float, float]:
        """Units per second: a quarter of the repeats was slower, a quarter faster."""
        slow, fast = np.percentile(self.seconds, (75, 25))
        return float(1 / slow), float(1 / fast)

    @property
    def spread(self) -> str:
        """Half of what lies between the quartiles, beside the median."""
        slow, fast = self.quartiles
        return f"{(fast - slow) / 2 / self.rate:.0%}"

    @property
    def cpu_share(self) -> float:
        """Processor seconds per second."""
        return statistics.median(cpu / wall for cpu, wall in zip(self.cpu_seconds, self.seconds, strict=True))

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "per_second": self.rate,
            "quartiles": self.quartiles,
            "cpu_share": self.cpu_share,
            "repeats": len(self.seconds),
        }


def load_note(timings: Sequence[Timing]) -> str:
    """What to add to the note under workloads of one thread, where others used the machine; usually nothing."""
    share = statistics.median(times.cpu_share for times in timings)
    return "" if share > IDLE_CPU_SHARE else f" The machine was busy, runs had {share:.0%} of a core: rough figures."


def speedup(one: Timing, other: Timing) -> float:
    """How many times as fast `one` was as `other`, of the same `time_interleaved` run."""
    return statistics.median(b / a for a, b in zip(one.seconds, other.seconds, strict=True))


def time_interleaved(workloads: Sequence[Workload], options: BenchmarkOptions) -> list[Timing]:
    """Time workloads in turn, each `options.repeats` times after once untimed; advances
    `options.progress` (repeats + 1) × workloads times."""
    loops = []
    for work in workloads:
        loops.append(math.ceil(MIN_RUN_SECONDS / max(_once(work)[0], 1e-9)))
        options.progress.advance()
    timings: list[list[tuple[float, float]]] = [[] for _ in workloads]
    for _ in range(options.repeats):
        for work, count, own in zip(workloads, loops, timings, strict=True):
            wall, cpu = np.sum([_once(work) for _ in range(count)], axis=0) / (count * work.units)
            own.append((float(wall), float(cpu)))
            options.progress.advance()
    return [Timing(*(tuple(values) for values in zip(*own, strict=True))) for own in timings]


def _once(work: Workload) -> tuple[float, float]:
    work.prepare()
    wall, cpu = time.perf_counter(), time.process_time()
    work.run()
    return time.perf_counter() - wall, time.process_time() - cpu
