"""Reader of finished session files: records in the order of recording."""

import dataclasses
import fcntl
import json
import shlex
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex, Message
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from gelflow.errors import PeerError, UsageError
from gelflow.geometry import Pose
from gelflow.protocols import CameraImage
from gelflow.session.channels import JSON, PROTOBUF
from gelflow.session.messages import READ_ERRORS, Damage, chunk_messages, expected_records, ordered_messages
from gelflow.session.records import FORMAT, SENSORS, Decision

RECOVERED = "gelflow recovered"  # name of the metadata of a recovered session


@dataclass(frozen=True)
class Record:
    """One record.

    The type of `value` depends on the topic: `CameraImage`, `Pose` in the robot's base frame, `Decision`, joint angles
    [rad] by name (dict), an object (dict) of a JSON topic, or the protobuf message of another standard schema, whose
    timestamp is a date (`SessionReader.epoch` later than robot time).
    """

    topic: str
    time: float  # of the recording, robot time [s]
    stamp: float  # of the measurement or command, robot time [s]
    value: Any


class NotASession(UsageError):
    """An MCAP file without the metadata of a session."""


class SessionReader:
    """Reads the session at `path`. Use it as a context manager, or call `open` and `close`."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.epoch = 0.0  # date of the robot time 0 as seconds since 1970; 0 in files that contain no dates
        self._epoch = 0  # the same [ns]
        self.lost_chunks = 0  # damaged parts of the source of a recovered session, whose records are missing here
        self._stream: BinaryIO | None = None
        self._reader: SeekingReader | None = None

    def open(self) -> "SessionReader":
        """Open and check the file.

        Raises UsageError when the file is missing, is not a gelflow session or has a newer format, and PeerError when
        it is unfinished or damaged (`gelflow recover` then copies its complete records).
        """
        stream = open_recording(self.path)
        try:
            if not is_finished(stream):
                raise PeerError(self._unfinished(stream))
            self._reader = SeekingReader(stream, validate_crcs=True)
            self._check_format(self._reader)
        except READ_ERRORS as error:
            stream.close()
            if isinstance(error, UsageError):
                raise
            raise self._damaged(error) from error
        except PeerError:
            stream.close()
            raise
        self._stream = stream
        return self

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = self._reader = None

    def __enter__(self) -> "SessionReader":
        return self if self._stream is not None else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def description(self) -> dict[str, Any]:
        """The description written by `SessionRecorder.metadata`. Raises PeerError when the session has none."""
        for record in self.records(["/session"]):
            return dict(record.value)
        raise PeerError(f"{self.path} has no session description: it was recorded without `SessionRecorder.metadata`")

    def counts(self) -> dict[str, int]:
        """Number of records per topic; topics without records are omitted."""
        summary = self._opened().get_summary()
        if summary is None or summary.statistics is None:
            return {}
        counts = summary.statistics.channel_message_counts
        return {channel.topic: counts[key] for key, channel in summary.channels.items() if counts.get(key)}

    def records(self, topics: Collection[str] | None = None, *, damage: Damage | None = None) -> Iterator[Record]:
        """All records, or those of `topics`, in the order of recording.

        Raises UsageError for an unknown topic and when the reader is closed, and PeerError where the file is damaged.
        With `damage`, the reader continues after damaged records and adds their number to it.
        """
        if isinstance(topics, str):
            raise UsageError(f"topics must be a list, got a text; give [{topics!r}]")
        if topics is not None and (unknown := set(topics) - set(PROTOBUF) - set(JSON)):
            known = ", ".join([*PROTOBUF, *JSON])
            raise UsageError(f"no such topic: {', '.join(sorted(unknown))}; the topics of a session are {known}")
        summary = self.summary
        if summary is None or not summary.chunk_indexes:
            return  # the recorder has written no message
        read = _with_timing(topics)
        assert self._stream is not None
        stream = self._stream
        messages = ordered_messages(stream, summary, read, damage)
        camera_times: dict[str, tuple[int, float]] = {}  # per sensor, of the image that follows
        good = 0
        while True:
            if stream.closed:  # since the last record
                raise UsageError(f"{self.path}: the reader is not open")
            try:
                channel, message = next(messages)
            except StopIteration:
                break
            except READ_ERRORS as error:
                raise self._damaged(error) from error
            try:
                record = self._record(channel.topic, message, camera_times)
            except (*READ_ERRORS, PeerError) as error:
                if damage is None:
                    raise self._unreadable(channel.topic, error) from error
                continue
            good += 1
            if topics is None or record.topic in topics:
                yield record
        if damage is not None:
            damage.records += expected_records(summary, read) - good

    def decisions(self) -> Iterator[Decision]:
        """All decisions, in order. Raises PeerError where the file is damaged."""
        for record in self.records(["/decision"]):
            yield record.value

    @property
    def summary(self) -> Summary | None:
        """The index of the file; None when the recorder has written no message. Raises UsageError before `open`."""
        return self._opened().get_summary()

    def chunk(self, index: ChunkIndex) -> list[tuple[str, Message]]:
        """Topic and message of all records of a chunk; for any thread. Raises PeerError when it is damaged."""
        summary = self.summary
        assert self._stream is not None and summary is not None
        try:
            found = chunk_messages(self._stream, index, summary)
            return [(channel.topic, message) for channel, message in found]
        except READ_ERRORS as error:
            raise self._damaged(error) from error

    def record(self, topic: str, message: Message) -> Record:
        """A message as a record, without the time of the camera's own clock. Raises PeerError when it is damaged."""
        try:
            return self._record(topic, message, {})
        except READ_ERRORS as error:
            raise self._unreadable(topic, error) from error

    def robot_time(self, nanoseconds: int) -> float:
        """A log time of the file as robot time [s]."""
        return (nanoseconds - self._epoch) / 1e9

    def _record(self, topic: str, message: Message, camera_times: dict[str, tuple[int, float]]) -> Record:
        """A message as a record; joins the times of the cameras' own clocks with their images."""
        stamp = self.robot_time(message.publish_time)
        value = _decode(topic, message, stamp)
        sensor = topic.removeprefix("/").partition("/")[0]
        if sensor in SENSORS and topic == f"/{sensor}/timing":
            camera_times[sensor] = value["sequence"], float(value["camera_time"])
        elif isinstance(value, CameraImage) and sensor in camera_times:
            sequence, camera_time = camera_times.pop(sensor)
            value = dataclasses.replace(value, camera_time=camera_time) if sequence == value.sequence else value
        return Record(topic, self.robot_time(message.log_time), stamp, value)

    def _opened(self) -> SeekingReader:
        if self._reader is None:
            raise UsageError(f"{self.path}: the reader is not open")
        return self._reader

    def _check_format(self, reader: SeekingReader) -> None:
        found = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
        if "gelflow" in found:
            self.lost_chunks = int(found.get(RECOVERED, {}).get("damaged_chunks", "0"))
            self._take_metadata(found["gelflow"])
            return
        raise NotASession(f"{self.path} is an MCAP file but not a gelflow session; name a session recorded by gelflow")

    def _take_metadata(self, metadata: Mapping[str, str]) -> None:
        """The date of robot time 0. Raises UsageError for a newer format."""
        written = int(metadata["format"])
        if written > FORMAT:
            raise UsageError(
                f"{self.path} has session format {written}; this gelflow reads format {FORMAT}: update gelflow"
            )
        self._epoch = int(metadata.get("epoch_ns", "0"))
        self.epoch = self._epoch / 1e9

    def _unfinished(self, stream: BinaryIO) -> str:
        if is_being_recorded(stream):
            return f"{self.path} is still being recorded; wait until the recorder has closed it"
        return f"{self.path} is not finished, its recorder was killed; recover it with: {self._recovery}"

    @property
    def _recovery(self) -> str:
        return f"gelflow recover {shlex.quote(str(self.path))}"

    def _damaged(self, error: BaseException) -> PeerError:
        return PeerError(f"{self.path} is damaged ({_cause(error)}); recover it with: {self._recovery}")

    def _unreadable(self, topic: str, error: BaseException) -> PeerError:
        """For a record whose contents no recovery changes."""
        return PeerError(
            f"{self.path} is damaged: a record of {topic} cannot be read ({_cause(error)}); "
            "was it written by another program?"
        )


def _cause(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__} {error}".split())[:120]


def open_recording(path: Path) -> BinaryIO:
    """Open an MCAP file for reading. Raises UsageError when the file is missing or has another format."""
    try:
        stream = path.open("rb")
    except OSError as error:
        raise UsageError(f"cannot open {path}: {error.strerror}; name a recorded session (.mcap)") from error
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        stream.close()
        raise UsageError(f"{path} is not an MCAP file; name a session recorded by gelflow")
    stream.seek(0)
    return stream


def is_finished(stream: BinaryIO) -> bool:
    """Whether an MCAP file ends with the closing magic bytes."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MCAP0_MAGIC)))
    finished = size > 2 * len(MCAP0_MAGIC) and stream.read() == MCAP0_MAGIC
    stream.seek(0)
    return finished


def is_being_recorded(stream: BinaryIO) -> bool:
    """Whether a running recorder holds the lock of this file."""
    try:
        fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    fcntl.flock(stream, fcntl.LOCK_UN)
    return False


def _with_timing(topics: Collection[str] | None) -> Collection[str] | None:
    """`topics` and the topics that their records are joined with."""
    if topics is None:
        return None
    return {*topics, *(f"/{sensor}/timing" for sensor in SENSORS if f"/{sensor}/image" in topics)}


def _decode(topic: str, message: Message, stamp: float) -> Any:
    if topic == "/decision":
        return Decision.from_json(json.loads(message.data))
    if topic in JSON:
        value = json.loads(message.data)
        if not isinstance(value, dict):
            raise ValueError(f"the record of {topic} is no JSON object")
        return value
    if topic not in PROTOBUF:
        return message.data
    decoded = PROTOBUF[topic].FromString(message.data)
    if topic in [f"/{sensor}/image" for sensor in SENSORS]:
        return CameraImage(decoded.data, stamp, message.sequence, decoded.format)
    if topic == "/arm/joints":
        return {joint.name: joint.position for joint in decoded.joints}
    if isinstance(decoded, PoseInFrame):
        position, rotation = decoded.pose.position, decoded.pose.orientation
        return Pose(
            np.array([position.x, position.y, position.z]), np.array([rotation.w, rotation.x, rotation.y, rotation.z])
        )
    return decoded
