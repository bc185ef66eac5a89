"""Image sources: a folder, an image file, a video file, a recorded session, a stream or a local camera.

A source is opened when its iteration starts, and iterated once. The cameras of a robot have drivers in gelflow.real.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.clock import Clock, ScaledClock
from gelflow.errors import PeerError, PeerTimeout, UsageError
from gelflow.perception.capture import Capture
from gelflow.perception.errors import TrackerInitError, name_for_opencv
from gelflow.perception.frames import ENCODED, ImageDecoder, UnreadableImage
from gelflow.perception.sensors.profile import SensorProfile, load_sensor_profile
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS

Image = NDArray[np.uint8]

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm"})
_START_LIMIT = 2.0  # for the start of a tracker on the images of a live source [s]

T = TypeVar("T")


@dataclass(frozen=True)
class SourceImage:
    """One image of a source."""

    name: str  # file name, or index in the source
    image: Image  # B G R, shape (height, width, 3)
    stamp: float  # acquisition time [s]: from the start of a video or folder, otherwise robot time
    data: bytes | None = None  # JPEG or PNG data of `image`, if any


@dataclass
class SkippedImages:
    """The images of a source that are not tracked."""

    unreadable: int = 0  # cannot be decoded, or a tracker could not start on them
    first: str = ""  # name of the first unreadable one and the reason
    dropped: int = 0  # live images that arrived while the program was behind

    def add(self, name: str, reason: object) -> None:
        """Count the unreadable image `name`."""
        self.unreadable += 1
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
    profile: SensorProfile = field(default_factory=lambda: load_sensor_profile("generic"))
    skipped: SkippedImages = field(default_factory=SkippedImages, compare=False)  # in the iteration so far

    @property
    def live(self) -> bool:
        """Whether the source is endless."""
        return self.kind in ("stream", "camera")

    def __iter__(self) -> Iterator[SourceImage]:
        """Iterates over the images; those that cannot be decoded are skipped and counted in `skipped`.

        Raises PeerError when no image can be read, a video ends early, or the image size changes, UsageError for a TIFF
        file with several pages or a name that is not UTF-8.
        """
        if self.kind == "session":
            images = self._from_session()
        elif self.files:
            images = self._from_files()
        else:
            images = self._from_capture()
        size = None
        for image in images:
            height, width = image.image.shape[:2]
            size = size or (width, height)
            if (width, height) != size:
                raise PeerError(
                    f"{self.kind} {self.text}: image {image.name} has {width} × {height} px, those before have "
                    f"{size[0]} × {size[1]}: the camera's settings changed"
                )
            yield image
        if size is None:
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
        return self._capture().count()

    def _original(self, data: bytes | None) -> bytes | None:
        """The encoded image, if it shows what `SourceImage.image` shows."""
        return data if self.profile.image.is_plain else None

    def _why_empty(self) -> str:
        """The reason for a source without a readable image."""
        if self.skipped.unreadable == 1 and self.kind == "image":
            return self.skipped.first
        if self.skipped.unreadable:
            return f"none of the {self.skipped.unreadable} images of {self.text} can be read; {self.skipped.first}"
        if self.kind == "session":
            return f"session {self.text} has no image of the {self.sensor} sensor"
        return f"{self.kind} {self.text} was opened but gave no image"

    def _from_files(self) -> Iterator[SourceImage]:
        decoder = ImageDecoder()
        for number, file in enumerate(self.files):
            try:
                data = file.read_bytes()
                image = self.profile.decode(data, decoder)
            except UnreadableImage as error:
                self.skipped.add(str(file), error)
            except PeerError as error:
                raise PeerError(f"{file}: {error}") from None
            except OSError as error:
                self.skipped.add(str(file), f"cannot be read: {error.strerror}")
            else:
                _check_pages(file)
                kept = data if data.startswith(ENCODED) else None
                yield SourceImage(file.name, image, number / self.rate, self._original(kept))

    def _from_session(self) -> Iterator[SourceImage]:
        decoder = ImageDecoder()
        with SessionReader(self.text) as session:
            for record in session.records([f"/{self.sensor}/image"]):
                name = f"{record.value.sequence:06d}"
                try:
                    image = self.profile.decode(record.value.data, decoder)
                except UnreadableImage as error:
                    self.skipped.add(f"image {name} of the {self.sensor} sensor", error)
                else:
                    yield SourceImage(name, image, record.stamp, self._original(record.value.data))

    def _from_capture(self) -> Iterator[SourceImage]:
        capture = self._capture()
        for number, captured in enumerate(capture):
            self.skipped.dropped = capture.dropped
            name, content = f"{number:06d}", captured.content
            data = content if isinstance(content, bytes) else None
            try:
                image = (
                    self.profile.prepare(content) if not isinstance(content, bytes) else self.profile.decode(content)
                )
            except UnreadableImage as error:
                self.skipped.add(f"image {name}", error)
                continue
            yield SourceImage(name, image, captured.stamp, self._original(data))

    def _capture(self) -> Capture:
        size = (self.profile.image.width, self.profile.image.height)
        return Capture(self.text, self.kind, self.rate, self.timeout, self.clock, size)


def image_source(
    text: str | Path, *, sensor: str = "left", rate: float = 25.0, profile: SensorProfile | None = None
) -> ImageSource:
    """The image source at `text`: the number of a camera, the URL of a stream, an .mcap session, a folder or a file.

    Camera 2 is also uvc:2 or uvc:/dev/video2, as in a lab file. Where a file or folder has the number of a camera as
    its name, ./7 is the file and 07 the camera.
    `sensor` selects the camera of a session; `rate` [Hz] gives the time stamps of a folder; `profile` is that of the
    sensor, whose part of each image is used. Raises UsageError when the file or folder does not exist, or the folder
    contains no images.
    """
    text = str(text)
    if not text:
        raise UsageError("expected a folder, a file, a URL or a camera number, got an empty text")
    if sensor not in SENSORS:
        raise UsageError(f"sensor must be {' or '.join(SENSORS)}, got {sensor!r}")
    if not 0.01 <= rate <= 10000:
        raise UsageError(f"rate must be within 0.01 to 10000 Hz, got {rate}")
    profile = profile or load_sensor_profile("generic")
    if camera := re.fullmatch(r"(?:uvc:(?:/dev/video)?)?([0-9]+)", text):
        if camera[1] == text and Path(text).exists():
            raise UsageError(
                f"{text} is a camera and a file or folder: write ./{text} for this, 0{text} for the camera"
            )
        return ImageSource(camera[1], "camera", rate=rate, profile=profile)
    if not text.startswith("uvc:") and re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*://", text):
        return ImageSource(text, "stream", rate=rate, profile=profile)
    path = Path(text)
    if path.suffix.lower() == ".mcap":
        return ImageSource(text, "session", sensor=sensor, profile=profile)
    if path.is_dir():
        files = tuple(sorted((f for f in path.iterdir() if _is_image(f)), key=natural_sort_key))
        if not files:
            raise UsageError(f"folder {text} contains no images (known suffixes: {', '.join(sorted(IMAGE_SUFFIXES))})")
        return ImageSource(text, "folder", files, rate=rate, profile=profile)
    if not path.exists():
        raise UsageError(f"expected a folder, a file, a URL or a camera number; {text} does not exist")
    files = (path,) if _is_image(path) else ()
    return ImageSource(text, "image" if files else "video", files, rate=rate, profile=profile)


def start_on_image(
    source: ImageSource, images: Iterator[SourceImage], start: Callable[[Image], T]
) -> tuple[SourceImage, T]:
    """The first of `images`, those of `source`, and the result of `start` for it.

    Raises the TrackerInitError of `start`: at once for a recorded source; for a live one after 2 s or at its end, and
    the images until then are skipped and counted.
    """
    limit = math.inf
    failed: TrackerInitError | None = None
    try:
        for image in images:
            try:
                return image, start(image.image)
            except TrackerInitError as error:
                limit, failed = min(limit, image.stamp + _START_LIMIT), error
            if not source.live or image.stamp >= limit:
                break
            source.skipped.add(f"image {image.name}", failed)
    except PeerTimeout:  # the live source ends
        if failed is None:
            raise
    if failed is None:
        raise PeerError(f"{source.kind} {source.text} gave no image")
    raise failed


def natural_sort_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key that orders 9.jpg before 10.jpg."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple((1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and path.is_file() and not path.name.startswith(".")


def _check_pages(file: Path) -> None:
    """Raise UsageError for a TIFF file with several pages, or with a name that is not UTF-8.

    OpenCV would read the first page only.
    """
    if file.suffix.lower() in (".tif", ".tiff") and (pages := cv2.imcount(name_for_opencv(file))) > 1:
        raise UsageError(f"{file} has {pages} pages; split it into a folder of images")
