"""Records a session to an MCAP file: nothing is dropped in silence, and a crash loses at most half a second."""

import fcntl
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import ArrayLike

from gelflow import __version__
from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout, UsageError
from gelflow.protocols import ArmState, CameraImage, GripperState
from gelflow.session.annotations import annotate
from gelflow.session.channels import BASE_FRAME, JSON, PROTOBUF, TOOL_FRAME
from gelflow.session.records import FORMAT, SENSORS, Decision, plain, to_json

CHUNK = 64 * 1024  # bytes; with the default of 1 MB a killed recorder loses many more records
FLUSH_PERIOD = 0.25  # robot time [s]: half of what a crash may lose
PATIENCE = 10.0  # wall time that the disk gets to finish [s]

_Item = tuple[str, int, int, int, bytes]  # topic, log time [ns], publish time [ns], sequence, data


def nanoseconds(seconds: float) -> int:
    """A stamp [s] as MCAP's integer nanoseconds."""
    return max(0, round(float(seconds) * 1e9))


class SessionRecorder:
    """Writes a session to `path`. Every method may be called from any thread and returns without waiting for the
    disk, except `attempt_end` and `close`, which return when everything so far is safe on it.

    When a record cannot be queued or written the call raises PeerError, and so does every later call: whoever
    records must stop the attempt. The file is then unfinished; `gelflow recover` salvages it.
    """

    def __init__(self, path: str | Path, clock: Clock, *, queue_size: int = 4096) -> None:
        self.path = Path(path)
        self._clock = clock
        self._queue: queue.Queue[_Item | threading.Event | None] = queue.Queue(queue_size)
        self._failure: str | None = None
        self._thread: threading.Thread | None = None
        self._described = False
        self._finished = False

    def open(self) -> "SessionRecorder":
        """Create the file (it must not exist) and start writing. Raises UsageError when it cannot be created."""
        if self.path.exists():
            raise UsageError(f"{self.path} exists; a recording never overwrites: name a new file")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            stream = self.path.open("xb")
        except OSError as error:
            raise UsageError(f"cannot create {self.path}: {error.strerror}; name a file one can write") from error
        # Held as long as the recorder lives, so that nobody takes a session in progress for a crashed one.
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._thread = threading.Thread(target=self._write_all, args=(stream,), name="recorder", daemon=True)
        self._thread.start()
        return self

    # What is recorded

    def metadata(self, description: Mapping[str, Any]) -> None:
        """The session's description (`records.describe_session`); once, before anything else is of use."""
        if self._described:
            raise UsageError("the session is described already; metadata is written once")
        self._described = True
        self._json("/session", {"format": FORMAT, **plain(description)})

    def image(self, sensor: int, image: CameraImage) -> None:
        """One camera frame as received. `sensor` 0 is the left finger."""
        name = _name(sensor)
        message = CompressedImage(frame_id=f"{name}_gel", data=image.data, format=image.encoding)
        message.timestamp.FromNanoseconds(nanoseconds(image.stamp))
        self._put(f"/{name}/image", message.SerializeToString(), stamp=image.stamp, sequence=image.sequence)

    def markers(self, sensor: int, stamp: float, values: Mapping[str, Any]) -> None:
        """Where the markers were in the image of that stamp: the properties of `gelflow.Markers`, but the stamp."""
        name = _name(sensor)
        self._json(f"/{name}/markers", {"stamp": stamp, **values}, stamp=stamp)
        drawn = annotate(values, nanoseconds(stamp))  # for people: over the image
        self._put(f"/{name}/annotations", drawn.SerializeToString(), stamp=stamp)

    def arm_state(self, state: ArmState) -> None:
        """Measured pose, joints and status of the arm."""
        self._pose("/arm/pose", state.stamp, state.position, state.quaternion)
        transform = FrameTransform(parent_frame_id=BASE_FRAME, child_frame_id=TOOL_FRAME)
        transform.timestamp.FromNanoseconds(nanoseconds(state.stamp))
        _fill(transform.translation, "xyz", state.position)
        _fill(transform.rotation, "wxyz", state.quaternion)
        self._put("/tf", transform.SerializeToString(), stamp=state.stamp)
        joints = JointStates()
        joints.timestamp.FromNanoseconds(nanoseconds(state.stamp))
        for number, angle in enumerate(state.joints, start=1):
            joints.joints.add(name=f"joint_{number}", position=float(angle))
        self._put("/arm/joints", joints.SerializeToString(), stamp=state.stamp)
        names = ("stamp", "motors_on", "running", "operating_mode", "fault")
        self._json("/arm/status", {name: getattr(state, name) for name in names}, stamp=state.stamp)

    def arm_command(self, stamp: float, position: ArrayLike, quaternion: ArrayLike, *, kind: str) -> None:
        """A reference for the arm: [m] and w x y z, in the base frame.

        `kind` is "command" for what the runner asked for, "applied" for what the driver sent in the end.
        """
        if kind not in ("command", "applied"):
            raise UsageError(f"kind of an arm command must be 'command' or 'applied', got {kind!r}")
        self._pose(f"/arm/{kind}", stamp, position, quaternion)

    def gripper_state(self, state: GripperState) -> None:
        """Measured state of the gripper."""
        self._json("/gripper/state", state, stamp=state.stamp)

    def gripper_command(self, stamp: float, name: str, values: Mapping[str, Any]) -> None:
        """A command to the gripper by name, with its arguments in SI units."""
        self._json("/gripper/command", {"stamp": stamp, "name": name, "values": values}, stamp=stamp)

    def decision(self, decision: Mapping[str, Any]) -> None:
        """A decision: `Decision(...).to_json()`. Raises UsageError when a replay could not repeat it."""
        try:
            checked = Decision.from_json(plain(decision))
        except PeerError as error:
            raise UsageError(str(error)) from error
        stamp = self._clock.now()
        self._json("/decision", {**plain(decision), "stamp": stamp}, stamp=stamp)
        # For people: all channels side by side. A replay reads the numbers of the decision itself.
        channels, rows, cols = checked.flow.shape
        picture = np.ascontiguousarray(checked.flow.transpose(1, 0, 2).reshape(rows, channels * cols), dtype="<f4")
        message = RawImage(
            width=channels * cols, height=rows, encoding="32FC1", step=4 * channels * cols, data=picture.tobytes()
        )
        message.timestamp.FromNanoseconds(nanoseconds(stamp))
        self._put("/flow_map", message.SerializeToString(), stamp=stamp)

    def event(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        """Anything that happened: a grasp, a stop with its reason, an operator's word."""
        stamp = self._clock.now()
        self._json("/event", {"stamp": stamp, "name": name, "values": values or {}}, stamp=stamp)

    def attempt_end(self, attempt: Mapping[str, Any] | None = None) -> None:
        """Record how an attempt went (insertion, attempt, outcome, whatever else is known) and make all safe.

        Returns when everything recorded so far is on the disk; raises PeerTimeout when that takes too long.
        """
        if attempt is not None:
            self._json("/attempt", attempt)
        done = threading.Event()
        self._enqueue(done)
        given_up = time.monotonic() + PATIENCE
        while not done.wait(0.05):
            self._check()
            if time.monotonic() > given_up:
                raise PeerTimeout(f"{self.path}: not stored after {PATIENCE:g} s; is the disk full or slow?")

    def close(self) -> None:
        """Write the index, make all safe and close. Raises PeerError when the file could not be finished."""
        if self._thread is None:
            return
        thread, self._thread = self._thread, None
        if self._failure is None:
            try:
                self._queue.put(None, timeout=PATIENCE)
            except queue.Full:
                self._fail("the disk is too slow")
        thread.join(PATIENCE)
        self._check()
        if not self._finished:
            raise PeerTimeout(f"{self.path}: not finished after {PATIENCE:g} s; `gelflow recover` salvages it")

    def __enter__(self) -> "SessionRecorder":
        return self if self._thread is not None else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        try:
            self.close()
        except GelflowError as failure:
            if error is None:
                raise
            error.add_note(str(failure))  # the first cause is what must be seen

    # On its way to the disk

    def _json(self, topic: str, values: Any, *, stamp: float | None = None) -> None:
        self._put(topic, to_json(values), stamp=stamp)

    def _pose(self, topic: str, stamp: float, position: ArrayLike, quaternion: ArrayLike) -> None:
        message = PoseInFrame(frame_id=BASE_FRAME)
        message.timestamp.FromNanoseconds(nanoseconds(stamp))
        _fill(message.pose.position, "xyz", position)
        _fill(message.pose.orientation, "wxyz", quaternion)
        self._put(topic, message.SerializeToString(), stamp=stamp)

    def _put(self, topic: str, data: bytes, *, stamp: float | None = None, sequence: int = 0) -> None:
        now = nanoseconds(self._clock.now())
        self._enqueue((topic, now, now if stamp is None else nanoseconds(stamp), sequence, data))

    def _enqueue(self, item: _Item | threading.Event) -> None:
        self._check()
        if self._thread is None:
            raise UsageError(f"{self.path}: the recorder is not open")
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            self._fail(f"{self._queue.maxsize} records wait for the disk, which is too slow or full")
            self._check()

    def _fail(self, reason: str) -> None:
        self._failure = self._failure or reason

    def _check(self) -> None:
        if self._failure is not None:
            raise PeerError(f"recording {self.path} failed: {self._failure}; stop, then `gelflow recover` the file")

    def _write_all(self, stream: BinaryIO) -> None:
        """The writer thread: everything that touches the file."""
        try:
            with stream:
                self._write(stream)
        except Exception as error:  # noqa: BLE001 - a thread has no caller: the next call raises it, whatever it was
            self._fail(str(error) or type(error).__name__)

    def _write(self, stream: BinaryIO) -> None:
        writer = Writer(stream, chunk_size=CHUNK)
        writer.start(profile="", library=f"gelflow {__version__}")
        writer.add_metadata("gelflow", {"format": str(FORMAT), "version": __version__})
        channels = _register(writer)
        writer.flush()  # type: ignore[no-untyped-call]
        with _Syncer(stream.fileno(), self._fail) as syncer:
            finished = self._write_queue(writer, channels, syncer)
        if finished and self._failure is None:
            writer.finish()  # type: ignore[no-untyped-call]
            stream.flush()
            os.fsync(stream.fileno())
            self._finished = True

    def _write_queue(self, writer: Writer, channels: Mapping[str, int], syncer: "_Syncer") -> bool:
        """Everything that is queued, until the recorder is closed (True) or fails (False)."""
        due = self._clock.now() + FLUSH_PERIOD
        dirty = False
        while self._failure is None:
            item: _Item | threading.Event | None
            try:
                item = self._queue.get(timeout=max(0.0, self._clock.wall(due - self._clock.now())))
            except queue.Empty:
                item = None
            else:
                if item is None:
                    return True
            if isinstance(item, tuple):
                topic, logged, published, sequence, data = item
                writer.add_message(channels[topic], logged, data, published, sequence)
                dirty = True
            if isinstance(item, threading.Event) or self._clock.now() >= due:
                if dirty or isinstance(item, threading.Event):
                    writer.flush()  # type: ignore[no-untyped-call]
                    syncer.request(item if isinstance(item, threading.Event) else None)
                    dirty = False
                due = self._clock.now() + FLUSH_PERIOD
        return False


class _Syncer:
    """Has the disk store what was written, in a thread of its own: a slow disk must not keep records from the file,
    where they survive the end of this program if not that of the computer."""

    def __init__(self, descriptor: int, fail: Callable[[str], None]) -> None:
        self._descriptor = descriptor
        self._fail = fail
        self._requests: queue.Queue[threading.Event | None] = queue.Queue()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="recorder sync", daemon=True)

    def request(self, done: threading.Event | None) -> None:
        """Store all that was written; `done` is set when it is."""
        self._requests.put(done)

    def __enter__(self) -> "_Syncer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self._requests.put(None)
        self._thread.join()

    def _run(self) -> None:
        while not self._ending:
            waiting = [self._requests.get()]
            while not self._requests.empty():
                waiting.append(self._requests.get())
            try:
                os.fsync(self._descriptor)
            except OSError as error:
                self._fail(error.strerror or "the disk failed")
                return
            for done in waiting:
                if done is not None:
                    done.set()


def _name(sensor: int) -> str:
    if not 0 <= sensor < len(SENSORS):
        raise UsageError(f"sensor must be 0 (left) or 1 (right), got {sensor}")
    return SENSORS[sensor]


def _fill(message: Any, names: str, values: ArrayLike) -> None:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (len(names),):
        raise UsageError(f"expected {len(names)} numbers ({' '.join(names)}), got shape {numbers.shape}")
    for name, number in zip(names, numbers, strict=True):
        setattr(message, name, float(number))


def _register(writer: Writer) -> dict[str, int]:
    channels = {}
    schemas: dict[str, int] = {}
    for topic, kind in PROTOBUF.items():
        name = kind.DESCRIPTOR.full_name
        if name not in schemas:
            description = build_file_descriptor_set(kind).SerializeToString()
            schemas[name] = writer.register_schema(name, "protobuf", description)
        channels[topic] = writer.register_channel(topic, "protobuf", schemas[name])
    for topic, channel in JSON.items():
        schema = writer.register_schema(channel.name, "jsonschema", channel.schema())
        channels[topic] = writer.register_channel(topic, "json", schema)
    return channels
