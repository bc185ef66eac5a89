"""The picture of a session's timeline: curves, attempts and events over time, and the present as a line."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, GREEN, ORANGE, PURPLE, VERMILION, rasterize
from gelflow.view.session.curves import ARM, FORCES, GRIPPER, Curve, Curves
from gelflow.view.session.timeline_events import TimelineEvent

Image = NDArray[np.uint8]
WIDTH, HEIGHT = 640, 310  # [px]
_LEGEND_ROOM = 0.35  # above the curves of shear, in heights of the curves
_PRESENT = np.array((0, 0, 0), dtype=np.uint8)
_SPANS = {"inserted": (GREEN, ""), "not inserted": (ORANGE, "//")}  # colour and hatch of attempts
_POINTS = {  # colour, symbol and name of events without a duration
    "decision": (BLUE, "D", "decision"),
    "difference": (VERMILION, "X", "replay differs"),
    "warning": (PURPLE, "v", "warning"),
    "stop": (VERMILION, "s", "stop"),
}


class Timeline:
    """The timeline of curves and events; `with_present` draws the present into it.

    Parameters
    ----------
    curves, events: to draw
    origin: robot time that is 0 on the axis [s]
    topics: of the session; curves whose topics are missing get no axis
    """

    def __init__(
        self, curves: Curves, events: Sequence[TimelineEvent], *, origin: float, topics: Collection[str]
    ) -> None:
        from matplotlib.figure import Figure  # deferred: slow to import

        figure = Figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
        figure.subplots_adjust(left=0.105, right=0.985, top=0.92, bottom=0.14, hspace=0.18)
        rows = [
            *([_draw_height] if ARM in topics else []),
            _draw_shear,
            *([_draw_forces] if {GRIPPER, *FORCES} & set(topics) else []),
        ]
        bars, *axes = figure.subplots(
            1 + len(rows), 1, sharex=True, height_ratios=(0.18 * len(rows), *(1 for _ in rows))
        )
        self._start, self._end = curves.start, curves.end
        bars.set_xlim(curves.start - origin, max(curves.end, curves.start + 1e-3) - origin)
        inside = [event for event in events if event.end >= curves.start and event.time <= curves.end]
        _draw_events(bars, inside, origin)
        handles, labels = bars.get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="upper right", fontsize=7, ncols=len(labels), frameon=False, borderpad=0)
        for draw, axis in zip(rows, axes, strict=True):
            _shade(axis, inside, origin)
            axis.grid(alpha=0.3)
            axis.tick_params(labelsize=7)
            draw(axis, curves, origin)
        axes[-1].set_xlabel("time since the start of the recording [s]", fontsize=7)
        figure.align_ylabels([bars, *axes])
        self._picture: Image = rasterize(figure)
        box = axes[0].get_window_extent()
        self._left, self._right = float(box.x0), float(box.x1)

    def with_present(self, time: float) -> Image:
        """The picture with a line at a robot time [s], RGB of shape (HEIGHT, WIDTH, 3)."""
        picture = self._picture.copy()
        fraction = (time - self._start) / max(self._end - self._start, 1e-9)
        if 0 <= fraction <= 1:
            column = round(self._left + fraction * (self._right - self._left))
            picture[: -round(0.1 * HEIGHT), max(column - 1, 0) : column + 1] = _PRESENT
        return picture


def _draw(axis: Any, curves: Sequence[Curve], colors: Sequence[str], origin: float) -> None:
    for curve, color, style in zip(curves, colors, ("-", "--"), strict=False):
        times, values = curve.ordered()
        axis.plot(times - origin, values, style, color=color, linewidth=1.1, label=curve.label)


def _draw_height(axis: Any, curves: Curves, origin: float) -> None:
    _draw(axis, [curves.height], ["black"], origin)
    axis.set_ylabel("height\n[mm]", fontsize=7)


def _draw_shear(axis: Any, curves: Curves, origin: float) -> None:
    _draw(axis, curves.shear, [BLUE, VERMILION], origin)
    axis.set_ylabel("shear\n[mm]" if curves.shear_in_millimetres else "markers\n[px]", fontsize=7)
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + _LEGEND_ROOM * (high - low))
    axis.legend(loc="upper left", fontsize=6, ncols=2, framealpha=0.7, borderpad=0.2, borderaxespad=0.2)


def _draw_forces(axis: Any, curves: Curves, origin: float) -> None:
    """The force of the gripper, and where they are recorded, the normal forces of the pads."""
    _draw(axis, [curves.force], ["black"], origin)
    axis.set_ylabel("grip\n[N]", fontsize=7)
    if not any(curve.samples for curve in curves.normal):
        return
    _draw(axis, curves.normal, [BLUE, VERMILION], origin)
    if curves.gross_slip.samples:
        times, values = curves.gross_slip.ordered()
        axis.plot(times - origin, values, "x", color=PURPLE, markersize=3, label=curves.gross_slip.label)
    axis.legend(loc="upper left", fontsize=6, ncols=4, framealpha=0.7)


def _shade(axis: Any, events: Sequence[TimelineEvent], origin: float) -> None:
    for event in events:
        if event.kind in _SPANS:
            axis.axvspan(event.time - origin, event.end - origin, color=_SPANS[event.kind][0], alpha=0.12, linewidth=0)


def _draw_events(axis: Any, events: Sequence[TimelineEvent], origin: float) -> None:
    """Attempts as bars, other events as symbols above them."""
    axis.set(ylim=(0, 2.2), yticks=[], ylabel="events")
    axis.yaxis.label.set_fontsize(7)
    axis.tick_params(bottom=False, labelbottom=False)
    named: set[str] = set()
    for event in events:
        label: str | None = None if event.kind in named else event.kind
        if event.kind in _SPANS:
            color, hatch = _SPANS[event.kind]
            axis.barh(
                0.5, event.end - event.time, left=event.time - origin, height=0.8, color=color, hatch=hatch,
                edgecolor="white", linewidth=0.5, label=label,
            )  # fmt: skip
        else:
            color, symbol, name = _POINTS[event.kind]
            label = None if event.kind in named else name
            axis.plot(event.time - origin, 1.55, symbol, color=color, markersize=5, label=label, linestyle="none")
        named.add(event.kind)
