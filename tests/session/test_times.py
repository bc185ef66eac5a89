"""Times in session files: dates for viewers, robot time for readers, the own times of cameras."""

import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from gelflow.clock import ScaledClock
from gelflow.protocols import CameraImage
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.recovery import recover

CLOCK = ScaledClock(1.0)
TURN = np.array([0.5, 0.5, -0.5, 0.5])


def record_some(recorder: SessionRecorder) -> None:
    recorder.metadata({"task": {}})
    recorder.image(0, CameraImage(b"left", 10.25, 3))
    recorder.arm_command(11.5, [0.3, 0.1, 0.199], TURN, kind="command")
    recorder.event("contact")


def test_messages_have_dates_and_readers_return_robot_time(tmp_path: Path) -> None:
    path, clock = tmp_path / "a.mcap", ScaledClock(5.0)
    before, start = time.time(), clock.now()
    with SessionRecorder(path, clock) as recorder:
        record_some(recorder)
        recorder.arm_command(start + 50.0, [0.3, 0.1, 0.2], TURN, kind="command")  # 50 s of robot time after the start
    after = time.time()
    with path.open("rb") as stream:
        dates = [
            (message.log_time / 1e9, message.publish_time / 1e9)
            for _, channel, message in make_reader(stream).iter_messages(["/arm/command"])
        ]
    assert before - 0.01 <= dates[0][0] <= before + 5 * (after - before) + 0.01  # dates advance with robot time
    assert before + 49.99 <= dates[1][1] <= after + 50.01
    with SessionReader(path) as reader:
        commands = list(reader.records(["/arm/command"]))
        assert reader.epoch == pytest.approx(before - start, abs=after - before + 0.01)
        assert reader.description()["epoch"] == pytest.approx(reader.epoch)
    assert commands[0].stamp == 11.5 and commands[1].stamp == pytest.approx(start + 50.0, abs=1e-9)
    assert start <= commands[0].time <= clock.now()


def test_recovery_keeps_the_dates(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        record_some(recorder)
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:-20])
    recover(tmp_path / "cut.mcap", tmp_path / "b.mcap")
    with SessionReader(tmp_path / "a.mcap") as whole, SessionReader(tmp_path / "b.mcap") as recovered:
        assert whole.epoch == recovered.epoch > 1.6e9
        times = [
            [(record.topic, record.time, record.stamp) for record in reader.records()] for reader in (whole, recovered)
        ]
    assert times[0] == times[1]


def test_a_session_of_an_earlier_version_has_robot_time_only(tmp_path: Path) -> None:
    with (tmp_path / "old.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("gelflow", {"format": "1", "version": "0.0.9"})
        channel = writer.register_channel(
            "/event", "json", writer.register_schema("gelflow.Event", "jsonschema", b"{}")
        )
        writer.add_message(channel, 12_500_000_000, b'{"name":"tick","values":{}}', 12_250_000_000, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with SessionReader(tmp_path / "old.mcap") as reader:
        (record,) = reader.records()
    assert (record.time, record.stamp, reader.epoch) == (12.5, 12.25, 0.0)


def test_times_of_a_camera_are_joined_with_its_images(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        for number in range(3):
            recorder.image(0, CameraImage(b"left", 1.0 * number, number, camera_time=50.25 + number))
            recorder.image(1, CameraImage(b"right", 1.0 * number, number))
    with SessionReader(tmp_path / "a.mcap") as reader:
        images = [record.value for record in reader.records(["/left/image", "/right/image"])]
        timing = [record.value["camera_time"] for record in reader.records(["/left/timing"])]
    assert [image.camera_time for image in images] == [50.25, None, 51.25, None, 52.25, None]
    assert timing == [50.25, 51.25, 52.25]
