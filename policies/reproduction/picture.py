"""The picture of a reproduction: learning curves with their bands over the seeds, and the final rows."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from gelflow.figures import SERIES, save

_SMOOTHED = 5  # rows of a training curve in a running median


def draw(record: Mapping[str, Any], path: Path) -> None:
    """Draws the record of `record.reproduce`."""
    from matplotlib.figure import Figure  # deferred: slow to import

    variants = record["variants"]
    figure = Figure(figsize=(11, max(4.5, 1.6 + 0.62 * len(variants))), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    trained = [variant for variant in variants if variant["trained_as"] is None]
    _draw_curves(left, trained, record["curve"])
    draw_rows = _draw_success if record["curve"] == "success" else _draw_reward
    draw_rows(right, variants)
    right.set_yticks(range(len(variants)), [variant["name"] for variant in variants])
    right.invert_yaxis()
    right.grid(axis="x", alpha=0.3)
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, fontsize="small")
    seeds = len(record["seeds"])
    figure.suptitle(f"{record['task']}: {_headline(variants[0], record['curve'])} ({seeds} seed{'s' * (seeds > 1)})")
    save(figure, path, dpi=110)


def _headline(variant: Mapping[str, Any], measure: str) -> str:
    ours, paper = variant["ours"], variant["paper"]
    if measure != "success":
        return f"{variant['name']} reaches a return of {ours['reward']:.0f}"
    text = f"{variant['name']} {100 * ours['success']:.1f} % success"
    return text if paper is None else f"{text}, in the paper {100 * paper['success']:.1f} %"


def _draw_curves(axes: Any, variants: Sequence[Mapping[str, Any]], measure: str) -> None:
    factor = 100 if measure == "success" else 1
    for i, variant in enumerate(variants):
        color, marker = SERIES[i % len(SERIES)]
        for name, style in (("validation", "-"), ("training", ":")):
            if (values := variant["curves"][name]) is None:
                continue
            x, median, low, high = (np.array(values[key]) for key in ("x", "median", "low", "high"))
            if name == "training":
                # The success of a row is that of few episodes.
                median, low, high = (median_filter(values, _SMOOTHED, mode="nearest") for values in (median, low, high))
            every, marks = max(1, len(x) // 10), marker if name == "validation" else None
            label = variant["name"] if name == "validation" else None
            axes.plot(
                x / 1000, factor * median, style, color=color, marker=marks, markersize=4, markevery=every, label=label
            )
            axes.fill_between(x / 1000, factor * low, factor * high, color=color, alpha=0.18, linewidth=0)
    axes.set(xlabel="environment steps [thousands]", ylabel="success [%]" if factor == 100 else "return [-]")
    if factor == 100:
        axes.set_ylim(0, 103)
    title = "Validation (solid) and training with exploration (dotted, smoothed):\nmedian and range over the seeds"
    axes.set_title(title, fontsize="medium")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)


def _draw_success(axes: Any, variants: Sequence[Mapping[str, Any]]) -> None:
    """Success of each variant with its deviation over the seeds, the seeds, and the figures to compare with."""
    for row, variant in enumerate(variants):
        ours = variant["ours"]
        at = 100 * ours["success"]
        deviation = 100 * (ours["success_deviation"] or 0)
        color = SERIES[0][0]
        seeds = [100 * value for value in ours["success_of_seeds"]]
        axes.scatter(seeds, np.full(len(seeds), row), marker="|", s=120, color=color, label=_once("ours, a seed", row))
        label = _once("ours, mean and deviation", row)
        axes.errorbar(at, row, xerr=deviation or None, fmt="o", color=color, capsize=4, label=label)
        if variant["paper"] is not None:
            spread = 100 * (variant["paper"]["spread"] or 0)
            known = axes.get_legend_handles_labels()[1]
            axes.errorbar(
                100 * variant["paper"]["success"],
                row + 0.22,
                xerr=spread or None,
                fmt="D",
                color=SERIES[1][0],
                capsize=3,
                label="paper" if "paper" not in known else None,
            )
        for offset, (name, marker) in zip((-0.22, 0.0), (("oracle", "^"), ("random", "x")), strict=True):
            if name in variant:
                value = 100 * variant[name]["success"]
                axes.plot(value, row + offset, marker, color="0.4", linestyle="none", label=_once(name, row))
    axes.set(xlabel="success on evaluation episodes [%]", xlim=(-2, 104))
    axes.set_title("Evaluation on other episodes", fontsize="medium")


def _draw_reward(axes: Any, variants: Sequence[Mapping[str, Any]]) -> None:
    """Mean return of each variant with the deviation over its seeds; random actions are named in the title."""
    for row, variant in enumerate(variants):
        ours = variant["ours"]
        axes.errorbar(
            ours["reward"],
            row,
            xerr=ours["reward_deviation"],
            fmt="o",
            color=SERIES[0][0],
            capsize=4,
            label=_once("ours, deviation over the seeds", row),
        )
    axes.set(xlabel="return on evaluation episodes [-]")
    axes.set_title(f"Evaluation on other episodes (random: {variants[0]['random']['reward']:.0f})", fontsize="medium")


def _once(label: str, row: int) -> str | None:
    """A label in the legend for the first row only."""
    return label if row == 0 else None
