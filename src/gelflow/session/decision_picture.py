"""A picture of the policy's observations and corrections, recorded and recomputed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, VERMILION, add_arrows, draw_flow_map, save
from gelflow.observation import Grid
from gelflow.session.decision_replay import Comparison, difference
from gelflow.session.records import SENSORS

MAX_DECISIONS = 40  # in one picture
_VISIBLE = 0.02  # difference of two arrows, relative to the longest one


def draw_comparisons(comparisons: Sequence[Comparison], grid: Grid, path: str | Path) -> None:
    """Draw one row per decision: the flow map of each pad and frame as arrows, and the correction as text.

    Where the recomputed decision differs visibly from the recorded one, both are drawn: the recorded one in blue, the
    recomputed one in red and narrower. The view is from outside onto the pad, fingertip down, so x points down and y to
    the right. At most the first 40 decisions are drawn. Raises UsageError when the picture cannot be written.
    """
    save(comparison_figure(comparisons, grid), path, make_folder=False)


def comparison_figure(comparisons: Sequence[Comparison], grid: Grid, *, font_size: float = 8) -> Any:
    """The figure of `draw_comparisons`; `font_size` is in points."""
    from matplotlib.figure import Figure  # deferred: slow to import

    shown = list(comparisons[:MAX_DECISIONS])
    columns = shown[0].recorded.flow.shape[0] // 2
    figure = Figure(figsize=(2.1 * columns + 2.2, 2.6 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for line, comparison in zip(axes, shown, strict=True):
        _draw_row(line, comparison, grid, font_size)
    notes = "flow maps at the frames of a decision, longest arrow = 1; fingertip down"
    if any(_texts(comparison)[1] or _flow_differs(comparison) for comparison in shown):
        notes += "\nblue: recorded; red: recomputed, where it differs visibly"
    figure.supxlabel(notes, fontsize=font_size)
    return figure


def _draw_row(line: Any, comparison: Comparison, grid: Grid, font_size: float) -> None:
    decision = comparison.recorded
    columns, sensors = len(line), len(decision.tracked)
    recorded = decision.flow.reshape(columns, 2, -1)
    recomputed = comparison.flow.image.reshape(columns, 2, -1) if _flow_differs(comparison) else None
    for column, axis in enumerate(line):
        draw_flow_map(axis, grid, recorded[column])
        if recomputed is not None:
            add_arrows(axis, grid, recomputed[column], color=VERMILION, width=0.004)
        axis.set_title(f"{SENSORS[column % sensors]} pad", fontsize=font_size)
    line[0].set_ylabel(f"insertion {decision.insertion}, attempt {decision.attempt}", fontsize=font_size)
    first, second = _texts(comparison)
    for text, color, height, alignment in ((first, BLUE, 0.52, "bottom"), (second, VERMILION, 0.48, "top")):
        layout = {"transform": line[-1].transAxes, "va": alignment if second else "center"}
        line[-1].text(
            1.06, height if second else 0.5, text, color=color if second else "black", fontsize=font_size, **layout
        )


def _texts(comparison: Comparison) -> tuple[str, str]:
    """Scale and correction of the recorded decision, and of the recomputed one if its text differs."""
    recorded = comparison.recorded
    first = _text(recorded.divisor, recorded.unit, recorded.action)
    if comparison.skipped:
        return f"{first}\n\nnot recomputed:\nimages missing\nor unreadable", ""
    second = _text(comparison.flow.divisor, comparison.flow.unit, comparison.action)
    return first, "" if second == first else second


def _text(divisor: float, unit: str, action: NDArray[np.float64]) -> str:
    dx, dy, turn = action * (1e3, 1e3, 180 / np.pi)
    return f"longest arrow {divisor:.3g} {unit}\ncorrection\nx {dx:+.2f} mm\ny {dy:+.2f} mm\nyaw {turn:+.1f}°"


def _flow_differs(comparison: Comparison) -> bool:
    """Whether the recomputed arrows differ visibly from the recorded ones and can be drawn in the same axes."""
    recorded, recomputed = comparison.recorded.flow, comparison.flow.image
    return recorded.shape == recomputed.shape and difference(recorded, recomputed) > _VISIBLE
