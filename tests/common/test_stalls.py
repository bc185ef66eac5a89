"""Stalls of the computer: found where a process is kept from running, joined over the CPUs."""

import os
import signal
import time

import pytest

from gelflow.measurement.stalls import StallWatch, overlaps, united


def test_intervals_are_united() -> None:
    assert united([(5.0, 6.0), (1.0, 2.0), (1.5, 3.0), (3.0, 3.5)]) == [(1.0, 3.5), (5.0, 6.0)]


@pytest.mark.parametrize(("interval", "expected"), [((0.0, 0.9), False), ((0.5, 1.0), True), ((2.1, 3.0), False)])
def test_overlap(interval: tuple[float, float], expected: bool) -> None:
    assert overlaps(interval, [(1.0, 2.0)]) is expected


def test_a_stopped_watcher_reports_a_stall() -> None:
    with StallWatch() as watch:
        pid = watch._helpers[0].pid
        begin = time.monotonic()
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.2)
        os.kill(pid, signal.SIGCONT)
        end = time.monotonic()
        time.sleep(0.1)
    assert overlaps((begin, end), [(a, b) for a, b in watch.intervals if b - a > 0.15])
