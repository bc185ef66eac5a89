"""The progress of a training run as a picture."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, VERMILION, save
from gelflow.policies.training.progress_log import read_table

Array = NDArray[np.float64]


def read_curve(table: Path) -> dict[str, Array]:
    """The columns of a progress table, with nan where a row has no value."""
    rows = read_table(table)
    names = rows[0] if rows else {}
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


def draw(path: Path, table: Path, *, title: str) -> None:
    """Draws success rate and reward over the environment steps of the run with the given progress table."""
    save(figure_of(table, title=title), path, dpi=120)


def figure_of(table: Path, *, title: str) -> Any:
    """The figure of `draw`."""
    from matplotlib.figure import Figure  # imported on use: slow

    curve = read_curve(table)
    steps = curve["steps"] / 1000
    figure = Figure(figsize=(8, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    if "success" in curve:
        rated = np.isfinite(curve["success"])  # the line goes on over rows without a rate
        _plot_training(top, steps[rated], 100 * curve["success"][rated], "training, with exploration")
    done = np.isfinite(curve["evaluated_success"])
    x, success = steps[done], 100 * curve["evaluated_success"][done]
    top.plot(x, success, "o-", color=BLUE, label="evaluation, 95 % confidence interval")
    low, high = 100 * curve["success_low"][done], 100 * curve["success_high"][done]
    if len(x) == 1:
        top.vlines(x, low, high, color=BLUE)
    top.fill_between(x, low, high, color=BLUE, alpha=0.2, linewidth=0)
    result = f": success {success[-1]:.1f} % after {x[-1]:.1f} thousand steps" if done.any() else ""
    top.set(ylabel="success [%]", ylim=(0, 102), title=title + result)
    top.legend(loc="lower right")
    if "reward" in curve:
        _plot_training(bottom, steps, curve["reward"], "training, mean of a step")
    bottom.plot(x, curve["evaluated_reward"][done], "o-", color=VERMILION, label="evaluation, mean of an episode")
    bottom.set(xlabel="environment steps [thousands]", ylabel="reward [-]")
    bottom.legend(loc="lower right")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    return figure


def _plot_training(axes: Any, x: Array, y: Array, label: str) -> None:
    """A dashed line, or a point where there is only one: a line would be invisible."""
    axes.plot(x, y, "--" if len(x) > 1 else ".", color="0.45", label=label)
