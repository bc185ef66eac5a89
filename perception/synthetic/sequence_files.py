"""Rendered sequences on disk: a folder of JPEG images or an MJPEG video, with a ground-truth file."""

import contextlib
import dataclasses
import json
import zipfile
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.synthetic.sequences import GelSequence

FORMAT = 1
TRUTH = "truth.npz"  # ground truth of a folder; that of a video has the name of the video
_OTHER_FILES = (".mp4", ".avi", ".mkv", ".mov", ".gif", ".png", ".jpg", ".jpeg")
VIDEO = ".mjpeg"  # concatenated JPEG images, readable by video players and FFmpeg


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a rendered sequence. Markers row by row."""

    position: NDArray[np.float32]  # dot centres (right, down) [px], shape (frames, markers, 2)
    visible: NDArray[np.bool_]  # printed, entirely in the image and not covered, shape (frames, markers)
    rows: int
    cols: int
    spacing: float  # marker spacing at rest at the image centre [px]
    made_from: dict[str, Any]  # fields of the `GelSequence`; "appearance" holds those of its appearance


def truth_file(images: Path) -> Path:
    """Path of the ground-truth file of a rendered folder or video."""
    return images.with_suffix(".npz") if images.suffix.lower() == VIDEO else images / TRUTH


def write_sequence(sequence: GelSequence, out: Path) -> Generator[int, None, None]:
    """Renders `sequence` to `out`, a new folder or, with suffix .mjpeg, a video; yields the number of images written.

    The ground truth is written last. Raises UsageError when a file exists or cannot be written. Where a sequence is not
    finished, its images are deleted.
    """
    video = out.suffix.lower() == VIDEO
    if not video and out.suffix.lower() in _OTHER_FILES:
        raise UsageError(f"{out}: give a folder, or a video with the suffix {VIDEO}")
    if truth_file(out).exists() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise UsageError(f"{out} exists and would be overwritten: choose a new name or delete it")
    position, visible = [], []
    try:
        (out.parent if video else out).mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(sequence):
            file = out if video else out / f"{number:06d}.jpg"
            with file.open("ab" if video and number else "xb") as images:
                images.write(frame.jpeg)
            position.append(frame.position)
            visible.append(frame.visible)
            yield number + 1
        np.savez_compressed(
            truth_file(out),
            format=FORMAT,
            position_px=np.array(position, dtype=np.float32),
            visible=np.array(visible),
            rows=sequence.appearance.grid.rows,
            cols=sequence.appearance.grid.cols,
            spacing_px=sequence.appearance.spacing,
            made_from=json.dumps(dataclasses.asdict(sequence)),
        )
    except FileExistsError:  # since the check above
        raise UsageError(f"{out} exists and would be overwritten: another process writes it") from None
    except BaseException as error:
        written = [out] if video else [out / f"{number:06d}.jpg" for number in range(len(position) + 1)]
        with contextlib.suppress(OSError):
            for file in (*written, truth_file(out)):
                file.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise UsageError(f"{out} cannot be written: {error.strerror}") from None
        raise


def read_truth(file: Path) -> GroundTruth:
    """Reads the ground truth that `write_sequence` wrote. Raises UsageError for other files and newer formats."""
    try:
        with np.load(file) as found:
            if int(found["format"]) > FORMAT:
                raise UsageError(
                    f"{file} has format {int(found['format'])}, this gelflow reads up to {FORMAT}: update gelflow"
                )
            made_from = json.loads(str(found["made_from"]))
            if "look" in made_from:  # name of the key in files of gelflow 0.1
                made_from["appearance"] = made_from.pop("look")
            return GroundTruth(
                position=found["position_px"],
                visible=found["visible"],
                rows=int(found["rows"]),
                cols=int(found["cols"]),
                spacing=float(found["spacing_px"]),
                made_from=made_from,
            )
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{file} is not the ground truth of a rendered sequence: {error}") from None
