"""Errors of images: a first image that cannot be the reference, and a file name that OpenCV cannot use."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError

_DOT = (0, 255, 255)
_LINE = (255, 180, 0)
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


class TrackerInitError(PeerError):
    """No grid of markers was reliably found in the first image; the message states the reason.

    `picture` (B G R, uint8) is the image with the detections: yellow rings are dots, blue lines join grid neighbours.
    """

    def __init__(self, reason: str, picture: NDArray[np.uint8]) -> None:
        super().__init__(reason)
        self.picture = picture


def draw_detections(
    image: NDArray[np.uint8], centers: NDArray[np.float64], radius: float, grid: NDArray[np.intp] | None
) -> NDArray[np.uint8]:
    """`image` (B G R) with rings of `radius` [px] around `centers` (right, down) [px], shape (n, 2).

    `grid`, shape (rows, columns), holds the index of the dot at each node, −1 without a dot.
    """
    picture = image.copy()
    fixed = np.round(centers * 2**_SHIFT).astype(np.int32)
    if grid is not None:
        for one, two in ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])):
            joined = (one >= 0) & (two >= 0)
            lines = np.stack([fixed[one[joined]], fixed[two[joined]]], axis=1)
            cv2.polylines(picture, list(lines), False, _LINE, 1, cv2.LINE_AA, _SHIFT)
    for right, down in fixed.tolist():
        cv2.circle(picture, (right, down), round((radius + 1) * 2**_SHIFT), _DOT, 1, cv2.LINE_AA, _SHIFT)
    return picture


def name_for_opencv(path: Path | str) -> str:
    """The name of a file for OpenCV. Raises UsageError where it is not UTF-8: OpenCV would end the process."""
    name = str(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        raise UsageError(f"the file name {name!r} is not valid UTF-8: rename the file") from None
    return name
