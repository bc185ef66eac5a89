"""Writers of tracked images: CSV table, MCAP session, overlay video.

Every image is written at once, so the files of a killed run are readable: .csv, .mkv and .avi directly, .mcap after
`gelflow recover`. Only .mp4 needs its end.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.perception.errors import name_for_opencv
from gelflow.perception.force.estimator import ForceEstimate
from gelflow.perception.force.image_forces import force_record
from gelflow.perception.force.slip import SlipEstimate
from gelflow.perception.output.csv_file import CsvFile
from gelflow.perception.output.forces import SUFFIX, ForceTable, draw_force
from gelflow.perception.overlay import draw_overlay, write_picture
from gelflow.perception.sources import SourceImage, image_source
from gelflow.perception.tracker import TrackingResult
from gelflow.protocols import CameraImage
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import SENSORS

VIDEO_CODECS = {".mp4": "mp4v", ".mkv": "mp4v", ".avi": "MJPG"}  # by file suffix
PICTURE_SUFFIXES = (".png", ".jpg")

_INTERVALS = 25  # between images, for the median frame interval: the first images of a stream may arrive in a burst
_SYNC_PERIOD = 50  # number of images between waits for the disk

Floats = NDArray[np.float64]
VIDEO_RATES = (0.01, 240.0)  # of video files [images/s]


@dataclass(frozen=True)
class TrackedImage:
    """An image and its tracking result."""

    number: int  # from 0
    frame: SourceImage
    tracked: TrackingResult
    position_mm: Floats | None = None  # on the gel [mm], shape (markers, 2); None without a scale
    displacement_mm: Floats | None = None  # [mm], shape (markers, 2); None without a scale
    force: ForceEstimate | None = None  # in the axes of the image; None without a gel, or if it is not known
    slip: SlipEstimate | None = None  # None where the force is


class TrackWriter(Protocol):
    """A file that is written image by image."""

    def add(self, step: TrackedImage) -> None:
        """Write one image."""

    def close(self) -> None:
        """Finish the file."""


class CsvWriter:
    """Table with one row per image and marker. Unknown values are empty; inferred positions have inferred = 1."""

    def __init__(self, path: Path, *, millimetres: bool) -> None:
        columns = ["frame", "image", "stamp", "marker", "row", "col", "x_px", "y_px", "dx_px", "dy_px"]
        columns += ["x_mm", "y_mm", "dx_mm", "dy_mm"] if millimetres else []
        self._file = CsvFile(path, [*columns, "valid", "inferred", "quality"])

    def add(self, step: TrackedImage) -> None:
        tracked = step.tracked
        numbers = [tracked.position, tracked.displacement]
        if step.position_mm is not None and step.displacement_mm is not None:
            numbers += [step.position_mm, step.displacement_mm]
        first = (step.number, step.frame.name, f"{step.frame.stamp:.6f}")
        flags = zip(tracked.valid.tolist(), tracked.inferred.tolist(), tracked.quality.tolist(), strict=True)
        rows: list[list[object]] = []
        for marker, (row, (valid, inferred, quality)) in enumerate(
            zip(np.column_stack(numbers).tolist(), flags, strict=True)
        ):
            cells = ["" if value != value else f"{value:.5f}" for value in row]
            row_and_column = divmod(marker, tracked.cols)
            rows.append([*first, marker, *row_and_column, *cells, int(valid), int(inferred), f"{quality:.3f}"])
        self._file.write(rows)

    def close(self) -> None:
        self._file.close()


class ForceWriter:
    """Table of the total forces, one row per image."""

    def __init__(self, path: Path) -> None:
        self._table = ForceTable(path)

    def add(self, step: TrackedImage) -> None:
        self._table.add(step.number, step.frame.name, step.frame.stamp, step.force, step.slip)

    def close(self) -> None:
        self._table.close()


class McapWriter:
    """Session with the images and their markers. `description` becomes the description of the session."""

    def __init__(self, path: Path, sensor: str, description: Mapping[str, Any]) -> None:
        self._clock = _StampClock()
        self._sensor = SENSORS.index(sensor)
        # The images have no date. Nothing moves: a slow disk delays the tracking and does not end it.
        self._recorder = SessionRecorder(path, self._clock, epoch=0.0, max_delay=math.inf).open()
        self._recorder.metadata(description)

    def add(self, step: TrackedImage) -> None:
        stamp, tracked = step.frame.stamp, step.tracked
        self._clock.stamp = stamp
        data = step.frame.data if step.frame.data is not None else _png(step.frame.image)
        encoding = "png" if data.startswith(b"\x89PNG") else "jpeg"
        self._recorder.image(self._sensor, CameraImage(data, stamp, step.number, encoding))
        values = {
            "rows": tracked.rows,
            "cols": tracked.cols,
            "spacing_px": tracked.spacing,
            "position_px": tracked.position,
            "displacement_px": tracked.displacement,
            "valid": tracked.valid,
            "inferred": tracked.inferred,
            "quality": tracked.quality,
        }
        if step.displacement_mm is not None:
            values["displacement_mm"] = step.displacement_mm
        self._recorder.markers(self._sensor, stamp, values)
        if step.force is not None:
            self._recorder.force(self._sensor, stamp, force_record(step.force, step.slip))
        if step.number % _SYNC_PERIOD == _SYNC_PERIOD - 1:
            self._recorder.attempt_end()

    def close(self) -> None:
        self._recorder.close()


class _StampClock:
    """Clock of a recording made from images: the stamp of the newest one."""

    stamp = 0.0

    def now(self) -> float:
        return self.stamp

    def sleep(self, seconds: float) -> None:
        """Do not wait."""

    def wall(self, seconds: float) -> float:
        return seconds


class OverlayWriter:
    """Video of the overlays at the rate of the images, or with the suffix of a picture the last overlay."""

    def __init__(self, path: Path, *, magnify: float, forces: bool) -> None:
        self._path, self._magnify, self._forces = path, magnify, forces
        self._waiting: list[TrackedImage] = []  # until the frame interval is known
        self._last: TrackedImage | None = None
        self._video: cv2.VideoWriter | None = None
        self._written = 0  # pictures of the video
        if path.suffix.lower() not in PICTURE_SUFFIXES:
            name_for_opencv(path)
        try:  # before the images are tracked; from then on no other process can take the name
            path.open("xb").close()
        except OSError as error:
            raise UsageError(f"cannot create {path}: {error.strerror}") from None

    def add(self, step: TrackedImage) -> None:
        if self._path.suffix.lower() in PICTURE_SUFFIXES:
            self._last = step
        elif self._video is not None:
            self._write(self._draw(step))
        else:
            self._waiting.append(step)
            if len(self._waiting) > _INTERVALS:
                self._begin()

    def close(self) -> None:
        if self._last is not None:
            write_picture(self._path, self._draw(self._last))
        if self._waiting:
            self._begin()
        if self._video is not None:
            self._video.release()
            check_complete(self._path, self._written)

    def _begin(self) -> None:
        waiting, self._waiting = self._waiting, []
        intervals = np.diff([step.frame.stamp for step in waiting])
        interval = float(np.median(intervals)) if len(intervals) else 0.0
        rate = video_rate(1 / interval) if interval > 0 else 25.0
        pictures = [self._draw(step) for step in waiting]
        size = (pictures[0].shape[1], pictures[0].shape[0])
        code = cv2.VideoWriter.fourcc(*VIDEO_CODECS[self._path.suffix.lower()])
        video = cv2.VideoWriter(str(self._path.absolute()), cv2.CAP_FFMPEG, code, rate, size)
        if not video.isOpened():
            raise UsageError(
                f"cannot write the video {self._path} of {size[0]} × {size[1]} px at {rate:g} images/s: use another "
                "suffix, or a writable folder"
            )
        self._video = video
        for picture in pictures:
            self._write(picture)

    def _write(self, picture: NDArray[np.uint8]) -> None:
        if self._video is not None:
            self._video.write(picture)
            self._written += 1

    def _draw(self, step: TrackedImage) -> NDArray[np.uint8]:
        return overlay(step, magnify=self._magnify, forces=self._forces)


def check_complete(path: Path, written: int) -> None:
    """Raise PeerError when a video does not announce its pictures: OpenCV reports no error of a full disk."""
    try:
        count = image_source(str(path)).count() or 0
    except (PeerError, UsageError):
        count = 0
    if count < 0.98 * written - 2:
        raise PeerError(f"the video {path} is incomplete; is the disk full?")


def video_rate(rate: float) -> float:
    """The nearest rate within `VIDEO_RATES` [images/s] that video files can have.

    MPEG-4 counts time in up to 65535 parts of a second, which OpenCV chooses by the decimals of the rate.
    """
    return round(min(max(rate, VIDEO_RATES[0]), VIDEO_RATES[1]), 3 if rate < 60 else 2)


def overlay(step: TrackedImage, *, magnify: float, forces: bool) -> NDArray[np.uint8]:
    """The image (B G R), enlarged, with its markers and displacements, and with the forces if there is a gel."""
    picture = draw_overlay(step.frame.image, step.tracked, magnify=magnify)
    if forces:
        enlarged = picture.shape[0] / step.frame.image.shape[0]
        draw_force(picture, step.force, step.slip, (step.tracked.position + 0.5) * enlarged - 0.5)
    return picture


def _png(image: NDArray[np.uint8]) -> bytes:
    """Lossless encoding, so that tracking the recording gives the same numbers. Level 1 is fast."""
    _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return data.tobytes()


def open_writer(
    path: Path, *, sensor: str, magnify: float, millimetres: bool, forces: bool, description: Mapping[str, Any]
) -> TrackWriter:
    """The writer for the suffix of `path`: .forces.csv, .csv, .mcap, or a video or picture of overlays.

    Parameters
    ----------
    sensor: channel of the session, left or right
    magnify: length of the arrows of an overlay, relative to the displacement
    millimetres: whether a table has columns in mm
    forces: whether forces are estimated
    description: description of the session

    Raises UsageError for another suffix, or when the file cannot be created.
    """
    suffix = path.suffix.lower()
    if path.name.lower().endswith(SUFFIX):
        return ForceWriter(path)
    if suffix == ".csv":
        return CsvWriter(path, millimetres=millimetres)
    if suffix == ".mcap":
        return McapWriter(path, sensor, description)
    check_suffix(path)
    return OverlayWriter(path, magnify=magnify, forces=forces)


def check_suffix(path: Path) -> None:
    """Raise UsageError when no writer exists for the suffix of `path`."""
    known = (".csv", ".mcap", *VIDEO_CODECS, *PICTURE_SUFFIXES)
    if path.suffix.lower() not in known:
        raise UsageError(f"--out {path}: the suffix must be one of {', '.join(known)}")
