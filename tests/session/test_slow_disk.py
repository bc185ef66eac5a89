"""A disk that is slower than the recording: the recorder knows how far it is behind, and loses nothing at its end."""

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder

CLOCK = ScaledClock()


class StandingClock:
    """Robot time that stands still, as while the simulation of a mock robot is late."""

    def now(self) -> float:
        return 5.0

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def wall(self, seconds: float) -> float:
        return seconds


@pytest.mark.parametrize("slow", ["fsync", "write"])
def test_a_slow_disk_is_noticed_within_the_allowed_delay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: str
) -> None:
    """The disk stores nothing until it is released; all records are stored after that."""
    released = threading.Event()
    where, name = {"fsync": (os, "fsync"), "write": (Writer, "flush")}[slow]
    stored = getattr(where, name)

    def wait_for_disk(target: Any) -> None:
        released.wait(20)
        stored(target)

    with SessionRecorder(tmp_path / "a.mcap", CLOCK, max_delay=0.4) as recorder:
        recorder.event("first")
        recorder.attempt_end()
        recorder.check()
        monkeypatch.setattr(where, name, wait_for_disk)
        end = time.monotonic() + 20
        with pytest.raises(
            PeerTimeout, match=r"is 0\.\d s behind, at most 0\.4 s is allowed; is the disk full or slow"
        ):
            while time.monotonic() < end:
                recorder.event("tick")
                recorder.check()
                time.sleep(0.01)
        with pytest.raises(PeerTimeout, match="behind"):
            recorder.attempt_end()
        released.set()
    with SessionReader(tmp_path / "a.mcap") as reader:
        assert reader.counts()["/event"] > 10


def test_records_are_stored_while_robot_time_stands_still(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", StandingClock(), max_delay=20.0) as recorder:
        recorder.event("tick")
        end = time.monotonic() + 20
        while recorder.delay > 0 and time.monotonic() < end:
            time.sleep(0.01)
        assert recorder.delay == 0
        recorder.check()


def test_delay_is_zero_when_all_records_are_stored(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        recorder.event("tick")
        recorder.attempt_end()
        end = time.monotonic() + 20
        while recorder.delay > 0 and time.monotonic() < end:
            time.sleep(0.01)
        assert recorder.delay == 0


def test_a_record_that_is_accepted_while_the_recorder_closes_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = SessionRecorder(tmp_path / "a.mcap", CLOCK).open()
    closer = threading.Thread(target=recorder.close)
    put = recorder._queue.put_nowait

    def put_late(item: Any) -> None:
        """Queue the accepted record when the other thread has closed the recorder, as far as it gets."""
        closer.start()
        closer.join(0.5)
        put(item)

    monkeypatch.setattr(recorder._queue, "put_nowait", put_late)
    recorder.checks(5.0, [])
    closer.join()
    with SessionReader(tmp_path / "a.mcap") as reader:
        assert reader.counts() == {"/checks": 1}
