"""A picture of recorded and simulated flow maps."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import VERMILION, add_arrows, draw_flow_map
from gelflow.observation import Grid
from gelflow.policies.calibration.model.pad_model import SIDES

Array = NDArray[np.float64]

MAX_SHOWN = 12  # attempts in one picture


def draw_flow_maps(
    recorded: Array,
    simulated: Sequence[tuple[str, Array]],
    names: Sequence[str],
    grid: Grid,
    unit: str,
    *,
    used: NDArray[np.bool_],
    note: str,
) -> Any:
    """A matplotlib figure with one row per attempt: recorded flow maps in blue, simulated ones in red and narrower.

    Parameters
    ----------
    recorded: flow maps (n, markers, 2) in `unit`; at most the first `MAX_SHOWN` are drawn
    simulated: titles and flow maps (n, markers, 2), two columns for each
    names: of the attempts
    used: markers that are drawn (markers,)
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    count = min(len(recorded), MAX_SHOWN)
    figure = Figure(figsize=(2.2 * len(simulated) * len(SIDES) + 0.4, 2.7 * count + 0.5), layout="constrained")
    axes = figure.subplots(count, len(simulated) * len(SIDES), squeeze=False)
    for i, line in enumerate(axes):
        longest = max(float(np.linalg.norm(recorded[i][used], axis=-1).max()), 1e-30)
        blue = np.where(used[:, None], recorded[i], np.nan).reshape(len(SIDES), -1, 2) / longest
        for k, axis in enumerate(line):
            title, maps = simulated[k // len(SIDES)]
            side = k % len(SIDES)
            draw_flow_map(axis, grid, blue[side].T)
            red = np.where(used[:, None], maps[i], np.nan).reshape(len(SIDES), -1, 2)[side] / longest
            add_arrows(axis, grid, red.T, color=VERMILION, width=0.004)
            axis.set_title(f"{SIDES[side]} pad" + (f", {title}" if title else ""), fontsize=8)
        line[0].set_ylabel(f"{names[i]}\nlongest arrow {longest:.3g} {unit}", fontsize=8)
    shown = f"first {count} of {len(recorded)} attempts; " if count < len(recorded) else ""
    figure.supxlabel(f"{shown}{note}blue: recorded, red: simulated; fingertip down", fontsize=8)
    return figure
