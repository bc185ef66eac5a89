"""A picture of the policy's observations and corrections."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gelflow.figures import draw_flow_map, save
from gelflow.observation import Grid
from gelflow.session.records import SENSORS, Decision

MAX_DECISIONS = 40  # in one picture


def draw_decisions(decisions: Sequence[Decision], grid: Grid, path: str | Path) -> None:
    """Draw one row per decision: the flow map of each pad and frame as arrows, and the correction as text.

    The view is from outside onto the pad, fingertip down, so x points down and y to the right. At most the first 40
    decisions are drawn. Raises UsageError when the picture cannot be written.
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    shown = list(decisions[:MAX_DECISIONS])
    columns = shown[0].flow.shape[0] // 2
    sensors = len(shown[0].tracked)
    figure = Figure(figsize=(2.1 * columns + 1.6, 2.6 * len(shown)), layout="constrained")
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for line, decision in zip(axes, shown, strict=True):
        flow = decision.flow.reshape(columns, 2, -1)
        dx, dy, turn = decision.action * (1e3, 1e3, 180 / np.pi)
        for column, axis in enumerate(line):
            draw_flow_map(axis, grid, flow[column])
            axis.set_title(f"{SENSORS[column % sensors]} pad", fontsize=8)
        line[0].set_ylabel(f"insertion {decision.insertion}, attempt {decision.attempt}", fontsize=8)
        scale = f"longest arrow\n{decision.divisor:.3g} {decision.unit}"
        text = f"{scale}\n\ncorrection\nx {dx:+.2f} mm\ny {dy:+.2f} mm\nyaw {turn:+.1f}°"
        line[-1].text(1.06, 0.5, text, transform=line[-1].transAxes, fontsize=8, va="center")
    figure.supxlabel("flow maps at the frames of a decision, longest arrow = 1; fingertip down", fontsize=8)
    save(figure, path, make_folder=False)
