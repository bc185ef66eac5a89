"""Stalls of the computer: intervals in which not even a process with real-time priority ran.

A busy host of a virtual machine, or a kernel function that cannot be interrupted, delays every program. A measurement
of reaction times needs these intervals to tell such delays from those of the measured program.
"""

import os
import select
import sys
import time
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

from gelflow.clock import raise_priority
from gelflow.helper_process import HelperProcess, connect_to_parent

Interval = tuple[float, float]  # start and end on the system's monotonic clock [s]

_SLEEP = 1e-3  # of the watching process [s]
_SHORTEST = 3e-3  # a longer delay of its wake-up is a stall [s]
_ANSWER_LIMIT = 60.0  # of the start and of the last report [s]


class StallWatch:
    """Records stalls while the `with` block runs, with one process per CPU; `intervals` has them after the block.

    Without permission for real-time priority, delays by other programs count as stalls too.
    """

    def __init__(self) -> None:
        self.intervals: list[Interval] = []
        self._helpers: list[HelperProcess] = []

    def __enter__(self) -> Self:
        cpus = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
        self._helpers = [HelperProcess.start("gelflow.measurement.stalls", {"cpu": cpu}) for cpu in cpus]
        for helper in self._helpers:
            helper.messages.wait(_ANSWER_LIMIT)  # it has started
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        found: list[Interval] = []
        for helper in self._helpers:
            helper.messages.send("report")
            found += [(begin, end) for begin, end in helper.messages.wait(_ANSWER_LIMIT)[0]]
            helper.close()
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


def main(arguments: Sequence[str]) -> int:
    """Entry point of the watching process: sends the stalls of one CPU when its parent asks."""
    settings, parent, _ = connect_to_parent(arguments)
    if settings["cpu"] is not None:
        os.sched_setaffinity(0, {settings["cpu"]})
    raise_priority()
    stalls: list[Interval] = []
    parent.send("started")
    before = time.monotonic()
    while not select.select([parent], [], [], _SLEEP)[0]:
        now = time.monotonic()
        if now - before > _SLEEP + _SHORTEST:
            stalls.append((before, now))
        before = now
    if parent.read():
        parent.send(stalls)
        parent.wait()  # until the parent has read them and closes the link
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
