"""Recovery of sessions whose recorder was killed or whose file is damaged."""

import signal
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from gelflow.cli.main import main
from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, UsageError
from gelflow.protocols import CameraImage
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.recovery import recover
from gelflow.session.time_index import TimeIndex

CLOCK = ScaledClock(1.0)

KILLED = """
import os, signal, sys
from gelflow.clock import ScaledClock
from gelflow.protocols import CameraImage
from gelflow.session.recorder import SessionRecorder
clock = ScaledClock()
recorder = SessionRecorder(sys.argv[1], clock).open()
recorder.metadata({"who": "killed"})
for number in range(1, 501):
    clock.sleep(0.004)
    recorder.image(number % 2, CameraImage(os.urandom(5000), clock.now(), number))
print(clock.now(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_at_message_500_loses_at_most_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == -signal.SIGKILL, done.stderr
    with pytest.raises(PeerError, match=r"is not finished.*gelflow recover .*killed\.mcap"):
        SessionReader(path).open()
    report = recover(path, tmp_path / "saved.mcap")
    with SessionReader(report.path) as reader:
        assert reader.description()["who"] == "killed"
        images = list(reader.records(["/left/image", "/right/image"]))
    assert [record.value.sequence for record in images] == list(range(1, len(images) + 1))
    assert all(len(record.value.data) == 5000 for record in images)
    assert float(done.stdout) - images[-1].stamp <= 0.5
    assert report.messages == len(images) + 1 and report.damaged_chunks == 0


def make(path: Path, messages: int = 40) -> Path:
    with SessionRecorder(path, CLOCK) as recorder:
        recorder.metadata({"who": "test"})
        for number in range(messages):
            recorder.image(0, CameraImage(np.random.default_rng(number).bytes(9000), 1.0 * number, number))
    return path


def test_a_file_cut_anywhere_is_recovered_up_to_the_cut(tmp_path: Path) -> None:
    whole = make(tmp_path / "whole.mcap").read_bytes()
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    found = []
    for length in np.linspace(8, len(whole) - 1, 60).astype(int):
        cut.write_bytes(whole[:length])
        saved.unlink(missing_ok=True)
        try:
            report = recover(cut, saved)
        except PeerError as error:
            assert "no complete message" in str(error)
            assert not saved.exists()
            found.append(0)
            continue
        with SessionReader(saved) as reader:
            records = list(reader.records())
        assert len(records) == report.messages
        assert [r.value.sequence for r in records[1:]] == list(range(len(records) - 1))
        found.append(len(records))
    assert found == sorted(found) and found[0] == 0 and found[-1] == 41
    assert list(tmp_path.glob("*.part")) == []


def test_damage_in_a_finished_file_is_reported_and_the_rest_recovered(tmp_path: Path) -> None:
    path = make(tmp_path / "session.mcap")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with SessionReader(path) as reader, pytest.raises(PeerError, match=r"is damaged.*gelflow recover") as caught:
        list(reader.records())
    assert "\n" not in str(caught.value)
    report = recover(path, tmp_path / "saved.mcap")
    assert report.damaged_chunks == 1 and 25 < report.messages < 41
    with SessionReader(report.path) as reader:
        assert len(list(reader.records())) == report.messages


def test_damaged_channels_are_recovered_from_the_end_of_the_file(tmp_path: Path) -> None:
    path = make(tmp_path / "session.mcap")
    data = bytearray(path.read_bytes())
    data[500] ^= 0xFF  # in the first chunk, which has all schemas and channels
    path.write_bytes(data)
    report = recover(path, tmp_path / "saved.mcap")
    assert report.damaged_chunks == 1 and 25 < report.messages < 41
    with SessionReader(report.path) as reader:
        assert len(list(reader.records(["/left/image"]))) == report.messages


@pytest.mark.parametrize("damage", ["name", "number", "length"])
def test_damaged_metadata_are_restored_from_the_description(tmp_path: Path, damage: str) -> None:
    path = make(tmp_path / "session.mcap")
    with SessionReader(path) as reader:
        epoch, before = reader.epoch, [record.time for record in reader.records()]
    data = bytearray(path.read_bytes())
    name = data.index(b"gelflow", data.index(b"\x0c", 8))  # 0x0c: a metadata record
    place = {"name": name, "number": data.index(b"format", name) + 10, "length": name - 8}[damage]
    data[place] = ord("x") if damage != "length" else 0xFF
    path.write_bytes(data)
    report = recover(path, tmp_path / "saved.mcap")
    with SessionReader(report.path) as reader:
        assert reader.description()["who"] == "test" and reader.epoch == pytest.approx(epoch, abs=1e-6)
        assert [record.time for record in reader.records()] == pytest.approx(before, abs=1e-6)
    assert report.messages == 41


def test_another_programs_file_is_no_session(tmp_path: Path) -> None:
    with (tmp_path / "other.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/session", "json", 0)
        writer.add_message(channel, 5, b"[1]", 5, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(UsageError, match="name a session recorded by gelflow"):
        recover(tmp_path / "other.mcap", tmp_path / "saved.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["other.mcap"]


@pytest.mark.parametrize("wrong", ["position", "channel"])
def test_damage_in_the_index_costs_no_other_records(tmp_path: Path, wrong: str) -> None:
    path = make(tmp_path / "session.mcap")
    with SessionReader(path) as reader:
        assert reader.summary is not None
        chunk = reader.summary.chunk_indexes[3]
    data = path.read_bytes()
    channel, position = next(iter(chunk.message_index_offsets.items()))
    entry = struct.pack("<HQ", channel, position)
    old = struct.pack("<Q", chunk.chunk_start_offset) if wrong == "position" else entry
    new = struct.pack("<Q", 1 << 62) if wrong == "position" else struct.pack("<HQ", 0xFFFF, position)
    head, _, tail = data.rpartition(old)
    path.write_bytes(head + new + tail)
    damage = Damage()
    with SessionReader(path) as reader:
        images = list(reader.records(["/left/image"], damage=damage))
        assert len(TimeIndex(reader).between("/left/image", -1e9, 1e9)) == len(images) == 40 - damage.records
        if wrong == "channel":
            assert not damage
            return
        with pytest.raises(PeerError, match="is damaged"):
            list(reader.records())
    assert damage.chunks == 1 and len(images) > 25
    assert recover(path, tmp_path / "saved.mcap").messages == 41


@pytest.mark.parametrize("fill", [b"\0", b"\xff"])
def test_damage_of_record_headers_costs_only_the_records_up_to_the_next_chunk(tmp_path: Path, fill: bytes) -> None:
    """From the end of a chunk, over its message index, to the header of the following chunk."""
    path = make(tmp_path / "session.mcap")
    with SessionReader(path) as reader:
        assert reader.summary is not None
        first, second, third = reader.summary.chunk_indexes[1:4]
        lost = sum(len(reader.chunk(chunk)) for chunk in (first, second))
    data = bytearray(path.read_bytes())
    begin, end = first.chunk_start_offset + first.chunk_length, second.chunk_start_offset + 9
    data[begin - 200 : end] = fill * (end - begin + 200)
    path.write_bytes(data)
    report = recover(path, tmp_path / "saved.mcap")
    assert (report.messages, report.damaged_chunks) == (41 - lost, 1)
    assert report.lost_bytes == third.chunk_start_offset - begin


def test_zeros_at_the_end_of_an_unfinished_file_are_lost_bytes(tmp_path: Path) -> None:
    """As a power cut leaves them."""
    path = make(tmp_path / "session.mcap")
    with SessionReader(path) as reader:
        assert reader.summary is not None
        chunks = reader.summary.chunk_indexes
        kept = sum(len(reader.chunk(chunk)) for chunk in chunks[:3])
    path.write_bytes(path.read_bytes()[: chunks[3].chunk_start_offset] + bytes(5000))
    report = recover(path, tmp_path / "saved.mcap")
    assert (report.messages, report.lost_bytes) == (kept, 5000)


def test_a_reader_goes_on_past_damaged_chunks_and_counts_them(tmp_path: Path) -> None:
    path = make(tmp_path / "session.mcap")
    data = bytearray(path.read_bytes())
    for place in (len(data) // 3, 2 * len(data) // 3):
        data[place] ^= 0xFF
    path.write_bytes(data)
    damage = Damage()
    with SessionReader(path) as reader:
        images = [record.value.sequence for record in reader.records(["/left/image"], damage=damage)]
        everything = Damage()
        assert len(list(reader.records(damage=everything))) == len(images) + 1
    lost = sorted(set(range(40)) - set(images))
    assert damage.chunks == 2 and damage.records == len(lost) == everything.records
    assert images == sorted(images) and len(lost) <= 2 * 8 and lost[0] > 5 and lost[-1] < 35


def test_records_that_cannot_be_decoded_are_passed_over_and_counted(tmp_path: Path) -> None:
    with (tmp_path / "odd.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("gelflow", {"format": "1", "version": "1"})
        for topic, contents in [("/event", [b"{}", b"{broken", b"[1]", b"{}"]), ("/decision", [b'{"insertion": 0}'])]:
            schema = writer.register_schema(topic, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for data in contents:
                writer.add_message(channel, 5, data, 5, 0)
        foreign = writer.register_channel("/other/timing", "", 0)
        writer.add_message(foreign, 6, b"of another program", 6, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    damage = Damage()
    with SessionReader(tmp_path / "odd.mcap") as reader:
        assert [record.topic for record in reader.records(damage=damage)] == ["/event", "/event", "/other/timing"]
        with pytest.raises(PeerError, match="is damaged: a record of /event cannot be read") as caught:
            list(reader.records())
        assert "gelflow recover" not in str(caught.value)  # which would copy it as it is
    assert (damage.chunks, damage.records) == (0, 3)


def test_records_after_the_reader_is_closed_are_no_damage(tmp_path: Path) -> None:
    damage = Damage()
    with SessionReader(make(tmp_path / "session.mcap")) as reader:
        records = reader.records(damage=damage)
        next(records)
    with pytest.raises(UsageError, match="not open"):
        list(records)
    assert not damage


@pytest.mark.parametrize("seed", range(20))
def test_random_damage_raises_gelflow_errors_only(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = make(tmp_path / "session.mcap", messages=12)
    data = bytearray(path.read_bytes())
    for place in rng.integers(8, len(data), 3):
        data[place : place + 8] = rng.bytes(8)
    path.write_bytes(data[: len(data) if seed % 2 else rng.integers(9, len(data))])
    try:
        with SessionReader(path) as reader:
            list(reader.records(damage=Damage()))
            list(reader.records())
    except (PeerError, UsageError):
        pass
    try:
        recover(path, tmp_path / "saved.mcap")
    except (PeerError, UsageError):
        return
    with SessionReader(tmp_path / "saved.mcap") as reader:
        list(reader.records())


def test_undamaged_files_and_wrong_paths_are_rejected(tmp_path: Path) -> None:
    path = make(tmp_path / "session.mcap", messages=3)
    with pytest.raises(UsageError, match="nothing to recover"):
        recover(path, tmp_path / "saved.mcap")
    (tmp_path / "saved.mcap").touch()
    with pytest.raises(UsageError, match="--out"):
        recover(path, tmp_path / "saved.mcap")
    (tmp_path / "text").write_text("text")
    with pytest.raises(UsageError, match="is not an MCAP file"):
        recover(tmp_path / "text", tmp_path / "new.mcap")
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(UsageError, match="cannot write"):
        recover(path, tmp_path / "no folder" / "new.mcap")
    with pytest.raises(UsageError, match="cannot write"):
        recover(path, tmp_path / "text" / "new.mcap")


def test_no_other_file_is_replaced(tmp_path: Path) -> None:
    """Neither that of another recovery, nor a link to nowhere."""
    path = make(tmp_path / "session.mcap", messages=3)
    path.write_bytes(path.read_bytes()[:-50])
    (tmp_path / "saved.mcap.part").write_text("of another recovery")
    with pytest.raises(UsageError, match=r"saved\.mcap\.part exists: another recovery writes it"):
        recover(path, tmp_path / "saved.mcap")
    assert (tmp_path / "saved.mcap.part").read_text() == "of another recovery"
    (tmp_path / "link.mcap").symlink_to(tmp_path / "nowhere" / "x")
    with pytest.raises(UsageError, match=r"link\.mcap exists"):
        recover(path, tmp_path / "link.mcap")
    assert (tmp_path / "link.mcap").is_symlink()


def test_a_name_with_spaces_is_quoted_in_the_advice(tmp_path: Path) -> None:
    path = make(tmp_path / "my session [1].mcap", messages=3)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(PeerError, match=r"gelflow recover '.*my session \[1\]\.mcap'"):
        SessionReader(path).open()


def test_a_session_in_progress_is_rejected(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        recorder.attempt_end({"insertion": 0})
        with pytest.raises(PeerError, match="still being recorded"):
            SessionReader(tmp_path / "a.mcap").open()
        with pytest.raises(UsageError, match="still being recorded"):
            recover(tmp_path / "a.mcap", tmp_path / "b.mcap")


def test_the_recover_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = make(tmp_path / "session.mcap", messages=20)
    assert main(["recover", str(path)]) == 2
    assert "nothing to recover" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[:-5000])
    assert main(["recover", str(path)]) == 0
    assert "21 records" in (out := capsys.readouterr().out) and "bytes" in out
    with SessionReader(tmp_path / "session.recovered.mcap") as reader:
        assert reader.counts() == {"/session": 1, "/left/image": 20}
    assert main(["recover", str(tmp_path / "none.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
