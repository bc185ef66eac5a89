"""Mock tactile camera: an HTTP server with an MJPEG stream as sent by mjpg-streamer, and faults on demand."""

import contextlib
import math
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Literal, Self
from urllib.parse import parse_qs, urlsplit

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError, UsageError
from gelflow.hardware_mocks.camera.faults import CameraFaults
from gelflow.hardware_mocks.message_faults import MessageFaults
from gelflow.time_sync import MAX_LEAD

BOUNDARY = "boundarydonotcross"
CLOCK_OFFSET = 1.7e9  # of the camera's own clock from robot time [s]: a client cannot compare the two
Corruption = Literal["truncated", "garbage", "length"]
CORRUPTIONS: tuple[Corruption, ...] = ("truncated", "garbage", "length")


class MockMjpegCamera:
    """Serves one camera to any number of clients; `source` returns one JPEG per call.

    A thread creates `rate` images per second of robot time, once for all clients, and only while a client is
    connected. A slow client skips images. `port` 0 takes a free port; `url` contains it. With a `slot` of the time
    synchronization (`gelflow.time_sync`), robot time waits for late images.
    """

    def __init__(
        self,
        source: Callable[[], bytes],
        clock: ScaledClock,
        *,
        rate: float = 30.0,
        host: str = "127.0.0.1",
        port: int = 0,
        slot: int | None = None,
    ) -> None:
        if not 0 < rate <= 1000:
            raise UsageError(f"rate must be above 0 and at most 1000 frames/s, got {rate}")
        self._source = source
        self._clock = clock
        self._period = 1 / rate
        self._slot = slot
        self._where = (host, port)
        self._server: _Server | None = None
        self._threads: list[threading.Thread] = []
        self._changed = threading.Condition()
        self._image = b""
        self._stamp = 0.0  # of the image, on the camera's own clock [s]
        self._number = 0  # of images created
        self._watchers = 0
        self._closing = False
        self._stalled = False
        self._epoch = 0  # incremented to end all streams
        self._corrupt: list[Corruption] = []
        self._faults = CameraFaults()
        self._refused: set[int] = set()  # faults that keep clients from connecting
        self._stalled_by: set[int] = set()  # faults
        self._failure: Exception | None = None

    # Server

    def start(self) -> Self:
        """Bind and serve. Raises UsageError when the address is in use."""
        try:
            self._server = _Server(self._where, self)
        except OSError as error:
            host, port = self._where
            raise UsageError(f"cannot serve a camera at {host}:{port}: {error.strerror}; use another port") from error
        serve = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="mjpeg server", daemon=True)
        produce = threading.Thread(target=self._produce, name="mjpeg images", daemon=True)
        self._threads = [serve, produce]
        for thread in self._threads:
            thread.start()
        return self

    @property
    def port(self) -> int:
        if self._server is None:
            raise UsageError("the camera server is not started")
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """URL of the stream."""
        return f"http://{self._where[0]}:{self.port}/?action=stream"

    @property
    def clients(self) -> int:
        """Number of clients of the stream."""
        return self._watchers

    def close(self) -> None:
        """End all streams and stop. Raises PeerError when `source` has failed."""
        if self._server is None:
            return
        server, self._server = self._server, None
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        server.shutdown()
        server.server_close()
        for thread in self._threads:
            thread.join(2.0)
        if self._failure is not None:
            kind, message = type(self._failure).__name__, self._failure
            raise PeerError(f"the image source of the mock camera failed: {kind}: {message}") from self._failure

    def __enter__(self) -> Self:
        return self if self._server is not None else self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    # Faults

    def stall(self) -> None:
        """Send no images until `resume`, with the connections kept open."""
        with self._changed:
            self._stalled = True

    def resume(self) -> None:
        with self._changed:
            self._stalled = False
            self._changed.notify_all()

    def corrupt(self, count: int = 1, *, how: Corruption = "truncated") -> None:
        """Corrupt the next `count` images: truncated, with noise in the image, or with a wrong Content-Length."""
        if how not in CORRUPTIONS:
            raise UsageError(f"how must be one of {', '.join(CORRUPTIONS)}, got {how!r}")
        with self._changed:
            self._corrupt += [how] * count

    def drop_clients(self) -> None:
        """Close all streams; new clients are accepted."""
        with self._changed:
            self._epoch += 1
            self._changed.notify_all()

    def begin_fault(self, number: int, kind: str, values: dict[str, Any]) -> None:
        """Begin a fault: disconnect, stall, or one of the images (`IMAGE_KINDS`) or of the stream (`MESSAGE_KINDS`)."""
        with self._changed:
            if kind == "disconnect":
                self._refused.add(number)
                self._epoch += 1
            elif kind == "stall":
                self._stalled_by.add(number)
            else:
                self._faults.begin(number, kind, values)
            self._changed.notify_all()

    def end_fault(self, number: int) -> None:
        """End the fault with this number."""
        with self._changed:
            self._faults.end(number)
            self._refused.discard(number)
            self._stalled_by.discard(number)
            self._changed.notify_all()

    # Between the threads

    def _produce(self) -> None:
        due = self._clock.now()
        while True:
            with self._changed:
                if self._closing or self._watchers == 0 or self._silent:
                    self._allow(math.inf)
                self._changed.wait_for(lambda: self._closing or (self._watchers > 0 and not self._silent))
                if self._closing:
                    return
            exposed = self._clock.now()  # cameras stamp the exposure, not the end of the compression
            try:
                image = self._source()
            except Exception as error:  # noqa: BLE001 - `close` raises it; the streams end
                with self._changed:
                    self._failure = error
                    self._allow(math.inf)
                    self._changed.notify_all()
                return
            with self._changed:
                image = self._faults.image(image)
                self._image, self._stamp = image, exposed + CLOCK_OFFSET
                self._number += 1
                self._changed.notify_all()
            due = max(due + self._period, self._clock.now() - self._period)
            self._allow(due + MAX_LEAD)
            self._clock.sleep_until(due)

    @property
    def _silent(self) -> bool:
        return self._stalled or bool(self._stalled_by)

    def _allow(self, until: float) -> None:
        if self._slot is not None:
            self._clock.grant(self._slot, until)

    def _watch(self, change: int) -> None:
        """Add or remove a client."""
        with self._changed:
            self._watchers += change
            self._changed.notify_all()

    def _next(self, client: "_Client") -> list[bytes] | None:
        """The parts for a client, which wait for a new image or for the time of a delayed part; None at the end."""

        def new_image() -> bool:
            return self._number > client.number and not self._silent

        with self._changed:
            while not self._ended(client.epoch):
                now = self._clock.now()
                if new_image():
                    corruption = self._corrupt.pop(0) if self._corrupt else None
                    client.number = self._number
                    client.stream.put(_part(self._image, self._stamp, corruption), now)
                if parts := client.stream.take(now):
                    return parts
                left = self._clock.wall(client.stream.next_due - now)
                self._changed.wait_for(
                    lambda: self._ended(client.epoch) or new_image(), None if math.isinf(left) else left
                )
            return None

    def _snapshot(self) -> bytes | None:
        """The next image; None at the end."""
        with self._changed:
            before, epoch = self._number, self._epoch
            self._changed.wait_for(lambda: self._ended(epoch) or self._number > before)
            return self._image if self._number > before else None

    def _ended(self, epoch: int) -> bool:
        """Whether a client that came in this epoch gets no more images."""
        return self._closing or self._failure is not None or self._epoch != epoch

    @contextlib.contextmanager
    def _client(self) -> Iterator["_Client"]:
        with self._changed:
            client = _Client(self._number, self._epoch, self._faults.add_stream())
        self._watch(+1)
        try:
            yield client
        finally:
            self._watch(-1)
            with self._changed:
                self._faults.remove_stream(client.stream)


@dataclass
class _Client:
    """One client of the stream."""

    number: int  # of the newest image that was sent
    epoch: int
    stream: MessageFaults


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, where: tuple[str, int], camera: MockMjpegCamera) -> None:
        self.camera = camera
        super().__init__(where, _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that disconnect; mocks do not print."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 5.0  # of the socket [s], for clients that neither read nor disconnect

    def do_GET(self) -> None:
        if self.server.camera._refused:
            self.send_error(503, "the camera is not available")
            return
        action = parse_qs(urlsplit(self.path).query).get("action", [""])[0]
        if action == "stream":
            self._stream()
        elif action == "snapshot":
            self._snapshot()
        else:
            self.send_error(404, "expected ?action=stream or ?action=snapshot")

    def log_message(self, format: str, *args: object) -> None:
        """Mocks do not print."""

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace;boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        camera = self.server.camera
        # The client may disconnect at any time.
        with contextlib.suppress(OSError), camera._client() as client:
            self.wfile.write(f"--{BOUNDARY}\r\n".encode())
            while (parts := camera._next(client)) is not None:
                for part in parts:
                    self.wfile.write(part)

    def _snapshot(self) -> None:
        camera = self.server.camera
        camera._watch(+1)
        try:
            image = camera._snapshot()
        finally:
            camera._watch(-1)
        if image is None:
            self.send_error(503, "the camera has no image")
            return
        self.send_response(200)
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(image)))
        self.end_headers()
        with contextlib.suppress(OSError):  # the client has disconnected
            self.wfile.write(image)


def _part(image: bytes, stamp: float, corruption: Corruption | None) -> bytes:
    """One part of the stream and the boundary after it, with the headers and in the order of mjpg-streamer."""
    length, body = len(image), image
    if corruption == "truncated":
        body = image[: len(image) // 2]
    elif corruption == "garbage":
        third = len(image) // 3
        body = image[:third] + bytes((7 * i) & 0xFF for i in range(third)) + image[2 * third :]
        length = len(body)
    elif corruption == "length":
        length = 10 * len(image)
    head = f"Content-Type: image/jpeg\r\nContent-Length: {length}\r\nX-Timestamp: {stamp:.6f}\r\n\r\n".encode()
    return head + body + f"\r\n--{BOUNDARY}\r\n".encode()
