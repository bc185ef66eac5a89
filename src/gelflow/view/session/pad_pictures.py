"""Pictures of both pads side by side: camera images with tracked markers, and the flow maps of a decision."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.figures import rasterize
from gelflow.observation import Grid
from gelflow.perception.tracker import TrackingResult
from gelflow.session.decision_picture import comparison_figure
from gelflow.session.decision_replay import Comparison
from gelflow.session.records import SENSORS
from gelflow.view.session.snapshot import PadImage

Image = NDArray[np.uint8]
HEIGHT = 560  # of the picture [px]
MAGNIFY = 5.0  # of the displacements
_GAP, _TITLE = 6, 24  # [px]
_BACKGROUND, _INK, _PROBLEM = (255, 255, 255), (40, 40, 40), (0, 94, 213)  # B G R
_MEASURED, _INFERRED, _EDGE = (255, 255, 255), (0, 165, 255), (0, 0, 0)
_LOST = 4  # half the size of the cross at a marker that is not measured [px]
_FONT_SIZE = 11  # of the flow maps [pt], because the page shows them smaller
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def pads_picture(pads: Sequence[PadImage | None], *, markers: bool = True) -> Image:
    """The newest images of all pads that have one side by side, RGB; with `markers` also grid and displacements."""
    shown = [(pad, name) for pad, name in zip(pads, SENSORS, strict=False) if pad is not None or not any(pads)]
    pictures = [_pad_picture(pad, name, markers) for pad, name in shown]
    gap = np.full((pictures[0].shape[0], _GAP, 3), 255, dtype=np.uint8)
    row = [piece for picture in pictures for piece in (picture, gap)][:-1]
    return np.ascontiguousarray(np.hstack(row)[..., ::-1])


def _pad_picture(pad: PadImage | None, name: str, markers: bool) -> Image:
    """One image under its title, `HEIGHT` px high, B G R."""
    if pad is None:
        picture, text = np.full((HEIGHT, HEIGHT * 3 // 4, 3), 235, dtype=np.uint8), f"{name} pad: no image"
        return _titled(picture, text, _INK)
    scale = HEIGHT / pad.pixels.shape[0]
    width = max(round(pad.pixels.shape[1] * scale), 1)
    resized = cv2.resize(pad.pixels, (width, HEIGHT), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    picture = np.asarray(resized, dtype=np.uint8)
    if markers and pad.tracked is not None:
        _draw_markers(picture, pad.tracked, scale)
    if pad.problem:
        return _titled(picture, f"{name} pad: {pad.problem}", _PROBLEM)
    return _titled(picture, f"{name} pad", _INK)


def _draw_markers(picture: Image, tracked: TrackingResult, scale: float) -> None:
    """A dot at every measured marker, a line `MAGNIFY` times as long as its displacement; crosses where it is lost."""
    positions = (tracked.position + 0.5) * scale - 0.5
    tips = positions + MAGNIFY * scale * np.nan_to_num(tracked.displacement)
    limits = np.array([[picture.shape[1], picture.shape[0]]]) * 2.0
    starts, ends = (np.clip(points, -limits, limits) * 2**_SHIFT for points in (positions, tips))
    for start, end, measured, inferred in zip(
        starts.round().astype(int).tolist(), ends.round().astype(int).tolist(), tracked.valid, tracked.inferred,
        strict=True,
    ):  # fmt: skip
        if not (measured or inferred):
            middle = start[0] >> _SHIFT, start[1] >> _SHIFT
            cv2.drawMarker(picture, middle, _PROBLEM, cv2.MARKER_TILTED_CROSS, 2 * _LOST, 2, cv2.LINE_AA)
            continue
        color = _MEASURED if measured else _INFERRED
        for drawn, thickness in ((_EDGE, 3), (color, 1)):
            cv2.line(picture, start, end, drawn, thickness, cv2.LINE_AA, _SHIFT)
        cv2.circle(picture, start, 2 << _SHIFT, color, -1, cv2.LINE_AA, _SHIFT)


def _titled(picture: Image, text: str, color: tuple[int, int, int]) -> Image:
    title = np.full((_TITLE, picture.shape[1], 3), _BACKGROUND, dtype=np.uint8)
    cv2.putText(title, text[:60], (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)
    return np.vstack([title, picture])


def decision_picture(comparison: Comparison, grid: Grid) -> Image:
    """The flow maps and the correction of a decision, and those of its replay where they differ, RGB."""
    return rasterize(comparison_figure([comparison], grid, font_size=_FONT_SIZE))
