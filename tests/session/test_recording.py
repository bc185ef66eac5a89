"""Session files: written by the recorder, read by gelflow and by the libraries of the format."""

import contextlib
import json
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, UsageError
from gelflow.geometry import Pose
from gelflow.observation import FlowMap
from gelflow.protocols import ArmState, CameraImage, GripperState
from gelflow.session.channels import JSON
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import Decision, describe_session, from_plain, to_json, to_plain
from gelflow.session.recovery import recover
from gelflow.task import INSERTION

CLOCK = ScaledClock(1.0)
TURN = np.array([0.5, 0.5, -0.5, 0.5])


def a_decision(insertion: int = 0, attempt: int = 0) -> Decision:
    rng = np.random.default_rng(attempt)
    image = rng.normal(size=(4, 13, 10)).astype(np.float32)
    observation = FlowMap(image, 0.1 + 0.2, "mm", np.zeros((2, 13, 10), dtype=bool))
    return Decision.of(
        observation,
        insertion=insertion,
        attempt=attempt,
        tracked=((3, 4, 7), (2, 5)),
        reference=(3, 2),
        frames=((7, 5),),
        action=rng.normal(size=3) * 1e-3,
        correction=np.array([0.1, 0.2, 0.3]),
        depths=(0.0, 1.1e-3),
    )


MARKERS = {
    "rows": 1,
    "cols": 2,
    "spacing_px": 22.0,
    "position_px": np.array([[1.0, 2.0], [23.0, 2.5]]),
    "displacement_px": np.array([[0.5, 0.0], [np.nan, np.nan]]),
    "valid": np.array([True, False]),
    "inferred": np.array([False, False]),
    "quality": np.array([0.9, 0.0]),
}


FORCE = {
    "contact": True,
    "shear": np.array([0.5, -0.1]),
    "shear_deviation": np.array([0.02, 0.01]),
    "normal": 2.0,
    "normal_deviation": 0.1,
}


def record_everything(recorder: SessionRecorder) -> None:
    recorder.metadata(describe_session(task=INSERTION, trackers=[{}, {}], mounts=[{}, {}], lab={"arm": {"port": 6510}}))
    recorder.image(0, CameraImage(b"\xff\xd8left\xff\xd9", 10.25, 3, camera_time=1.7e9))
    recorder.image(1, CameraImage(b"png", 10.5, 2, "png"))
    joints = np.arange(6) / 7
    for sensor in (0, 1):
        recorder.markers(sensor, 10.75, MARKERS)
        recorder.force(sensor, 10.75, FORCE)
    recorder.arm_state(ArmState(np.array([0.3, 0.1, 0.2]), TURN, joints, 11.0, True, True, "auto", ""))
    recorder.arm_command(11.5, [0.3, 0.1, 0.199], TURN, kind="command")
    recorder.arm_command(11.6, [0.3, 0.1, 0.1995], TURN, kind="applied")
    recorder.gripper_state(GripperState(0.021, 0.0, float("nan"), True, "holding", "", 12.0))
    recorder.gripper_command(12.5, "grasp", {"width": 0.02, "speed": 0.02, "force": 15.0})
    recorder.checks(12.75, [{"name": "arm", "ok": True, "text": "motors on"}])
    recorder.decision(a_decision().to_json())
    recorder.event("contact", {"shear_mm": np.float32(0.25), "path": Path("a/b")})
    recorder.attempt_end({"insertion": 0, "attempt": 0, "outcome": "missed"})


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "new folder" / "session.mcap"
    with SessionRecorder(path, CLOCK) as recorder:
        record_everything(recorder)
    return path


def test_all_records_are_read_back(session: Path) -> None:
    with SessionReader(session) as reader:
        records = list(reader.records())
        by_topic = {record.topic: record for record in records}
        assert reader.counts() == dict.fromkeys(by_topic, 1) and len(records) == len(by_topic)
        description = reader.description()
    times = [record.time for record in records]
    assert times == sorted(times)
    left = by_topic["/left/image"]
    assert left.stamp == 10.25
    assert left.value == CameraImage(b"\xff\xd8left\xff\xd9", 10.25, 3, camera_time=1.7e9)
    assert by_topic["/right/image"].value == CameraImage(b"png", 10.5, 2, "png")
    for topic, z in [("/arm/pose", 0.2), ("/arm/command", 0.199), ("/arm/applied", 0.1995)]:
        pose = by_topic[topic].value
        assert isinstance(pose, Pose)
        assert pose.position.tolist() == [0.3, 0.1, z] and pose.quaternion.tolist() == TURN.tolist()
    assert by_topic["/right/markers"].value["displacement_px"] == [[0.5, 0.0], ["NaN", "NaN"]]
    assert by_topic["/arm/joints"].value == {f"joint_{i + 1}": i / 7 for i in range(6)}
    assert by_topic["/arm/status"].value["operating_mode"] == "auto"
    assert by_topic["/gripper/state"].value["force"] == "NaN"
    assert by_topic["/gripper/command"].value["values"]["force"] == 15.0
    assert by_topic["/event"].value["values"] == {"shear_mm": 0.25, "path": "a/b"}
    assert by_topic["/attempt"].value["outcome"] == "missed"
    read, made = by_topic["/decision"].value, a_decision()
    assert read.flow.dtype == np.float32 and np.array_equal(read.flow, made.flow)
    assert np.array_equal(read.action, made.action) and read.divisor == made.divisor
    assert (read.tracked, read.reference, read.frames) == (made.tracked, made.reference, made.frames)
    assert description["format"] == 1 and description["task"] == INSERTION.to_json()
    assert description["lab"] == {"arm": {"port": 6510}} and "numpy" in description["versions"]


def test_the_mcap_library_and_the_foxglove_schemas_agree(session: Path) -> None:
    with session.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages: dict[str, tuple[Any, Any]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
            messages[channel.topic] = (schema, decoder(message.data) if decoder else json.loads(message.data))
    expected = {
        "/left/image": "foxglove.CompressedImage",
        "/left/annotations": "foxglove.ImageAnnotations",
        "/arm/pose": "foxglove.PoseInFrame",
        "/arm/joints": "foxglove.JointStates",
        "/tf": "foxglove.FrameTransform",
        "/flow_map": "foxglove.RawImage",
        "/log": "foxglove.Log",
    }
    assert {topic: messages[topic][0].name for topic in expected} == expected
    image = messages["/left/image"][1]
    assert (image.format, image.frame_id) == ("jpeg", "left_gel")
    with SessionReader(session) as described:
        assert image.timestamp.ToNanoseconds() / 1e9 == pytest.approx(10.25 + described.epoch, abs=1e-6)
    motion, measured, inferred = ([(p.x, p.y) for p in part.points] for part in messages["/left/annotations"][1].points)
    assert (motion, measured, inferred) == ([(1.0, 2.5), (1.5, 2.5)], [(1.5, 2.5)], [])
    transform = messages["/tf"][1]
    assert (transform.rotation.w, transform.rotation.z, transform.translation.x) == (0.5, 0.5, 0.3)
    picture = messages["/flow_map"][1]
    assert (picture.height, picture.width, picture.step, picture.encoding) == (13, 40, 160, "32FC1")
    values = np.frombuffer(picture.data, "<f4").reshape(13, 4, 10).transpose(1, 0, 2)
    assert np.array_equal(values, a_decision().flow)
    for topic in set(JSON) - {"/right/timing"}:  # the right camera sends no time of its own
        schema, value = messages[topic]
        described = json.loads(schema.data)
        assert schema.encoding == "jsonschema" and described["type"] == "object"
        assert set(described["required"]) <= set(value)


def test_chunks_are_small(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        for number in range(50):
            recorder.image(0, CameraImage(np.random.default_rng(number).bytes(20_000), 1.0, number))
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert max(chunk.uncompressed_size for chunk in summary.chunk_indexes) < 64 * 1024 + 21_000


def test_attempt_end_stores_all_records(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        for number in range(300):
            recorder.event("tick", {"number": number})
        recorder.attempt_end()
        shutil.copy(tmp_path / "a.mcap", tmp_path / "copy.mcap")
    assert recover(tmp_path / "copy.mcap", tmp_path / "b.mcap").messages == 600  # each event is also a line of the log


def test_records_are_flushed_periodically(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", ScaledClock(5.0)) as recorder:
        recorder.event("tick")
        given_up = time.monotonic() + 20
        found = 0
        while not found and time.monotonic() < given_up:
            time.sleep(0.05)
            shutil.copy(tmp_path / "a.mcap", tmp_path / "copy.mcap")
            with contextlib.suppress(PeerError):  # no complete message yet
                found = recover(tmp_path / "copy.mcap", tmp_path / "b.mcap").messages
    assert found in (1, 2)  # the event, and its line of the log


def test_many_threads_record_concurrently(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:

        def work(sensor: int) -> None:
            for number in range(200):
                recorder.image(sensor, CameraImage(bytes(1000), CLOCK.now(), number))
                recorder.event("tick", {"sensor": sensor, "number": number})

        threads = [threading.Thread(target=work, args=(sensor,)) for sensor in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with SessionReader(tmp_path / "a.mcap") as reader:
        assert reader.counts() == {"/left/image": 200, "/right/image": 200, "/event": 400, "/log": 400}
        assert [r.value.sequence for r in reader.records(["/left/image"])] == list(range(200))


class StuckClock(ScaledClock):
    """Blocks the writer thread, like a disk that does not respond."""

    free = threading.Event()

    def now(self) -> float:
        if threading.current_thread().name == "recorder":
            self.free.wait(20)
        return super().now()


def test_a_full_queue_raises_in_every_later_call(tmp_path: Path) -> None:
    recorder = SessionRecorder(tmp_path / "a.mcap", StuckClock(), queue_size=10).open()
    with pytest.raises(PeerError, match="10 records wait") as caught:
        for _ in range(11):
            recorder.event("tick")
    assert "\n" not in str(caught.value) and "gelflow recover" in str(caught.value)
    for _ in range(2):
        with pytest.raises(PeerError, match="10 records wait"):
            recorder.event("tick")
    StuckClock.free.set()
    with pytest.raises(PeerError, match="10 records wait"):
        recorder.close()


FULL_DISK = """
import resource, sys
from gelflow.clock import ScaledClock
from gelflow.errors import PeerError
from gelflow.protocols import CameraImage
from gelflow.session.recorder import SessionRecorder
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
recorder = SessionRecorder(sys.argv[1], ScaledClock()).open()
import os
try:
    for number in range(100):
        recorder.image(0, CameraImage(os.urandom(10_000), 1.0, number))
        recorder.attempt_end()
except PeerError as error:
    print(number, error)
"""


def test_a_full_disk_is_reported_at_once(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path / "a.mcap")], capture_output=True, text=True, timeout=60
    )
    number, _, message = done.stdout.strip().partition(" ")
    assert 10 < int(number) < 25 and "File too large" in message and done.stderr == ""


def test_an_exception_closes_the_file_and_is_reraised(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        recorder.event("tick")
        raise KeyboardInterrupt
    with SessionReader(tmp_path / "a.mcap") as reader:
        assert reader.counts() == {"/event": 1, "/log": 1}


def test_misuse_of_the_recorder_raises_usage_errors(tmp_path: Path) -> None:
    recorder = SessionRecorder(tmp_path / "a.mcap", CLOCK)
    assert not recorder.path.exists()
    with pytest.raises(UsageError, match="not open"):
        recorder.event("early")
    with recorder:
        with pytest.raises(UsageError, match="sensor must be 0"):
            recorder.image(2, CameraImage(b"", 0.0, 0))
        for sequence in (-1, 2**32):
            with pytest.raises(UsageError, match=f"sequence number .*, got {sequence}"):
                recorder.image(0, CameraImage(b"", 0.0, sequence))
        with pytest.raises(UsageError, match="must be finite, got nan"):
            recorder.image(0, CameraImage(b"", float("nan"), 0))
        with pytest.raises(UsageError, match="expected 3 numbers"):
            recorder.arm_command(0.0, [1, 2], TURN, kind="command")
        with pytest.raises(UsageError, match="'command' or 'applied'"):
            recorder.arm_command(0.0, [1, 2, 3], TURN, kind="wish")
        with pytest.raises(UsageError, match="lacks 'attempt'"):
            recorder.decision({"insertion": 0} | {k: v for k, v in a_decision().to_json().items() if k != "attempt"})
        with pytest.raises(UsageError, match="cannot contain a set"):
            recorder.event("bad", {"values": {1, 2}})
        with pytest.raises(UsageError, match="cannot contain a set"):
            recorder.metadata({"lab": {1, 2}})
        recorder.metadata({})
        with pytest.raises(UsageError, match="once"):
            recorder.metadata({})
        with pytest.raises(UsageError, match="never overwrites"):
            SessionRecorder(tmp_path / "a.mcap", CLOCK).open()
    recorder.close()
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot create"):
        SessionRecorder(tmp_path / "file" / "a.mcap", CLOCK).open()


def test_a_decision_that_cannot_be_recomputed_is_rejected() -> None:
    good = a_decision().to_json()
    changes: list[tuple[dict[str, Any], str]] = [
        ({"reference": [9, 2]}, "image 9 of sensor 0 in reference was never tracked"),
        ({"frames": [[7, 5], [4, 4]]}, "image 4 of sensor 1"),
        ({"frames": []}, "at least one frame"),
        ({"reference": [3]}, "reference has 1 images"),
        ({"flow_shape": [1, 2, 3]}, "reshape"),
    ]
    for change, message in changes:
        with pytest.raises(PeerError, match=message):
            Decision.from_json(good | change)


# Wrong files


def write_foreign(path: Path, metadata: dict[str, str] | None) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        if metadata is not None:
            writer.add_metadata("gelflow", metadata)
        writer.finish()  # type: ignore[no-untyped-call]


def test_wrong_files_are_rejected_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello, this is a text file")
    (tmp_path / "empty.mcap").touch()
    write_foreign(tmp_path / "foreign.mcap", None)
    write_foreign(tmp_path / "newer.mcap", {"format": "2"})
    write_foreign(tmp_path / "odd.mcap", {"version": "?"})
    for name, kind, message in [
        ("missing.mcap", UsageError, "No such file"),
        (".", UsageError, "Is a directory"),
        ("text.mcap", UsageError, "is not an MCAP file"),
        ("empty.mcap", UsageError, "is not an MCAP file"),
        ("foreign.mcap", UsageError, "not a gelflow session"),
        ("newer.mcap", UsageError, "has session format 2; this gelflow reads format 1"),
        ("odd.mcap", PeerError, "damaged"),
    ]:
        with pytest.raises(kind, match=message) as caught:
            SessionReader(tmp_path / name).open()
        assert "\n" not in str(caught.value) and name in str(caught.value)


def test_a_session_without_description_and_unknown_topics(tmp_path: Path) -> None:
    SessionRecorder(tmp_path / "a.mcap", CLOCK).open().close()
    with SessionReader(tmp_path / "a.mcap") as reader:
        assert list(reader.records()) == [] and reader.counts() == {}
        with pytest.raises(PeerError, match="no session description"):
            reader.description()
        with pytest.raises(UsageError, match="/left/image"):
            list(reader.records(["/camera"]))
        with pytest.raises(UsageError, match=r"give \['/event'\]"):
            list(reader.records("/event"))
    with pytest.raises(UsageError, match="not open"):
        reader.counts()


# Plain data

NUMBERS = st.floats(width=64) | st.integers(-(2**60), 2**60)


@settings(max_examples=50)
@given(st.recursive(NUMBERS | st.text() | st.booleans() | st.none(), lambda inner: st.lists(inner, max_size=4)))
def test_plain_data_is_restored_bit_for_bit(value: Any) -> None:
    assert repr(json.loads(to_json(value))) == repr(to_plain(value))


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_single_precision_is_restored_exactly(value: float) -> None:
    (back,) = json.loads(to_json(np.array([value], dtype=np.float32)))
    assert np.float32(back).tobytes() == np.float32(value).tobytes()


def test_dataclasses_are_restored() -> None:
    from gelflow.observation import Grid

    grid = Grid(3, 4, 1.5, (1.0, 2.0))
    assert from_plain(Grid, json.loads(to_json(grid)), what="grid") == grid
    for wrong, message in [({"rowz": 3}, "unknown keys"), ([1], "expected the keys"), ({"rows": 0}, "missing|rows")]:
        with pytest.raises(UsageError, match=message):
            from_plain(Grid, wrong, what="grid")
