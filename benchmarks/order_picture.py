"""The picture of `order.py`: errors over the step on whole scenes, and errors over cost for some schemes."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {"viscous": "tab:blue", "elastic": "tab:orange"}


def draw(found: list[Any], ball: list[Any], scenes: dict[str, list[Any]], path: Path) -> None:
    """`found`: results of order.py by scene, law and integrator; `ball`, `scenes`: schemes by cost."""
    names = list(dict.fromkeys(r.scene for r in found))
    figure, axes = plt.subplots(2, 3, figsize=(12, 7.5), layout="constrained")
    for axis, name in zip(axes[0], names, strict=True):
        for r in (r for r in found if r.scene == name):
            style = {"bdf1": "o--", "bdf2": "s-"}[r.integrator]
            for quantity, alpha in (("q", 1.0), ("tactile", 0.35)):
                label = f"{r.integrator.upper()}, {r.law}, {quantity}"
                axis.loglog(r.steps, r.errors(quantity), style, color=COLORS[r.law], alpha=alpha, ms=3, label=label)
        steps = max((r.steps for r in found if r.scene == name), key=len)
        axis.loglog(steps, [s / steps[0] for s in steps], "k:", lw=0.8, label="slope 1")
        axis.set(title=name, xlabel="time step [s]", ylabel="mean relative error")
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=6)
    shown = {"ball on a plane": ball} | scenes
    for axis, (title, schemes) in zip(axes[1], shown.items(), strict=False):
        for scheme in schemes:
            axis.loglog(scheme.solves, scheme.errors, "o-", ms=3, label=scheme.name)
        axis.set(title=title, xlabel="Newton iterations", ylabel="relative error of the end")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
