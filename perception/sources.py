"""Image sources: a folder, an image file, a video file, a recorded session, a stream or a local camera.

A source is opened when its iteration starts, and iterated once. The cameras of a robot have drivers in gelflow.real.
"""

import os
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.clock import Clock, ScaledClock
from gelflow.errors import PeerError, PeerTimeout, UsageError
from gelflow.perception.frames import ENCODED, decode_image
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS

Image = NDArray[np.uint8]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm"})
_PORTS = {"http": 80, "https": 443, "rtsp": 554, "rtmp": 1935}  # default ports of the protocols over TCP
_MISSING, _MISSING_SHARE = 2, 0.02  # images at the end of a video that its container may announce in excess
# Silences FFmpeg; OpenCV reads the variable at the first use of FFmpeg.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@dataclass(frozen=True)
class SourceImage:
    """One image of a source."""

    name: str  # file name, or index in the source
    image: Image  # B G R, shape (height, width, 3)
    stamp: float  # acquisition time [s]: from the start of a video or folder, otherwise robot time
    data: bytes | None = None  # JPEG or PNG data of `image`, if any


@dataclass
class UnreadableImages:
    """The images of a source that were skipped because they cannot be decoded."""

    count: int = 0
    first: str = ""  # name of the first one and why it cannot be read

    def add(self, name: str, reason: object) -> None:
        """Count the image `name`."""
        self.count += 1
        self.first = self.first or f"{name}: {reason}"


@dataclass(frozen=True)
class ImageSource:
    """A finite or endless sequence of images; see `image_source`."""

    text: str  # location as given by the user
    kind: str  # "folder", "image", "video", "session", "stream" or "camera"
    files: tuple[Path, ...] = ()  # of a folder or an image
    sensor: str = "left"  # of a session
    rate: float = 25.0  # frame rate of a folder, and of a video without a rate [Hz]
    timeout: float = 5.0  # of a stream, for opening and for each image [s]
    clock: Clock = field(default_factory=ScaledClock)  # time stamps of live images
    unreadable: UnreadableImages = field(default_factory=UnreadableImages, compare=False)  # of the iteration so far

    @property
    def live(self) -> bool:
        """Whether the source is endless."""
        return self.kind in ("stream", "camera")

    def __iter__(self) -> Iterator[SourceImage]:
        """Iterates over the images; those that cannot be decoded are skipped and counted in `unreadable`.

        Raises PeerError when no image can be read, a video ends early, or the image size of a stream changes.
        """
        if self.kind == "session":
            images = self._from_session()
        elif self.files:
            images = self._from_files()
        else:
            images = self._from_capture()
        empty = True
        for image in images:
            empty = False
            yield image
        if empty:
            raise PeerError(self._why_empty())

    def count(self) -> int | None:
        """Number of images, None if unknown."""
        if self.files:
            return len(self.files)
        if self.live:
            return None
        if self.kind == "session":
            with SessionReader(self.text) as session:
                return session.counts().get(f"/{self.sensor}/image", 0)
        capture = self._open()
        number = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        return number if number > 0 else None

    def _why_empty(self) -> str:
        """The reason for a source without a readable image."""
        if self.unreadable.count == 1 and self.kind == "image":
            return self.unreadable.first
        if self.unreadable.count:
            return f"none of the {self.unreadable.count} images of {self.text} can be read; {self.unreadable.first}"
        if self.kind == "session":
            return f"session {self.text} has no image of the {self.sensor} sensor"
        return f"{self.kind} {self.text} was opened but gave no image"

    def _from_files(self) -> Iterator[SourceImage]:
        for number, file in enumerate(self.files):
            try:
                data = file.read_bytes()
                image = decode_image(data)
            except PeerError as error:
                self.unreadable.add(str(file), error)
            except OSError as error:
                self.unreadable.add(str(file), f"cannot be read: {error.strerror}")
            else:
                yield SourceImage(file.name, image, number / self.rate, data if data.startswith(ENCODED) else None)

    def _from_session(self) -> Iterator[SourceImage]:
        with SessionReader(self.text) as session:
            for record in session.records([f"/{self.sensor}/image"]):
                name = f"{record.value.sequence:06d}"
                try:
                    image = decode_image(record.value.data)
                except PeerError as error:
                    self.unreadable.add(f"image {name} of the {self.sensor} sensor", error)
                else:
                    yield SourceImage(name, image, record.stamp, record.value.data)

    def _from_capture(self) -> Iterator[SourceImage]:
        capture = self._open()
        rate = capture.get(cv2.CAP_PROP_FPS)
        rate = rate if 0.1 <= rate <= 1000 else self.rate
        # FFmpeg scales the images of a stream whose size changes; undecoded JPEG images keep their size.
        encoded = self.kind == "stream" and _codec(capture) == b"MJPG" and capture.set(cv2.CAP_PROP_FORMAT, -1)
        expected, number, seconds = capture.get(cv2.CAP_PROP_FRAME_COUNT), 0, 0.0
        size: tuple[int, ...] | None = None
        try:
            while True:
                good, image = capture.read()
                if not good:
                    break
                name, data = f"{number:06d}", image.tobytes() if encoded else None
                stamp = self.clock.now() if self.live else number / rate
                seconds = max(seconds, capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
                number += 1
                try:
                    image = decode_image(data) if data is not None else _in_colour(image)
                except PeerError as error:
                    self.unreadable.add(f"image {name}", error)
                    continue
                size = size or image.shape[:2]
                if image.shape[:2] != size:
                    raise PeerError(
                        f"{self.kind} {self.text}: image {name} has {image.shape[1]} × {image.shape[0]} px, those "
                        f"before have {size[1]} × {size[0]}: the camera's settings changed"
                    )
                yield SourceImage(name, image, stamp, data)
        finally:
            capture.release()
        if number and self.live:
            raise PeerTimeout(
                f"{self.kind} {self.text} ended after {number} images: closed, or no image within {self.timeout:g} s"
            )
        missing = expected - max(number, seconds * rate + 1)  # by time too: a container may only estimate the number
        if number and missing > max(_MISSING, _MISSING_SHARE * expected):
            raise PeerError(
                f"video {self.text} ends after {number} of {expected:.0f} images: it is truncated or damaged"
            )

    def _open(self) -> cv2.VideoCapture:
        # OpenCV logs to the terminal; the error below replaces its message.
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(0)
        try:
            if self.kind == "camera":
                capture = cv2.VideoCapture(int(self.text))
                advice = "check the connection and the access rights of this user"
            elif self.kind == "stream":
                self._check_reachable()
                limit = int(self.timeout * 1000)
                options = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
                capture = cv2.VideoCapture(self.text, cv2.CAP_FFMPEG, options)
                advice = f"no video stream within {self.timeout:g} s; check address and port"
            else:
                self._check_not_text()
                capture = cv2.VideoCapture(self.text, cv2.CAP_FFMPEG)
                advice = "not an image or a video that OpenCV can read"
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            capture.release()
            raise PeerError(f"{self.kind} {self.text} cannot be opened: {advice}")
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


def image_source(text: str, *, sensor: str = "left", rate: float = 25.0) -> ImageSource:
    """The image source at `text`: the number of a camera, the URL of a stream, an .mcap session, a folder or a file.

    `sensor` selects the camera of a session; `rate` [Hz] gives the time stamps of a folder. Raises UsageError when the
    file or folder does not exist, or the folder contains no images.
    """
    if not text:
        raise UsageError("expected a folder, a file, a URL or a camera number, got an empty text")
    if sensor not in SENSORS:
        raise UsageError(f"sensor must be {' or '.join(SENSORS)}, got {sensor!r}")
    if not 0.01 <= rate <= 10000:
        raise UsageError(f"rate must be within 0.01 to 10000 Hz, got {rate}")
    if text.isascii() and text.isdigit():
        return ImageSource(text, "camera", rate=rate)
    if re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://", text):
        return ImageSource(text, "stream", rate=rate)
    path = Path(text)
    if path.suffix.lower() == ".mcap":
        return ImageSource(text, "session", sensor=sensor)
    if path.is_dir():
        files = tuple(sorted((f for f in path.iterdir() if _is_image(f)), key=natural_sort_key))
        if not files:
            raise UsageError(f"folder {text} contains no images (known suffixes: {', '.join(sorted(IMAGE_SUFFIXES))})")
        return ImageSource(text, "folder", files, rate=rate)
    if not path.exists():
        raise UsageError(f"expected a folder, a file, a URL or a camera number; {text} does not exist")
    return ImageSource(text, "image", (path,)) if _is_image(path) else ImageSource(text, "video", rate=rate)


def _codec(capture: cv2.VideoCapture) -> bytes:
    """Four-character code of the codec."""
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)


def _in_colour(image: cv2.typing.MatLike) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image, dtype=np.uint8)


def natural_sort_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key that orders 9.jpg before 10.jpg."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts)


def _is_text(start: bytes) -> bool:
    """Whether `start`, the first bytes of a file, is UTF-8 text; the last character may be incomplete."""
    try:
        start.decode("utf-8")
    except UnicodeDecodeError as error:
        return error.start > len(start) - 4 and error.reason == "unexpected end of data"
    return True


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file() and not path.name.startswith(".")
