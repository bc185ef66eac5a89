"""The picture that shows what the tracker saw: markers, the grid they form, and where each went."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.tracker import TrackingResult

_SHIFT = 4  # OpenCV takes coordinates in 1/16 px
_ARROW = (255, 255, 255)
_GUESSED = (0, 165, 255)
_LOST = (60, 60, 255)
_EDGE = (0, 0, 0)


def draw_overlay(
    image: NDArray[np.uint8], tracked: TrackingResult, *, magnify: float = 3.0, smallest: int = 900
) -> NDArray[np.uint8]:
    """`image` (B G R) with the tracked markers drawn over it, enlarged to at least `smallest` px on its longer side.

    Lines between neighbours go from blue (top line, left column) to yellow; the arrow at each valid marker shows its
    displacement `magnify` times. A marker whose place was inferred gets an orange ring there instead, one of which
    nothing is known a red cross where it was last.
    """
    scale = max(1, int(np.ceil(smallest / max(image.shape[:2]))))
    larger = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    picture = np.asarray(larger, dtype=np.uint8)
    shape = (tracked.rows, tracked.cols)
    # The centre of a pixel of the small image lies in the middle of the scale × scale block that it became.
    places = np.asarray((tracked.position + 0.5) * scale - 0.5).reshape(*shape, 2)
    valid = tracked.valid.reshape(shape)
    _draw_grid(picture, places, valid, _colours(shape[0]), _colours(shape[1]))
    tips = places + magnify * scale * np.nan_to_num(tracked.displacement).reshape(*shape, 2)
    reach = max(2.0, 0.16 * tracked.spacing * scale)
    for place, tip, good, guessed in zip(
        places.reshape(-1, 2), tips.reshape(-1, 2), tracked.valid, tracked.inferred, strict=True
    ):
        if guessed:
            cv2.circle(picture, _fixed(place), round(reach * 2**_SHIFT), _GUESSED, 2, cv2.LINE_AA, _SHIFT)
        elif not good:
            _cross(picture, place, reach)
        if not good:
            continue
        cv2.circle(picture, _fixed(place), round(0.3 * reach * 2**_SHIFT), _ARROW, 1, cv2.LINE_AA, _SHIFT)
        length = float(np.linalg.norm(tip - place))
        if length >= 2.0:
            head = min(0.35, 7.0 / length)
            cv2.arrowedLine(picture, _fixed(place), _fixed(tip), _EDGE, 3, cv2.LINE_AA, _SHIFT, head)
            cv2.arrowedLine(picture, _fixed(place), _fixed(tip), _ARROW, 1, cv2.LINE_AA, _SHIFT, head)
    _caption(picture, tracked, magnify)
    return picture


def _draw_grid(
    picture: NDArray[np.uint8],
    places: NDArray[np.float64],
    valid: NDArray[np.bool_],
    lines: list[tuple[int, int, int]],
    columns: list[tuple[int, int, int]],
) -> None:
    rows, cols = valid.shape
    for i in range(rows):
        for j in range(cols):
            if j + 1 < cols and valid[i, j] and valid[i, j + 1]:
                cv2.line(picture, _fixed(places[i, j]), _fixed(places[i, j + 1]), lines[i], 1, cv2.LINE_AA, _SHIFT)
            if i + 1 < rows and valid[i, j] and valid[i + 1, j]:
                cv2.line(picture, _fixed(places[i, j]), _fixed(places[i + 1, j]), columns[j], 1, cv2.LINE_AA, _SHIFT)


def _caption(picture: NDArray[np.uint8], tracked: TrackingResult, magnify: float) -> None:
    lengths = np.linalg.norm(tracked.displacement[tracked.valid], axis=1)
    largest = f"{lengths.max():.1f} px" if len(lengths) else "none"
    seen = f"{tracked.valid.sum()}/{tracked.valid.size} valid, {tracked.inferred.sum()} inferred"
    text = f"{seen}, largest {largest}, arrows x{magnify:g}"
    for colour, thickness in ((_EDGE, 3), (_ARROW, 1)):
        cv2.putText(picture, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, thickness, cv2.LINE_AA)


def _colours(number: int) -> list[tuple[int, int, int]]:
    """From blue over green to yellow, light enough for dark gels, as B G R."""
    ramp = np.linspace(0, 1, max(number, 2))[:number]
    return [(int(255 * (1 - t)), int(140 + 110 * t), int(80 + 175 * t**2)) for t in ramp]


def _cross(picture: NDArray[np.uint8], place: NDArray[np.float64], reach: float) -> None:
    for one, two in (((-reach, -reach), (reach, reach)), ((-reach, reach), (reach, -reach))):
        cv2.line(picture, _fixed(place + one), _fixed(place + two), _LOST, 2, cv2.LINE_AA, _SHIFT)


def _fixed(place: NDArray[np.float64]) -> tuple[int, int]:
    # Far outside is as good as anywhere outside, and OpenCV's coordinates are 32-bit.
    right, down = np.clip(place, -20000, 20000) * 2**_SHIFT
    return round(float(right)), round(float(down))
