"""Recorder of sessions as MCAP files. It never drops a record silently; a crash loses at most half a second."""

import contextlib
import fcntl
import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.writer import Writer
from numpy.typing import ArrayLike

from gelflow import __version__, interrupts
from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout, UsageError
from gelflow.protocols import ArmState, CameraImage, GripperState
from gelflow.session.annotations import annotate
from gelflow.session.channels import BASE_FRAME, TOOL_FRAME, register_channels
from gelflow.session.records import FORMAT, SENSORS, Decision, to_json, to_plain
from gelflow.session.viewer_messages import event_log, flow_image

CHUNK_BYTES = 64 * 1024  # with the default of 1 MB a killed recorder loses many more records
FLUSH_PERIOD = 0.25  # half of the largest loss by a crash [s, robot time]
DISK_TIMEOUT = 10.0  # for the disk to store everything [s, wall]

MAX_DELAY = 1.0  # of the oldest record that is not stored yet [s, robot time]

_Item = tuple[str, int, int, int, bytes]  # topic, log time [ns], publish time [ns], sequence, data
_Queued = tuple[float, _Item | threading.Event]  # time at which it was queued [s, wall], item


def nanoseconds(seconds: float) -> int:
    """A time [s] in integer nanoseconds. Raises UsageError when it is not finite."""
    if not math.isfinite(seconds):
        raise UsageError(f"a time of a record must be finite, got {seconds}")
    return round(float(seconds) * 1e9)


class SessionRecorder:
    """Writes a session to `path`.

    Every method may be called from any thread. Methods return without waiting for the disk, except `attempt_end` and
    `close`, which return when all records are stored. When a record cannot be queued or written, the call and every
    later one raise PeerError, and the caller must stop the attempt. `gelflow recover` recovers the unfinished file.
    A program that moves a robot calls `check` regularly: it raises when the disk is more than `max_delay` [s, robot
    time] behind.

    All arguments are in robot time. Messages of the file have dates: `epoch` [s] is the date of the robot time 0 as
    seconds since 1970, by default the present date less the present robot time; 0 writes robot time as it is.
    """

    def __init__(
        self,
        path: str | Path,
        clock: Clock,
        *,
        queue_size: int = 16384,
        max_delay: float = MAX_DELAY,
        epoch: float | None = None,
    ) -> None:
        self.path = Path(path)
        self._clock = clock
        self._max_delay = max_delay
        self._epoch = nanoseconds(time.time() - clock.now() if epoch is None else epoch)
        self._queue: queue.Queue[_Queued | None] = queue.Queue(queue_size)
        # Times at which the oldest record of each batch was queued [s, wall]: of the batches that wait for fsync, then
        # of the batch that is being written (None: it is empty).
        self._syncing: deque[float] = deque()
        self._writing: float | None = None
        self._failure: str | None = None
        self._thread: threading.Thread | None = None
        self._opened = threading.Lock()  # held from the check that the recorder is open until a record is queued
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
            raise UsageError(f"cannot create {self.path}: {error.strerror}; use a writable folder") from error
        # The lock distinguishes a session in progress from a crashed one, where the file system has locks.
        with contextlib.suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._thread = threading.Thread(target=self._write_all, args=(stream,), name="recorder", daemon=True)
        self._thread.start()
        return self

    # Records

    def metadata(self, description: Mapping[str, Any]) -> None:
        """Record the description of the session (`describe_session`). Raises UsageError on a second call."""
        if self._described:
            raise UsageError("the session already has a description; call metadata once")
        self._json("/session", {"format": FORMAT, "epoch": self._epoch / 1e9, **to_plain(description)})
        self._described = True

    def image(self, sensor: int, image: CameraImage) -> None:
        """Record a camera image as received. `sensor` 0 is the left finger."""
        name = _name(sensor)
        if not 0 <= image.sequence < 1 << 32:  # an unsigned integer of 32 bits in the file
            raise UsageError(f"the sequence number of an image must be within 0 to 2**32 - 1, got {image.sequence}")
        if image.camera_time is not None:  # before the image: the reader joins both
            timing = {"stamp": image.stamp, "sequence": image.sequence, "camera_time": image.camera_time}
            self._json(f"/{name}/timing", timing, stamp=image.stamp)
        message = CompressedImage(frame_id=f"{name}_gel", data=image.data, format=image.encoding)
        message.timestamp.FromNanoseconds(self._date(image.stamp))
        self._put(f"/{name}/image", message.SerializeToString(), stamp=image.stamp, sequence=image.sequence)

    def markers(self, sensor: int, stamp: float, values: Mapping[str, Any]) -> None:
        """Record the markers of the image with that stamp; `values` follow `gelflow.Markers` in `channels`."""
        name = _name(sensor)
        self._json(f"/{name}/markers", {"stamp": stamp, **values}, stamp=stamp)
        drawn = annotate(values, self._date(stamp))  # for viewers
        self._put(f"/{name}/annotations", drawn.SerializeToString(), stamp=stamp)

    def force(self, sensor: int, stamp: float, values: Mapping[str, Any]) -> None:
        """Record the forces on a gel in the image with that stamp; `values` follow `gelflow.Force` in `channels`."""
        self._json(f"/{_name(sensor)}/force", {"stamp": stamp, **values}, stamp=stamp)

    def arm_state(self, state: ArmState) -> None:
        """Record the measured pose, joints and status of the arm."""
        self._pose("/arm/pose", state.stamp, state.position, state.quaternion)
        transform = FrameTransform(parent_frame_id=BASE_FRAME, child_frame_id=TOOL_FRAME)
        transform.timestamp.FromNanoseconds(self._date(state.stamp))
        _fill(transform.translation, "xyz", state.position)
        _fill(transform.rotation, "wxyz", state.quaternion)
        self._put("/tf", transform.SerializeToString(), stamp=state.stamp)
        joints = JointStates()
        joints.timestamp.FromNanoseconds(self._date(state.stamp))
        for number, angle in enumerate(state.joints, start=1):
            joints.joints.add(name=f"joint_{number}", position=float(angle))
        self._put("/arm/joints", joints.SerializeToString(), stamp=state.stamp)
        names = ("stamp", "motors_on", "running", "operating_mode", "fault")
        self._json("/arm/status", {name: getattr(state, name) for name in names}, stamp=state.stamp)

    def arm_command(self, stamp: float, position: ArrayLike, quaternion: ArrayLike, *, kind: str) -> None:
        """Record a reference for the arm: position [m] and quaternion w x y z in the base frame.

        `kind` is "command" for the runner's reference and "applied" for the reference that the driver sent.
        """
        if kind not in ("command", "applied"):
            raise UsageError(f"kind of an arm command must be 'command' or 'applied', got {kind!r}")
        self._pose(f"/arm/{kind}", stamp, position, quaternion)

    def gripper_state(self, state: GripperState) -> None:
        """Record the measured state of the gripper."""
        self._json("/gripper/state", state, stamp=state.stamp)

    def gripper_command(self, stamp: float, name: str, values: Mapping[str, Any]) -> None:
        """Record a command to the gripper: its name, and its arguments in SI units."""
        self._json("/gripper/command", {"stamp": stamp, "name": name, "values": values}, stamp=stamp)

    def checks(self, stamp: float, checks: Sequence[Any]) -> None:
        """Record the state of the checks of a run: each has a name, whether it is ok, and a text."""
        self._json("/checks", {"stamp": stamp, "checks": checks}, stamp=stamp)

    def decision(self, decision: Mapping[str, Any]) -> None:
        """Record a decision, `Decision(...).to_json()`. Raises UsageError when a replay could not recompute it."""
        try:
            checked = Decision.from_json(to_plain(decision))
        except PeerError as error:
            raise UsageError(str(error)) from error
        stamp = self._clock.now()
        self._json("/decision", {**to_plain(decision), "stamp": stamp}, stamp=stamp)
        # For viewers: all channels side by side. A replay reads the numbers of the decision record.
        self._put("/flow_map", flow_image(checked.flow, self._date(stamp)).SerializeToString(), stamp=stamp)

    def event(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        """Record an event: a grasp, a stop with its reason, an operator's answer."""
        stamp = self._clock.now()
        self._json("/event", {"stamp": stamp, "name": name, "values": values or {}}, stamp=stamp)
        self._put("/log", event_log(name, values or {}, self._date(stamp)).SerializeToString(), stamp=stamp)

    def attempt_end(self, attempt: Mapping[str, Any] | None = None) -> None:
        """Record the result of an attempt (insertion, attempt, outcome and more) and store all records on the disk.

        Returns when all records so far are stored. Raises as `check`, and PeerTimeout after `DISK_TIMEOUT`.
        """
        if attempt is not None:
            self._json("/attempt", attempt)
        done = threading.Event()
        self._enqueue(done)
        deadline = time.monotonic() + DISK_TIMEOUT
        while not done.wait(0.05):
            self.check()
            if time.monotonic() > deadline:
                raise PeerTimeout(f"{self.path}: not stored after {DISK_TIMEOUT:g} s; is the disk full or slow?")

    @property
    def delay(self) -> float:
        """Age of the oldest record that is not stored on the disk yet [s, wall]; 0 when all are stored."""
        with self._queue.mutex:
            first = self._queue.queue[0] if self._queue.queue else None
        oldest = next(iter(tuple(self._syncing)), self._writing)
        if oldest is None:
            oldest = None if first is None else first[0]
        return 0.0 if oldest is None else time.monotonic() - oldest

    def check(self) -> None:
        """Raise PeerError when the recording has failed, PeerTimeout when the disk is more than `max_delay` behind."""
        self._check()
        if (delay := self.delay) > self._clock.wall(self._max_delay):
            allowed = f"at most {self._clock.wall(self._max_delay):g} s is allowed"
            raise PeerTimeout(f"recording {self.path} is {delay:.1f} s behind, {allowed}; is the disk full or slow?")

    def close(self) -> None:
        """Write the index, store all records and close. Raises PeerError when the file cannot be finished."""
        with self._opened:
            thread, self._thread = self._thread, None
        if thread is None:
            return
        if self._failure is None:
            try:
                self._queue.put(None, timeout=DISK_TIMEOUT)
            except queue.Full:
                self._fail("the disk is too slow")
        thread.join(DISK_TIMEOUT)
        self._check()
        if not self._finished:
            raise PeerTimeout(f"{self.path}: not finished after {DISK_TIMEOUT:g} s; recover it with `gelflow recover`")

    def __enter__(self) -> "SessionRecorder":
        return self if self._thread is not None else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        with interrupts.deferred():
            try:
                self.close()
            except GelflowError as failure:
                if error is None:
                    raise
                error.add_note(str(failure))  # the first error is the cause

    # Queue

    def _json(self, topic: str, values: Any, *, stamp: float | None = None) -> None:
        self._put(topic, to_json(values), stamp=stamp)

    def _pose(self, topic: str, stamp: float, position: ArrayLike, quaternion: ArrayLike) -> None:
        message = PoseInFrame(frame_id=BASE_FRAME)
        message.timestamp.FromNanoseconds(self._date(stamp))
        _fill(message.pose.position, "xyz", position)
        _fill(message.pose.orientation, "wxyz", quaternion)
        self._put(topic, message.SerializeToString(), stamp=stamp)

    def _put(self, topic: str, data: bytes, *, stamp: float | None = None, sequence: int = 0) -> None:
        now = self._date(self._clock.now())
        self._enqueue((topic, now, now if stamp is None else self._date(stamp), sequence, data))

    def _date(self, stamp: float) -> int:
        """A robot time [s] as nanoseconds since 1970; MCAP has no earlier times."""
        return max(0, nanoseconds(stamp) + self._epoch)

    def _enqueue(self, item: _Item | threading.Event) -> None:
        with self._opened:
            self._check()
            if self._thread is None:
                raise UsageError(f"{self.path}: the recorder is not open")
            try:
                self._queue.put_nowait((time.monotonic(), item))
            except queue.Full:
                self._fail(f"{self._queue.maxsize} records wait for the disk, which is too slow or full")
                self._check()

    def _fail(self, reason: str) -> None:
        self._failure = self._failure or reason

    def _check(self) -> None:
        if self._failure is not None:
            raise PeerError(f"recording {self.path} failed: {self._failure}; stop, then `gelflow recover` the file")

    def _write_all(self, stream: BinaryIO) -> None:
        """Body of the writer thread, the only one that accesses the file."""
        try:
            with stream:
                self._write(stream)
        except Exception as error:  # noqa: BLE001 - a thread has no caller: the next call raises it
            self._fail(str(error) or type(error).__name__)

    def _write(self, stream: BinaryIO) -> None:
        writer = Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library=f"gelflow {__version__}")
        first = {"format": str(FORMAT), "version": __version__, "epoch_ns": str(self._epoch)}
        writer.add_metadata("gelflow", first)
        channels = register_channels(writer)
        writer.flush()  # type: ignore[no-untyped-call]
        with _Syncer(stream.fileno(), self._fail, self._syncing) as syncer:
            finished = self._write_queue(writer, channels, syncer)
        if finished and self._failure is None:
            writer.finish()  # type: ignore[no-untyped-call]
            stream.flush()
            os.fsync(stream.fileno())
            self._finished = True

    def _write_queue(self, writer: Writer, channels: Mapping[str, int], syncer: "_Syncer") -> bool:
        """Write the queue until the recorder is closed (True) or fails (False)."""
        period = self._clock.wall(FLUSH_PERIOD)  # robot time may stand still
        due = time.monotonic() + period
        while self._failure is None:
            item: _Item | threading.Event | None = None
            with contextlib.suppress(queue.Empty):
                queued = self._queue.get(timeout=max(0.0, due - time.monotonic()))
                if queued is None:
                    return True
                stamp, item = queued
                self._writing = stamp if self._writing is None else self._writing
            if isinstance(item, tuple):
                topic, logged, published, sequence, data = item
                writer.add_message(channels[topic], logged, data, published, sequence)
            if isinstance(item, threading.Event) or time.monotonic() >= due:
                if self._writing is not None:
                    writer.flush()  # type: ignore[no-untyped-call]
                    self._syncing.append(self._writing)
                    self._writing = None
                    syncer.request(item if isinstance(item, threading.Event) else None)
                due = time.monotonic() + period
        return False


class _Syncer:
    """Calls fsync in a separate thread, so that a slow disk does not delay writes to the file.

    Written records survive a crash of this program; stored ones also survive a crash of the computer.
    """

    def __init__(self, descriptor: int, fail: Callable[[str], None], batches: deque[float]) -> None:
        self._descriptor = descriptor
        self._fail = fail
        self._batches = batches  # one per request; removed from the left when it is stored
        self._requests: queue.Queue[threading.Event | None] = queue.Queue()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="recorder sync", daemon=True)

    def request(self, done: threading.Event | None) -> None:
        """Store all written records, then set `done`."""
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
                if self._batches:
                    self._batches.popleft()
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
