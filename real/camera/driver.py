"""Tactile cameras: an MJPEG stream over HTTP, or a UVC device on this computer."""

import contextlib
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from gelflow.clock import Clock
from gelflow.errors import GelflowError, PeerError, PeerTimeout, UsageError
from gelflow.real.addresses import is_host
from gelflow.real.camera import codec
from gelflow.real.camera.stream import OnImage, ReceivedImage, StreamCamera
from gelflow.real.limits import LIMITS


def open_camera(
    source: str,
    name: str,
    clock: Clock,
    *,
    timeout: float = LIMITS.image_age,
    latency: float = 0.0,
    frozen_after: float | None = None,
    on_image: OnImage | None = None,
) -> StreamCamera:
    """Open the camera at `source`: "http://HOST:PORT/?action=stream", "uvc:INDEX" or "uvc:/dev/videoN".

    Raises UsageError for any other source, and PeerError when the camera cannot be opened.
    """
    if source.startswith("http://"):
        return MjpegCamera(
            source, name, clock, timeout=timeout, latency=latency, frozen_after=frozen_after, on_image=on_image
        ).open()
    if source.startswith("uvc:"):
        device = source.removeprefix("uvc:")
        number = re.fullmatch("[0-9]{1,9}", device)
        if device.isdigit() and not number:
            raise UsageError(f"camera {name}: the number in {source!r} is not that of a camera")
        chosen = int(device) if number else device
        return UvcCamera(
            chosen, name, clock, timeout=timeout, latency=latency, frozen_after=frozen_after, on_image=on_image
        ).open()
    raise UsageError(f"camera {name}: expected http://HOST:PORT/… or uvc:INDEX, got {source!r}")


class MjpegCamera(StreamCamera):
    """An MJPEG stream over HTTP. The JPEG bytes are passed on as received.

    `connect_timeout` [s] bounds the connection and the head of the response together; it is not robot time, because a
    faster mock robot does not make the network faster. A stall does not close the connection: images that arrive later
    are used.
    """

    def __init__(
        self,
        url: str,
        name: str,
        clock: Clock,
        *,
        timeout: float = LIMITS.image_age,
        latency: float = 0.0,
        frozen_after: float | None = None,
        connect_timeout: float = 3.0,
        on_image: OnImage | None = None,
    ) -> None:
        super().__init__(
            url, name, clock, timeout=timeout, latency=latency, frozen_after=frozen_after, on_image=on_image
        )
        try:
            parts = urlsplit(url)
            port = parts.port or 80
        except ValueError as error:
            raise UsageError(f"camera {name}: {url} is no valid address; expected http://HOST:PORT/path") from error
        plain = url.isascii() and not any(c.isspace() for c in url) and "@" not in parts.netloc
        if parts.scheme != "http" or not is_host(parts.hostname or "") or not plain:
            raise UsageError(f"camera {name}: expected http://HOST:PORT/path (no user name), got {url!r}")
        self._address = (parts.hostname, port)
        self._host = parts.netloc
        self._target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._connect_timeout = connect_timeout
        self._socket: socket.socket | None = None
        self._parser: codec.MultipartParser | None = None
        self._early = b""  # stream data received together with the head

    @property
    def damaged(self) -> int:
        """Number of damaged images that were skipped since the stream was opened."""
        return self._parser.damaged if self._parser else 0

    def _connect(self) -> None:
        deadline = time.monotonic() + self._connect_timeout
        try:
            link = socket.create_connection(self._address, timeout=self._left(deadline))
        except TimeoutError as error:
            raise self._no_answer() from error
        except OSError as error:
            reason = error.strerror or str(error)
            raise PeerError(f"camera {self.name}: cannot reach {self.source}: {reason}; is the camera on?") from error
        try:
            link.sendall(codec.request(self._host, self._target))
            data = b""
            while (head := codec.parse_head(data)) is None:
                link.settimeout(self._left(deadline))
                received = link.recv(65536)
                if not received:
                    raise PeerError("the server closed the connection before it answered")
                data += received
            self._parser = codec.MultipartParser(head[0].boundary())
            self._early = head[1]
            # Period at which the reader thread checks whether it should end; callers measure the age of images.
            link.settimeout(0.2)
        except TimeoutError as error:
            link.close()
            raise self._no_answer() from error
        except OSError as error:
            link.close()
            raise PeerError(f"camera {self.name}: {self.source} failed: {error.strerror or error}") from error
        except GelflowError as error:
            link.close()
            message = f"camera {self.name}: {self.source}: {error}; is it the stream's address?"
            raise type(error)(message) from error
        self._socket = link

    def _left(self, deadline: float) -> float:
        left = deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError
        return left

    def _no_answer(self) -> PeerTimeout:
        waited = f"within {self._connect_timeout:g} s"
        return PeerTimeout(f"camera {self.name}: no answer from {self.source} {waited}; is the camera on?")

    def _disconnect(self) -> None:
        link, self._socket = self._socket, None
        if link is not None:
            with contextlib.suppress(OSError):  # the peer may have closed it
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def _images(self, closing: threading.Event) -> Iterator[ReceivedImage]:
        link, parser = self._socket, self._parser
        assert link is not None and parser is not None
        data = self._early
        while True:
            for part in parser.feed(data):
                yield ReceivedImage(part.data, camera_time=part.camera_time)
            data = b""
            try:
                data = link.recv(65536)
            except TimeoutError:
                if closing.is_set():
                    return
                continue
            except OSError as error:
                raise PeerError(
                    f"camera {self.name}: connection to {self.source} broke: {error.strerror or error}; reconnect"
                ) from error
            if not data:
                return


class UvcCamera(StreamCamera):
    """A UVC device by index or path, read with OpenCV.

    MJPEG is requested, and its bytes are passed on as received. If the system's driver delivers pixels instead, they
    are stored as PNG, so that a replay decodes identical pixels. `size` is the requested (width, height) [px].
    """

    def __init__(
        self,
        device: int | str | Path,
        name: str,
        clock: Clock,
        *,
        timeout: float = LIMITS.image_age,
        latency: float = 0.0,
        frozen_after: float | None = None,
        size: tuple[int, int] | None = None,
        on_image: OnImage | None = None,
    ) -> None:
        super().__init__(
            f"video device {device}",
            name,
            clock,
            timeout=timeout,
            latency=latency,
            frozen_after=frozen_after,
            on_image=on_image,
        )
        if isinstance(device, int) and device < 0:
            raise UsageError(f"camera {name}: a device index is 0 or more, got {device}")
        self._device = device if isinstance(device, int) else str(device)
        self._size = size
        self._capture: Any = None
        self._damaged = 0

    @property
    def damaged(self) -> int:
        """Number of damaged images that were skipped since the stream was opened."""
        return self._damaged

    def _connect(self) -> None:
        import cv2  # a stream over HTTP does not need OpenCV

        with _quiet(cv2):
            capture = cv2.VideoCapture(self._device)
        if not capture.isOpened():
            raise PeerError(f"camera {self.name}: cannot open {self.source}; is it plugged in and free?")
        mjpeg = cv2.VideoWriter.fourcc(*"MJPG")
        capture.set(cv2.CAP_PROP_FOURCC, mjpeg)
        if self._size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        if capture.getBackendName() == "V4L2" and int(capture.get(cv2.CAP_PROP_FOURCC)) == mjpeg:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # deliver the JPEG instead of its pixels
        self._capture = capture

    def _disconnect(self) -> None:
        """No effect: OpenCV's read cannot be interrupted, and the reader thread releases the device."""

    def _images(self, closing: threading.Event) -> Iterator[ReceivedImage]:
        capture, self._capture = self._capture, None
        try:
            while not closing.is_set():
                read, pixels = capture.read()
                if not read:
                    raise PeerError(f"camera {self.name}: {self.source} sent no image; is it plugged in? reconnect")
                if (encoded := self._encode(pixels)) is None:
                    self._damaged += 1
                else:
                    yield ReceivedImage(*encoded)
        finally:
            capture.release()

    def _encode(self, pixels: Any) -> tuple[bytes, str] | None:
        """The image and its format; None for a damaged JPEG, as cameras send when a stream begins."""
        import cv2

        if 1 in pixels.shape[:2]:  # one row of bytes: the JPEG itself
            data = pixels.tobytes()
            end = data.rfind(b"\xff\xd9")  # the buffer is longer than the image
            return (data[: end + 2], "jpeg") if data.startswith(b"\xff\xd8") and end > 0 else None
        done, png = cv2.imencode(".png", pixels)
        if not done:
            raise PeerError(f"camera {self.name}: {self.source} sent pixels of the invalid shape {pixels.shape}")
        return png.tobytes(), "png"


@contextlib.contextmanager
def _quiet(cv2: Any) -> Iterator[None]:
    """Suppress OpenCV's warnings about a missing device, for which the driver raises an error."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
