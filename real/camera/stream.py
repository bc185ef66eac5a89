"""Base class of streaming cameras: reader thread, newest image, waiting with time-outs, persistent errors."""

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout, UsageError
from gelflow.protocols import CameraImage
from gelflow.real.camera.liveness import CameraClock, RepeatFilter
from gelflow.time_sync import MIN_WAIT

OnImage = Callable[[CameraImage], None]
_LEAST_REJECTED = 3  # images in a row that are not new, for a frozen camera


@dataclass(frozen=True)
class ReceivedImage:
    """An image as a camera class receives it."""

    data: bytes
    encoding: str = "jpeg"
    camera_time: float | None = None  # on the camera's own clock [s]


class StreamCamera(ABC):
    """A `gelflow.protocols.Camera` whose images a thread receives; only the newest image is kept.

    Three kinds of images are not new, and each has a counter: an image that repeats a recent one (`repeated`), one
    whose time on the camera's own clock is not later than that of its predecessor (`unclocked`), and one that is older
    than `timeout` at its reception (`late`). They are passed to `on_image`, but `latest` and `next` do not return them.
    Both raise PeerTimeout when only such images arrive for `frozen_after` [s, robot time; by default `timeout`].

    The stamp of an image is the robot time of its reception, less `latency`. If the camera sends the time of its own
    clock, the delay of the image in addition to the shortest delay seen is subtracted too. `latency` [s] is the
    constant time from the exposure to the reception, which no clock shows; `gelflow.real.camera.estimate_latency`
    measures it.

    `on_image` is called with every image in the reader thread, before the image is available to callers: a recording
    therefore holds each image before any decision based on it. An exception of `on_image` ends the stream and is
    raised to the callers. A stream that has ended (closed by the server, failed, or closed here) needs `reconnect`.
    """

    def __init__(
        self,
        source: str,
        name: str,
        clock: Clock,
        *,
        timeout: float,
        latency: float = 0.0,
        frozen_after: float | None = None,
        on_image: OnImage | None = None,
    ) -> None:
        if not timeout > 0:
            raise UsageError(f"camera {name}: timeout must be above 0 s, got {timeout}")
        if not 0 <= latency < timeout:
            raise UsageError(f"camera {name}: latency must be at least 0 s and below {timeout:g} s, got {latency}")
        self.source = source  # for messages
        self.name = name
        self.timeout = timeout  # largest age of the image that `latest` returns [s, robot time]
        self.latency = latency
        self._frozen_after = timeout if frozen_after is None else frozen_after
        self._clock = clock
        self._on_image = on_image
        self._changed = threading.Condition()
        self._newest: CameraImage | None = None
        self.repeated = self.unclocked = self.late = 0
        self._rejected = 0  # images since the newest one
        self._rejection = ("", "")  # of the last of them: what the camera does, and the likely cause
        self._since: tuple[float, float | None] | None = None  # reception and camera time before the first of them [s]
        self._frozen = False
        self._repeats = RepeatFilter()  # continues after a reconnect, which does not revive a frozen server
        self._camera_clock = CameraClock()
        self._stamp = -math.inf  # of the last image [s]
        self._count = 0  # continues after a reconnect, so that a sequence number is unique within a session
        self._failure: GelflowError | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()

    @property
    def damaged(self) -> int:
        """Number of damaged images that were skipped since the stream was opened."""
        return 0

    def open(self) -> Self:
        """Connect and start the reader thread. Raises PeerError when the camera is unreachable or sends no stream."""
        if self._thread is not None:
            raise UsageError(f"camera {self.name}: already open")
        self._connect()
        self._closing = threading.Event()
        with self._changed:
            self._failure = None
            self._newest = None
            self._rejected, self._since, self._frozen = 0, None, False
        self._camera_clock = CameraClock()
        self._thread = threading.Thread(
            target=self._receive, args=(self._closing,), name=f"camera {self.name}", daemon=True
        )
        self._thread.start()
        return self

    def reconnect(self) -> None:
        """Close and open again; required after a failure."""
        self.close()
        self.open()

    def close(self) -> None:
        """Stop receiving; may be called twice."""
        self._closing.set()
        self._disconnect()
        if self._thread is not None:
            self._thread.join(2.0)
        self._thread = None
        with self._changed:
            self._newest = None
            self._failure = PeerError(f"camera {self.name}: {self.source} is closed here; open or reconnect it")
            self._changed.notify_all()

    def __enter__(self) -> Self:
        return self if self._thread is not None else self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def latest(self) -> CameraImage:
        """The newest image, at most `timeout` old; directly after opening, waits up to `timeout` for the first image.

        Raises PeerTimeout when there is none, with the reason if images arrive but are not new, and PeerError when the
        stream has ended.
        """
        with self._changed:
            self._raise_unopened()
            if self._newest is None:
                self._wait_for(lambda: self._newest is not None, self.timeout)
            self._raise_failure()
            if self._frozen or self._newest is None or self._clock.now() - self._newest.stamp > self.timeout:
                raise self._no_image(self.timeout)
            return self._newest

    def next(self, after: int, timeout: float) -> CameraImage:
        """The newest image with a `sequence` above `after`; waits up to `timeout` [s, robot time].

        Images that were replaced by newer ones between two calls are skipped. An image that has arrived already is
        returned however old it is, also of a stream that has ended: see its stamp. Without one, raises as `latest`.
        """
        with self._changed:
            self._raise_unopened()
            self._wait_for(lambda: self._newest is not None and self._newest.sequence > after, timeout)
            if self._newest is not None and self._newest.sequence > after:
                return self._newest
            self._raise_failure()
            raise self._no_image(timeout)

    def _wait_for(self, arrived: Callable[[], bool], timeout: float) -> None:
        """Wait until `arrived`, a failure or a frozen camera, at most `timeout` [s, robot time], with the lock held."""
        end = self._clock.now() + timeout
        while not (arrived() or self._failure is not None or self._frozen) and (left := end - self._clock.now()) > 0:
            self._changed.wait(max(self._clock.wall(left), MIN_WAIT))

    # Implemented by each camera class

    @abstractmethod
    def _connect(self) -> None:
        """Connect to the camera. Raises GelflowError. Called before the thread starts."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Disconnect and wake the reader thread. May be called twice, from any thread."""

    @abstractmethod
    def _images(self, closing: threading.Event) -> Iterator[ReceivedImage]:
        """Images until `closing` is set or the stream ends. Raises GelflowError when it fails."""

    # Reader thread

    def _receive(self, closing: threading.Event) -> None:
        failure: GelflowError = PeerError(
            f"camera {self.name}: {self.source} closed the stream; check it and reconnect"
        )
        try:
            for received in self._images(closing):
                if closing.is_set():
                    break
                self._accept(received, self._clock.now())
        except GelflowError as error:
            failure = error
        except Exception as error:  # noqa: BLE001 - a thread has no caller: raised by the next call of `latest` or `next`
            failure = PeerError(f"camera {self.name}: {self.source} failed: {type(error).__name__}: {error}")
        if not closing.is_set():
            with self._changed:
                self._failure = failure
                self._changed.notify_all()
            self._disconnect()

    def _accept(self, received: ReceivedImage, now: float) -> None:
        """Stamp, record and publish an image that was received at the robot time `now` [s]."""
        delay = 0.0 if received.camera_time is None else self._camera_clock.delay(now, received.camera_time)
        age = self.latency + (delay or 0.0)
        self._stamp = max(self._stamp, now - age)  # the measured delays shrink while the shortest one is not yet known
        image = CameraImage(received.data, self._stamp, self._count, received.encoding, received.camera_time)
        self._count += 1
        repeat = self._repeats.is_repeat(received.data)
        if self._on_image is not None:
            self._on_image(image)
        with self._changed:
            if repeat:
                self.repeated += 1
                self._reject("repeats the same image", "the camera or its server is frozen", now, received)
            elif delay is None:
                self.unclocked += 1
                what = "sends images whose X-Timestamp does not advance"
                self._reject(what, "the camera or its server is frozen", now, received)
            elif age > self.timeout:
                self.late += 1
                what = f"sends images {age:.2f} s late by its own clock"
                self._reject(what, "its server or network buffers images", now, received)
            else:
                self._newest = image
                self._rejected, self._since, self._frozen = 0, (now, received.camera_time), False
                self._changed.notify_all()

    def _reject(self, what: str, cause: str, now: float, received: ReceivedImage) -> None:
        """Count an image that is not new; the camera is frozen when such images arrive for too long."""
        self._rejected += 1
        self._rejection = what, cause
        since, camera_since = self._since = self._since or (now, received.camera_time)
        elapsed = now - since
        # The camera's own clock, where it advances, does not include the jitter of the reception.
        if camera_since is not None and received.camera_time is not None and received.camera_time > camera_since:
            elapsed = received.camera_time - camera_since
        if self._rejected >= _LEAST_REJECTED and elapsed > self._frozen_after:
            self._frozen = True
            self._changed.notify_all()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            # A new exception each time, because one instance raised from two threads shares its traceback.
            raise type(self._failure)(*self._failure.args) from self._failure

    def _raise_unopened(self) -> None:
        if self._thread is None and self._failure is None:
            raise UsageError(f"camera {self.name}: open it first")

    def _no_image(self, waited: float) -> PeerTimeout:
        last = "none so far"
        if self._newest is not None:
            last = f"the last {self._clock.now() - self._newest.stamp:.2f} s ago"
        if self._rejected:
            what, cause = self._rejection
            reason = f"{what} ({self._rejected} times) from {self.source}; new images: {last}; {cause}"
            return PeerTimeout(f"camera {self.name}: {reason}")
        damaged = f", {self.damaged} damaged" if self.damaged else ""
        reason = f"no new image from {self.source} within {waited:g} s ({last}{damaged})"
        return PeerTimeout(f"camera {self.name}: {reason}; check the camera")
