"""Stalls of the computer: intervals in which not even a process with real-time priority ran.

A busy host of a virtual machine, or a kernel function that cannot be interrupted, delays every program. A measurement
of reaction times needs these intervals to tell such delays from those of the measured program.
"""

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

from gelflow.clock import raise_priority

Interval = tuple[float, float]  # begin and end on the system's monotonic clock [s]

_SLEEP = 1e-3  # of the watching process [s]
_SHORTEST = 3e-3  # a longer delay of its wake-up is a stall [s]
_END_LIMIT = 10.0  # [s]


class StallWatch:
    """Records the stalls of each CPU while the `with` block runs, in one process per CPU; `intervals` has them after it.

    Without permission for real-time priority, other programs with load count as stalls too.
    """

    def __init__(self) -> None:
        self.intervals: list[Interval] = []
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Self:
        cpus = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [-1]
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-m", "gelflow.measurement.stalls", str(cpu)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            for cpu in cpus
        ]
        for process in self._processes:
            assert process.stdout is not None
            process.stdout.readline()  # it has started
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        found: list[Interval] = []
        for process in self._processes:
            output, _ = process.communicate(timeout=_END_LIMIT)  # closes standard input, which ends the process
            found += [(begin, end) for begin, end in json.loads(output)]
        self.intervals = united(found)


def united(intervals: Iterable[Interval]) -> list[Interval]:
    """The union of intervals, in order of time, without overlaps."""
    result: list[Interval] = []
    for begin, end in sorted(intervals):
        if result and begin <= result[-1][1]:
            result[-1] = result[-1][0], max(end, result[-1][1])
        else:
            result.append((begin, end))
    return result


def overlaps(interval: Interval, others: Sequence[Interval]) -> bool:
    """Whether `interval` overlaps one of `others`."""
    return any(begin <= interval[1] and interval[0] <= end for begin, end in others)


def main(cpu: int) -> None:
    """Watch one CPU (-1: any) until standard input closes, then print the stalls as JSON."""
    if cpu >= 0:
        os.sched_setaffinity(0, {cpu})
    raise_priority()
    stalls: list[Interval] = []
    print("started", flush=True)
    before = time.monotonic()
    while not select.select([sys.stdin], [], [], _SLEEP)[0]:
        now = time.monotonic()
        if now - before > _SLEEP + _SHORTEST:
            stalls.append((before, now))
        before = now
    print(json.dumps(stalls))


if __name__ == "__main__":
    main(int(sys.argv[1]))
