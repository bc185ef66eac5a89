"""Records by time agree with those of a reader that reads everything."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from mcap.records import ChunkIndex, Message
from tests.common.manual_clock import ManualClock

from gelflow.errors import PeerError
from gelflow.protocols import CameraImage, GripperState
from gelflow.session import SessionReader, SessionRecorder
from gelflow.session.reader import Record
from gelflow.session.time_index import TimeIndex

TOPICS = ["/left/image", "/gripper/state", "/event"]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images every 0.1 s, states every 0.02 s, an event every 2.5 s; more than ten chunks."""
    made = tmp_path_factory.mktemp("session") / "session.mcap"
    clock, rng = ManualClock(50.0), np.random.default_rng(0)
    with SessionRecorder(made, clock) as recorder:
        for number in range(500):
            clock.time = 50.0 + 0.02 * number
            if number % 5 == 0:
                recorder.image(0, CameraImage(b"\xff\xd8" + rng.bytes(9000) + b"\xff\xd9", clock.time, number))
            recorder.gripper_state(GripperState(0.03, 0.0, number, True, "idle", "", clock.time))
            if number % 125 == 0:
                recorder.event("state", {"number": number})
    return made


def everything(path: Path, topic: str) -> list[Record]:
    with SessionReader(path) as session:
        return list(session.records([topic]))


def same(found: Record | None, expected: Record | None) -> bool:
    if found is None or expected is None:
        return found is expected
    return (found.topic, found.time, found.value) == (expected.topic, expected.time, expected.value)


@pytest.mark.parametrize("topic", TOPICS)
def test_newest_and_oldest_record_of_random_times(path: Path, topic: str) -> None:
    records = everything(path, topic)
    rng = np.random.default_rng(1)
    with SessionReader(path) as session:
        index = TimeIndex(session)
        times = [*rng.uniform(index.start - 1, index.end + 1, 40), *(r.time for r in records[:5]), index.end]
        for time in map(float, times):
            before = [r for r in records if r.time <= time]
            after = [r for r in records if r.time >= time]
            assert same(index.latest(topic, time), before[-1] if before else None)
            assert same(index.first(topic, time), after[0] if after else None)


def test_records_of_an_interval_are_complete_and_in_order(path: Path) -> None:
    records = everything(path, "/gripper/state")
    with SessionReader(path) as session:
        found = TimeIndex(session).between("/gripper/state", 52.0, 53.01)
    assert [r.time for r in found] == [r.time for r in records if 52.0 <= r.time <= 53.01]
    assert len(found) == 51


def test_spread_samples_cover_the_time_from_the_beginning_on(path: Path) -> None:
    with SessionReader(path) as session:
        index = TimeIndex(session)
        rounds = list(index.spread(["/gripper/state"], index.start, index.end, 8))
    assert len(rounds) == 8
    middles = [np.mean([r.time for r in found]) for found in rounds]
    assert len(set(middles)) == 8
    first = sorted(middles[:4])
    assert max(np.diff(first)) < 2 * (60.0 - 50.0) / 4


def test_only_the_chunks_of_a_jump_are_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    real = SessionReader.chunk

    def counted(session: SessionReader, chunk: ChunkIndex) -> list[tuple[str, Message]]:
        read.append(chunk.chunk_start_offset)
        return real(session, chunk)

    monkeypatch.setattr(SessionReader, "chunk", counted)
    with SessionReader(path) as session:
        index = TimeIndex(session)
        for time in (58.3, 52.1):
            read.clear()
            assert index.latest("/left/image", time) is not None
            assert index.latest("/gripper/state", time) is not None
            assert 1 <= len(read) <= 4
        read.clear()
        assert index.latest("/left/image", 58.3) is not None
        assert not read  # from the cache


def test_a_damaged_chunk_is_counted_and_the_rest_is_found(path: Path, tmp_path: Path) -> None:
    with SessionReader(path) as session:
        summary = session.summary
        assert summary is not None
        chunk = summary.chunk_indexes[4]
        inside = session.robot_time((chunk.message_start_time + chunk.message_end_time) // 2)
    data = bytearray(path.read_bytes())
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 200] = bytes(200)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    with SessionReader(broken) as session:
        index = TimeIndex(session)
        found = index.latest("/gripper/state", inside)
        assert found is not None and found.time < inside
        assert index.damaged == 1
        assert index.latest("/gripper/state", index.end) is not None


def test_threads_read_the_same_session(path: Path) -> None:
    with SessionReader(path) as session:
        count, ended = len(list(session.records())), threading.Event()
        chunk = session.summary.chunk_indexes[3]  # type: ignore[union-attr]
        expected = session.chunk(chunk)

        def jump() -> bool:
            same = True
            while not ended.is_set():
                same = same and session.chunk(chunk) == expected
            return same

        with ThreadPoolExecutor() as threads:
            jumping = threads.submit(jump)
            try:
                counts = {len(list(session.records())) for _ in range(20)}
            finally:
                ended.set()
            assert jumping.result() and counts == {count}


def test_a_session_without_records_is_refused(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "empty.mcap", ManualClock(1.0)):
        pass
    with SessionReader(tmp_path / "empty.mcap") as session, pytest.raises(PeerError, match="no records"):
        TimeIndex(session)
