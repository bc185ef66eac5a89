"""Robot time: scaling, and synchronization with processes that must keep up."""

import itertools
import math
import os
import threading
import time
import urllib.request
from pathlib import Path

import pytest

from gelflow import time_sync
from gelflow.clock import ScaledClock, raise_priority
from gelflow.errors import UsageError
from gelflow.hardware_mocks.camera.device import MockMjpegCamera
from gelflow.time_sync import CONTROLLER, LEFT_CAMERA, MAX_LEAD, RUNNER, SIMULATED_CELL, TimeSync


@pytest.fixture
def synchronized(tmp_path: Path) -> tuple[ScaledClock, ScaledClock]:
    """Clocks of two processes of one mock robot."""
    TimeSync.create(path := str(tmp_path / "time_sync"))
    return ScaledClock(100.0, path), ScaledClock(100.0, path)


def test_without_limits_robot_time_runs_at_full_speed(synchronized: tuple[ScaledClock, ScaledClock]) -> None:
    clock, _ = synchronized
    assert clock.now() == pytest.approx(ScaledClock(100.0).now(), abs=1.0)
    assert clock.delay == 0


def test_robot_time_stops_at_the_earliest_limit_and_does_not_jump_after_it(
    synchronized: tuple[ScaledClock, ScaledClock],
) -> None:
    clock, other = synchronized
    start = clock.now()
    clock.grant(SIMULATED_CELL, start + 1.0)
    clock.grant(CONTROLLER, start + 0.5)
    time.sleep(0.02)  # two seconds of robot time
    assert clock.now() == other.now() == start + 0.5
    clock.absorb_delay()
    assert clock.delay > 1.4
    clock.grant(CONTROLLER, math.inf)
    clock.grant(SIMULATED_CELL, math.inf)
    assert start + 0.5 <= other.now() < start + 0.5 + clock.delay


def test_a_reader_that_is_interrupted_combines_numbers_of_one_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The simulation is late by 7 s while a reader is between the shared numbers and the wall clock."""
    TimeSync.create(path := str(tmp_path / "time_sync"))
    reader, writer = TimeSync(path), TimeSync(path)
    wall = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: wall)
    before = reader.now(1.0)

    def interrupted() -> float:
        nonlocal wall
        if wall == 100.0:
            wall = 108.0
            writer.grant(SIMULATED_CELL, 101.0)
            writer.absorb_delay(1.0)
            writer.grant(SIMULATED_CELL, math.inf)
        return wall

    monkeypatch.setattr(time, "monotonic", interrupted)
    during = reader.now(1.0)
    after = reader.now(1.0)
    assert before == 100.0 and writer.delay == 7.0
    assert during == after == 101.0


def test_sleep_waits_for_robot_time(synchronized: tuple[ScaledClock, ScaledClock]) -> None:
    clock, other = synchronized
    start = clock.now()
    clock.grant(SIMULATED_CELL, start + 0.1)
    sleeper = threading.Thread(target=clock.sleep, args=(1.0,))
    sleeper.start()
    sleeper.join(0.1)
    assert sleeper.is_alive()
    other.absorb_delay()
    other.grant(SIMULATED_CELL, start + 5.0)
    sleeper.join(10.0)
    assert not sleeper.is_alive() and clock.now() >= start + 1.0


class InterruptedClock(ScaledClock):
    """The process is interrupted after each reading of the clock."""

    def now(self) -> float:
        now = super().now()
        time.sleep(0.005)
        return now


def test_an_interrupted_camera_does_not_stop_robot_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited for an instant after its own limit, until it was taken for dead."""
    monkeypatch.setattr(time_sync, "_SLOT_TIMEOUT", math.inf)
    TimeSync.create(path := str(tmp_path / "time_sync"))
    number = itertools.count()
    made = threading.Event()

    def image() -> bytes:
        if next(number) == 5:
            made.set()
        return b"image"

    with (
        MockMjpegCamera(image, InterruptedClock(10.0, path), rate=3.0, slot=LEFT_CAMERA) as camera,
        urllib.request.urlopen(camera.url, timeout=20.0),
    ):
        assert made.wait(20.0)


def test_robot_time_waits_for_a_bounded_block(synchronized: tuple[ScaledClock, ScaledClock]) -> None:
    clock, other = synchronized
    with clock.bounded(RUNNER) as renew:
        start = clock.now()
        time.sleep(0.02)  # two seconds of robot time
        assert other.now() <= start + MAX_LEAD
        with clock.bounded(RUNNER):
            pass
        time.sleep(0.02)  # the outer block still holds robot time
        assert other.now() <= start + 3 * MAX_LEAD  # one for its start, one for its end
        renew()
        time.sleep(0.02)
        assert start + MAX_LEAD < other.now() <= start + 4 * MAX_LEAD
    time.sleep(0.02)
    assert other.now() > start + 1.0


def test_a_slot_without_grants_is_ignored_after_its_timeout(
    synchronized: tuple[ScaledClock, ScaledClock], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, _ = synchronized
    limit = clock.now()
    clock.grant(SIMULATED_CELL, limit)
    real = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: real() + 16.0)
    assert clock.now() == pytest.approx(limit + 100.0, abs=20.0)


def test_an_interrupted_grant_does_not_set_robot_time_back(tmp_path: Path) -> None:
    TimeSync.create(path := str(tmp_path / "time_sync"))
    reader, writer = TimeSync(path), TimeSync(path)
    limit = writer.now(100.0)
    time.sleep(0.01)  # a second of robot time, until the limit is written
    before = reader.now(100.0)
    writer.grant(RUNNER, limit)
    assert before > limit and reader.now(100.0) == before
    writer.grant(RUNNER, math.inf)
    assert reader.now(100.0) > before


def test_robot_time_is_monotonic_under_concurrent_grants(synchronized: tuple[ScaledClock, ScaledClock]) -> None:
    clock, other = synchronized
    ending = threading.Event()

    def world() -> None:
        done = other.now()
        while not ending.is_set():
            other.absorb_delay()
            other.grant(SIMULATED_CELL, done + 0.02)
            done = max(done, other.now())

    writer = threading.Thread(target=world)
    writer.start()
    reader, times = TimeSync(clock.time_sync), []
    for _ in range(20000):
        reader._newest = -math.inf  # as in a process that has read no earlier time
        times.append(reader.now(clock.factor))
    ending.set()
    writer.join()
    assert all(b >= a - 1e-9 for a, b in itertools.pairwise(times))


def test_a_missing_time_sync_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no mock robot behind"):
        ScaledClock(1.0, str(tmp_path / "gone"))


@pytest.mark.parametrize("content", [b"the only copy of something\n" * 5, bytes(8 * time_sync._WORDS)])
def test_a_file_that_is_none_of_a_mock_robot_is_not_changed(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "precious.txt"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="there is no mock robot behind"):
        ScaledClock(1.0, str(path))
    assert path.read_bytes() == content


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="this system has no real-time priority")
def test_raised_priority_is_that_of_the_calling_thread_alone() -> None:
    policies: list[int] = []

    def started() -> None:
        policies.append(os.sched_getscheduler(0))

    def raising() -> None:
        raised = raise_priority()
        policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK if raised else os.SCHED_FIFO)
        thread = threading.Thread(target=started)
        thread.start()
        thread.join()

    thread = threading.Thread(target=raising)
    thread.start()
    thread.join()
    assert policies == [os.SCHED_FIFO, os.SCHED_OTHER] and os.sched_getscheduler(0) == os.SCHED_OTHER
