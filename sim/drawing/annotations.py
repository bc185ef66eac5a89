"""Forces in a picture: arrows of contacts, markers of pads, a panel per pad, and the scales of all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.sim.drawing.ray_caster import View
from gelflow.sim.drawing.scene_drawing import ContactForce, PadReading, Polyline, SceneDrawing

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

PANEL_SHARE = 0.27  # of the width of a picture
_INK, _FRAME, _PAPER = (30, 30, 30), (150, 150, 150), (255, 255, 255)
FORCE_COLOR = (213, 94, 0)  # vermilion of gelflow.figures
_ARROW_SHARE = 0.22  # of the height of the picture: the longest contact force
_HIDDEN = 0.45  # opacity of a marker behind a body
_ARROW_CELL = 6.0  # side of the square in a panel that has one arrow [px]
_MAX_DOTS = 1000  # smooth ones, in a panel
_NEGLIGIBLE = 1e-9  # values below are shown as 0
_FRACTION_BITS = 4  # of coordinates for OpenCV


@dataclass(frozen=True)
class ForceScales:
    """Forces at which arrows and colours are at their end [N]."""

    contact: float  # longest arrow of a contact
    normal: float  # brightest marker
    shear: float  # longest arrow of a marker


def force_scales(drawings: Sequence[SceneDrawing]) -> ForceScales:
    """Scales that hold all forces of the drawings: 1, 2 or 5 times a power of ten."""
    contacts = [np.linalg.norm(contact.force) for drawing in drawings for contact in drawing.contacts]
    pads = [pad for drawing in drawings for pad in drawing.pads]
    normal = [pad.normal.max(initial=0) for pad in pads]
    shear = [np.linalg.norm(pad.shear, axis=1).max(initial=0) for pad in pads]
    return ForceScales(*(round_scale(float(max(values, default=0))) for values in (contacts, normal, shear)))


def round_scale(value: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below a value; 1 for a value without a size."""
    if not (np.isfinite(value) and value > _NEGLIGIBLE):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9)))


def quantity(value: float, unit: str) -> str:
    """A value in the unit or, below 1, in its thousandth."""
    if abs(value) < _NEGLIGIBLE:
        return f"0 {unit}"
    return f"{value:.3g} {unit}" if abs(value) >= 1 else f"{value * 1e3:.3g} m{unit}"


def annotate(
    picture: Picture,
    drawing: SceneDrawing,
    view: View,
    *,
    seen: Array,
    scales: ForceScales,
    tile: float,
    title: str,
    polylines: Sequence[Polyline],
) -> None:
    """Draw polylines, forces, panels, scales and title into a picture; `seen` is the distance of each pixel [m]."""
    for polyline in polylines:
        _draw_polyline(picture, polyline, view)
    for pad in drawing.pads:
        _draw_markers(picture, pad, view, seen, scales.normal)
    length = _ARROW_SHARE * view.size[1] * view.camera.distance / view.focal / scales.contact  # [m/N]
    for contact in drawing.contacts:
        _draw_contact(picture, contact, view, length)
    _draw_legend(picture, drawing, view, scales, tile)
    _draw_panels(picture, drawing.pads, scales)
    _text(picture, title, (8, 18))


def _draw_polyline(picture: Picture, polyline: Polyline, view: View) -> None:
    """A dashed line with its label at the first point."""
    dense = []
    for start, end in zip(polyline.points[:-1], polyline.points[1:], strict=True):
        dense.append(start + np.linspace(0, 1, 9)[:-1, None] * (end - start))
    pixels, depth = view.project(np.concatenate([*dense, polyline.points[-1:]]))
    if (depth <= 0).any():
        return
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    for (start, end), at in zip(pairwise(pixels), along[:-1], strict=True):
        if at % 12 < 8:
            cv2.line(picture, _fixed(start), _fixed(end), _INK, 1, cv2.LINE_AA, _FRACTION_BITS)
    _text(picture, polyline.label, (int(pixels[0, 0]) + 5, int(pixels[0, 1]) - 5))


def _draw_markers(picture: Picture, pad: PadReading, view: View, seen: Array, scale: float) -> None:
    """The markers as dots; those behind a body are translucent."""
    pixels, depth = view.project(pad.positions)
    height, width = seen.shape
    at = np.floor(pixels).astype(int)
    within = (depth > 0) & (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
    at, colors = at[within], marker_colors(pad.normal[within] / scale)
    away = np.linalg.norm(pad.positions[within] - view.camera.position, axis=1)
    hidden = seen[at[:, 1], at[:, 0]] < away - 1e-3 * view.camera.distance
    radius = 0.004 * height
    if hidden.any():
        layer = picture.copy()
        _stamp(layer, at[hidden], radius, colors[hidden])
        cv2.addWeighted(layer, _HIDDEN, picture, 1 - _HIDDEN, 0, dst=picture)
    _stamp(picture, at[~hidden], radius, colors[~hidden])


def _draw_contact(picture: Picture, contact: ContactForce, view: View, length: float) -> None:
    """An arrow from the point where the force acts."""
    ends = np.stack([contact.point, contact.point + length * contact.force])
    pixels, depth = view.project(ends)
    if (depth <= 0).any():
        return
    _arrow(picture, pixels[0], pixels[1], _PAPER, 5)
    _arrow(picture, pixels[0], pixels[1], FORCE_COLOR, 2)
    _dot(picture, pixels[0], 3, FORCE_COLOR)


def _draw_legend(picture: Picture, drawing: SceneDrawing, view: View, scales: ForceScales, tile: float) -> None:
    """World axes, distance of the lines on a plane, and the length of a contact force, at the lower left."""
    height = picture.shape[0]
    corner = np.array([34.0, height - 36.0])
    for axis, name in enumerate("xyz"):
        right, up, back = view.camera.axes[:, axis]
        if abs(back) < 0.97:  # an axis along the view has no direction in the picture
            end = corner + 24 * np.array([right, -up])
            _arrow(picture, corner, end, _INK, 1)
            _text(picture, name, (int(end[0] + 5 * right) - 3, int(end[1] - 8 * up) + 4))
    if any(geom.kind == "plane" for geom in drawing.geoms):
        distance = f"{1e3 * tile:.3g} mm" if tile < 1 else f"{tile:.3g} m"
        _text(picture, f"lines {distance} apart", (76, height - 10))
    if drawing.contacts:
        size = _ARROW_SHARE * view.size[1]
        start = np.array([78.0, height - 32.0])
        end = start + np.array([size, 0.0])
        _arrow(picture, start, end, _PAPER, 5)
        _arrow(picture, start, end, FORCE_COLOR, 2)
        _text(picture, f"contact force {quantity(scales.contact, 'N')}", (78, height - 42))


def _draw_panels(picture: Picture, pads: Sequence[PadReading], scales: ForceScales) -> None:
    """One panel per pad at the right: the pad seen from outside, fingertip down."""
    if not pads:
        return
    height, width, _ = picture.shape
    panel = panel_width(width)
    each = min((height - 8) // len(pads), int(1.45 * panel))
    for number, pad in enumerate(pads):
        top = 4 + number * each
        box = picture[top : top + each - 4, width - panel : width - 4]
        box[:] = (0.12 * box + 0.88 * np.array(_PAPER)).astype(np.uint8)
        cv2.rectangle(box, (0, 0), (box.shape[1] - 1, box.shape[0] - 1), _FRAME, 1)
        _draw_panel(box, pad, scales)


def pad_panel(pad: PadReading, scales: ForceScales, size: tuple[int, int]) -> Picture:
    """The panel of a pad alone, RGB (height, width, 3): normal forces as colours, shear forces as arrows, scales.

    The pad is seen from outside with the fingertip down; `size` is width and height [px].
    """
    box = np.full((size[1], size[0], 3), 255, dtype=np.uint8)
    cv2.rectangle(box, (0, 0), (size[0] - 1, size[1] - 1), _FRAME, 1)
    _draw_panel(box, pad, scales)
    return box


def panel_width(width: int) -> int:
    """Width of the panels of pads in a picture [px]."""
    return int(PANEL_SHARE * width)


def _draw_panel(box: Any, pad: PadReading, scales: ForceScales) -> None:
    height, width, _ = box.shape
    total = pad.shear.sum(0)
    _text(box, f"{pad.name}: normal {quantity(float(pad.normal.sum()), 'N')}", (6, 15))
    _text(box, f"shear {quantity(float(np.hypot(*total)), 'N')}", (6, 29))
    top, bottom = 36, height - 38
    rows, columns = pad.layout.T  # x points down, y to the right
    extent = np.array([np.ptp(columns), np.ptp(rows)])
    scale = 0.82 * min((width - 12) / max(extent[0], 1e-9), max(bottom - top, 10) / max(extent[1], 1e-9))
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    pixels = np.array([width / 2, (top + bottom) / 2]) + scale * (np.column_stack([columns, rows]) - middle)
    pitch = scale * float(np.sqrt(max(np.prod(extent), 1e-12) / len(rows)))
    colors = marker_colors(pad.normal / scales.normal)
    if len(pixels) > _MAX_DOTS:
        _stamp(box, np.floor(pixels).astype(int), 0.6 * pitch, colors)
    else:
        for pixel, color in zip(pixels, colors.tolist(), strict=True):
            _dot(box, pixel, max(1.0, 0.3 * pitch), color)
    longest = max(1.6 * pitch, 14.0)
    ends = pixels + longest / scales.shear * pad.shear[:, ::-1]
    chosen = np.unique(np.floor(pixels / _ARROW_CELL), axis=0, return_index=True)[1]  # one arrow per cell
    for start, end in zip(pixels[chosen], ends[chosen], strict=True):
        if np.linalg.norm(end - start) > 1:
            _arrow(box, start, end, _INK, 1)
    y = height - 12
    bar = box[max(y - 8, 0) : max(y, 0), 6:36]  # cut off where the picture is too small
    bar[:] = marker_colors(np.linspace(0, 1, 30))[: bar.shape[1]]
    _text(box, quantity(scales.normal, "N"), (40, y))
    half = width // 2 + 8
    _arrow(box, np.array([half, y - 4.0]), np.array([half + longest, y - 4.0]), _INK, 1)
    _text(box, quantity(scales.shear, "N"), (half + int(longest) + 4, y))
    _text(box, "normal", (6, y - 12))
    _text(box, "shear", (half, y - 12))


def marker_colors(share: Array) -> Picture:
    """RGB colours (n, 3) of markers at shares of the largest normal force (n,): grey, yellow, red to black."""
    levels = np.array([0, 0.02, 0.35, 0.7, 1.0])
    table = np.array([[205, 205, 205], [255, 225, 120], [240, 140, 20], [165, 40, 50], [40, 0, 40]])
    clipped = np.clip(share, 0, 1)
    return np.stack([np.interp(clipped, levels, table[:, channel]) for channel in range(3)], axis=1).astype(np.uint8)


def _stamp(picture: Any, at: NDArray[np.int64], radius: float, colors: Picture) -> None:
    """Discs at pixels (n, 2), all at once."""
    height, width, _ = picture.shape
    reach = np.arange(-int(radius), int(radius) + 1)
    for down in reach:
        for right in reach[np.hypot(down, reach) <= radius + 0.3]:
            x, y = at[:, 0] + right, at[:, 1] + down
            within = (x >= 0) & (y >= 0) & (x < width) & (y < height)
            picture[y[within], x[within]] = colors[within]


def _arrow(picture: Any, start: Array, end: Array, color: tuple[int, int, int], width: int) -> None:
    length = float(np.linalg.norm(end - start))
    if length < 1 or not np.isfinite(length) or length > 1e4:
        return
    head = min(9.0, 0.45 * length)
    direction = (end - start) / length
    side = np.array([-direction[1], direction[0]])
    cv2.line(picture, _fixed(start), _fixed(end - 0.5 * head * direction), color, width, cv2.LINE_AA, _FRACTION_BITS)
    grow = (width - 1) / 2
    tip = np.stack([end + grow * direction, end - head * direction + (0.4 * head + grow) * side,
                    end - head * direction - (0.4 * head + grow) * side])  # fmt: skip
    cv2.fillConvexPoly(picture, np.round(tip * 2**_FRACTION_BITS).astype(np.int32), color, cv2.LINE_AA, _FRACTION_BITS)


def _dot(picture: Any, at: Array, radius: float, color: tuple[int, int, int]) -> None:
    cv2.circle(picture, _fixed(at), int(radius * 2**_FRACTION_BITS), color, -1, cv2.LINE_AA, _FRACTION_BITS)


def _fixed(point: Array) -> tuple[int, int]:
    """Pixel coordinates for OpenCV, whose integer pixel is the centre of ours at 0.5."""
    x, y = np.round((np.clip(point, -1e5, 1e5) - 0.5) * 2**_FRACTION_BITS).astype(int)
    return int(x), int(y)


def _text(picture: Any, text: str, at: tuple[int, int]) -> None:
    """Text with a light outline; OpenCV's font has ASCII characters only."""
    plain = text.replace("°", " deg").encode("ascii", "replace").decode()
    for color, width in ((_PAPER, 3), (_INK, 1)):
        cv2.putText(picture, plain, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, width, cv2.LINE_AA)
