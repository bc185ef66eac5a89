"""Images of video files, streams and local cameras, through OpenCV."""

import os
import socket
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.clock import Clock
from gelflow.errors import PeerError, PeerTimeout
from gelflow.perception.errors import name_for_opencv

Image = NDArray[np.uint8]

_PORTS = {"http": 80, "https": 443, "rtsp": 554, "rtmp": 1935}  # default ports of the protocols over TCP
_MISSING, _MISSING_SHARE = 2, 0.02  # images at the end of a video that its container may announce in excess
_ROUNDING = 1.001e-3  # largest error of the time of an image in a video with an even rate [s]
_SMALLEST_STEP = 0.01  # between the stamps of two images of a video, relative to the interval of its rate
_LARGEST_INT = 2**31 - 1  # that OpenCV takes as the number of a camera
_BACKLOG = 8  # live images that wait for the program
# Silences FFmpeg; OpenCV reads the variable at the first use of FFmpeg.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@dataclass(frozen=True)
class CapturedImage:
    """An image as it was received."""

    content: Image | bytes  # B G R, or the JPEG data that a stream or camera sent
    stamp: float  # [s]: from the start of a video, otherwise robot time


@dataclass
class Capture:
    """A video file, stream or camera, iterated once; see `ImageSource`."""

    text: str
    kind: str  # "video", "stream" or "camera"
    rate: float  # of a video without a rate [Hz]
    timeout: float  # of a stream [s]
    clock: Clock  # time stamps of live images
    size: tuple[int, int] = (0, 0)  # width, height that a camera is set to [px]; 0: its default
    dropped: int = field(default=0, init=False)  # live images that arrived while the program was behind

    def __iter__(self) -> Iterator[CapturedImage]:
        """Iterates over the images. Live ones are read by a thread; the oldest are dropped when too many wait.

        Raises PeerError when the source cannot be opened or a video ends early, PeerTimeout when a live source ends.
        """
        return self._recorded() if self.kind == "video" else self._live()

    def count(self) -> int | None:
        """Number of images that a video announces, None if unknown."""
        capture = self._open()
        number = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        return number if number > 0 else None

    def _recorded(self) -> Iterator[CapturedImage]:
        capture = self._open()
        rate, expected = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if not 0.1 <= rate <= 1000:
            rate, expected = self.rate, 0.0  # the number may be an estimate with the same rate
        stamps = _VideoStamps(rate)
        try:
            while (image := _read(capture)) is not None:
                yield CapturedImage(image, stamps.next(capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3))
        finally:
            capture.release()
        number = stamps.number
        # By time too: a container may only estimate the number.
        missing = expected - max(number, stamps.latest * rate + 1)
        if number and missing > max(_MISSING, _MISSING_SHARE * expected):
            raise PeerError(
                f"video {self.text} ends after {number} of {expected:.0f} images: it is truncated or damaged, or was "
                "cut without encoding it again, which only hides images"
            )

    def _live(self) -> Iterator[CapturedImage]:
        capture = self._open()
        # FFmpeg scales the images of a stream whose size changes; undecoded JPEG images keep their size.
        if self.kind == "stream" and _codec(capture) == b"MJPG":
            capture.set(cv2.CAP_PROP_FORMAT, -1)
        waiting: deque[CapturedImage] = deque()
        changed, closing, ended = threading.Condition(), threading.Event(), threading.Event()

        def read() -> None:
            while not closing.is_set() and (image := _read(capture)) is not None:
                with changed:
                    waiting.append(CapturedImage(image, self.clock.now()))
                    if len(waiting) > _BACKLOG:
                        waiting.popleft()
                        self.dropped += 1
                    changed.notify()
            with changed:
                ended.set()
                changed.notify()

        reader = threading.Thread(target=read, name="image reader", daemon=True)
        reader.start()
        number = 0
        try:
            while True:
                with changed:
                    changed.wait_for(lambda: waiting or ended.is_set())
                    if not waiting:
                        break
                    image = waiting.popleft()
                yield image
                number += 1
        finally:
            closing.set()
            reader.join()
            capture.release()
        if number:
            raise PeerTimeout(
                f"{self.kind} {self.text} ended after {number} images: closed, or no image within {self.timeout:g} s"
            )

    def _open(self) -> cv2.VideoCapture:
        # OpenCV logs to the terminal; the error below replaces its message.
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(0)
        try:
            if self.kind == "camera":
                capture = self._open_camera()
                advice = "check the connection and the access rights of this user"
            elif self.kind == "stream":
                self._check_reachable()
                limit = int(self.timeout * 1000)
                options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
                capture = cv2.VideoCapture(name_for_opencv(self.text), cv2.CAP_FFMPEG, options)
                advice = f"no video stream within {self.timeout:g} s; check address and port"
            else:
                self._check_not_text()
                # FFmpeg takes the text before a colon in a relative path for a protocol.
                capture = cv2.VideoCapture(name_for_opencv(Path(self.text).absolute()), cv2.CAP_FFMPEG)
                advice = "not an image or a video that OpenCV can read"
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            capture.release()
            raise PeerError(f"{self.kind} {self.text} cannot be opened: {advice}")
        return capture

    def _open_camera(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(min(int(self.text), _LARGEST_INT))
        if any(self.size):
            # Large images come at full rate only as JPEG, which is then decoded at the size that is needed.
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size[1])
            if _codec(capture) == b"MJPG":
                capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        return capture

    def _check_reachable(self) -> None:
        """Raises PeerError when the address of the stream is unreachable, faster than the video library does."""
        try:
            url = urlsplit(self.text)
            if url.scheme in _PORTS:
                address = url.hostname or "", url.port or _PORTS[url.scheme]
                socket.create_connection(address, timeout=self.timeout).close()
        except (OSError, ValueError) as error:
            raise PeerError(f"stream {self.text} cannot be opened: {error}; check address and port") from None

    def _check_not_text(self) -> None:
        """Raises PeerError for a text file, which FFmpeg would render as a video of characters."""
        try:
            with Path(self.text).open("rb") as file:
                start = file.read(4096)
        except OSError as error:
            raise PeerError(f"{self.text} cannot be read: {error.strerror}") from None
        if start and b"\0" not in start and _is_text(start):
            raise PeerError(f"{self.text} is a text file, not an image or a video")


@dataclass
class _VideoStamps:
    """The increasing time stamps [s] of the images of a video.

    They follow the rate until the times of the container show that it is uneven, and then these times. Containers
    without times state 0 for every image.
    """

    rate: float  # [Hz]
    number: int = 0  # of images so far
    latest: float = 0.0  # latest time in the container [s]
    _first: float = 0.0  # time of the first image in the container [s]
    _uneven: bool = False
    _stamp: float = 0.0  # of the last image

    def next(self, stated: float) -> float:
        """The stamp of the next image, whose time in the container is `stated`."""
        if self.number == 0:
            self._first = self.latest = stated
        even, own = self.number / self.rate, stated - self._first
        # Some containers round times to milliseconds.
        self._uneven |= stated > self.latest and abs(own - even) > _ROUNDING
        self.latest = max(self.latest, stated)
        stamp = own if self._uneven else even
        if self.number:  # several images may have the same millisecond
            stamp = max(stamp, self._stamp + _SMALLEST_STEP / self.rate)
        self.number += 1
        self._stamp = stamp
        return stamp


def _read(capture: cv2.VideoCapture) -> Image | bytes | None:
    """The next image; None at the end."""
    good, image = capture.read()
    if not good:
        return None
    if min(image.shape[:2]) == 1:  # an undecoded image, perhaps a damaged one
        return image.tobytes()
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image, dtype=np.uint8)


def _codec(capture: cv2.VideoCapture) -> bytes:
    """Four-character code of the codec."""
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)


def _is_text(start: bytes) -> bool:
    """Whether `start`, the first bytes of a file, is UTF-8 text; the last character may be incomplete."""
    try:
        start.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start > len(start) - 4 and error.reason == "unexpected end of data"
    return True
