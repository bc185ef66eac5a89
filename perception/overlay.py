"""Draws a tracking result over its image: markers, grid and displacements; writes pictures."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.tracker import TrackingResult

_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_ARROW = (255, 255, 255)
_INFERRED = (0, 165, 255)
_LOST = (60, 60, 255)
_EDGE = (0, 0, 0)


def draw_overlay(
    image: NDArray[np.uint8], result: TrackingResult, *, magnify: float = 3.0, smallest: int = 900
) -> NDArray[np.uint8]:
    """`image` (B G R) with the tracked markers, enlarged to at least `smallest` px on the longer side.

    Grid lines change from blue (top row, left column) to yellow. Arrows at valid markers show the displacement enlarged
    by `magnify`. Inferred markers have an orange ring, markers that are neither valid nor inferred a red cross at the
    last position.
    """
    scale = max(1, int(np.ceil(smallest / max(image.shape[:2]))))
    larger = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    picture = np.asarray(larger, dtype=np.uint8)
    shape = (result.rows, result.cols)
    # The centre of a pixel maps to the centre of a block of scale × scale pixels.
    positions = np.asarray((result.position + 0.5) * scale - 0.5).reshape(*shape, 2)
    valid = result.valid.reshape(shape)
    _draw_grid(picture, positions, valid, _colours(shape[0]), _colours(shape[1]))
    tips = positions + magnify * scale * np.nan_to_num(result.displacement).reshape(*shape, 2)
    reach = max(2.0, 0.16 * result.spacing * scale)
    for position, tip, measured, inferred in zip(
        positions.reshape(-1, 2), tips.reshape(-1, 2), result.valid, result.inferred, strict=True
    ):
        if inferred:
            cv2.circle(picture, _fixed(position), round(reach * 2**_SHIFT), _INFERRED, 2, cv2.LINE_AA, _SHIFT)
        elif not measured:
            _cross(picture, position, reach)
        if not measured:
            continue
        cv2.circle(picture, _fixed(position), round(0.3 * reach * 2**_SHIFT), _ARROW, 1, cv2.LINE_AA, _SHIFT)
        length = float(np.linalg.norm(tip - position))
        if length >= 2.0:
            head = min(0.35, 7.0 / length)
            cv2.arrowedLine(picture, _fixed(position), _fixed(tip), _EDGE, 3, cv2.LINE_AA, _SHIFT, head)
            cv2.arrowedLine(picture, _fixed(position), _fixed(tip), _ARROW, 1, cv2.LINE_AA, _SHIFT, head)
    _caption(picture, result, magnify)
    return picture


def _draw_grid(
    picture: NDArray[np.uint8],
    positions: NDArray[np.float64],
    valid: NDArray[np.bool_],
    lines: list[tuple[int, int, int]],
    columns: list[tuple[int, int, int]],
) -> None:
    rows, cols = valid.shape
    for i in range(rows):
        for j in range(cols):
            if j + 1 < cols and valid[i, j] and valid[i, j + 1]:
                cv2.line(
                    picture, _fixed(positions[i, j]), _fixed(positions[i, j + 1]), lines[i], 1, cv2.LINE_AA, _SHIFT
                )
            if i + 1 < rows and valid[i, j] and valid[i + 1, j]:
                cv2.line(
                    picture, _fixed(positions[i, j]), _fixed(positions[i + 1, j]), columns[j], 1, cv2.LINE_AA, _SHIFT
                )


def _caption(picture: NDArray[np.uint8], result: TrackingResult, magnify: float) -> None:
    lengths = np.linalg.norm(result.displacement[result.valid], axis=1)
    largest = f"{lengths.max():.1f} px" if len(lengths) else "none"
    counts = f"{result.valid.sum()}/{result.valid.size} valid, {result.inferred.sum()} inferred"
    text = f"{counts}, largest {largest}, arrows x{magnify:g}"
    for colour, thickness in ((_EDGE, 3), (_ARROW, 1)):
        cv2.putText(picture, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, thickness, cv2.LINE_AA)


def _colours(number: int) -> list[tuple[int, int, int]]:
    """Colour ramp from blue over green to yellow, B G R, bright enough for dark gels."""
    ramp = np.linspace(0, 1, max(number, 2))[:number]
    return [(int(255 * (1 - t)), int(140 + 110 * t), int(80 + 175 * t**2)) for t in ramp]


def _cross(picture: NDArray[np.uint8], position: NDArray[np.float64], reach: float) -> None:
    for start, end in (((-reach, -reach), (reach, reach)), ((-reach, reach), (reach, -reach))):
        cv2.line(picture, _fixed(position + start), _fixed(position + end), _LOST, 2, cv2.LINE_AA, _SHIFT)


def _fixed(position: NDArray[np.float64]) -> tuple[int, int]:
    # OpenCV's coordinates are 32-bit integers.
    right, down = np.clip(position, -20000, 20000) * 2**_SHIFT
    return round(float(right)), round(float(down))


def write_picture(path: Path, picture: NDArray[Any]) -> None:
    """Write a picture (B G R) in the format of the suffix. Unlike `cv2.imwrite` it takes any file name.

    Raises OSError when the file cannot be written.
    """
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())
