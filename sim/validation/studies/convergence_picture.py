"""Picture of the convergence study: errors over the step on whole scenes, and errors over cost of some schemes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gelflow.figures import BLUE, SERIES, VERMILION, save
from gelflow.sim.validation.studies.convergence import Convergence
from gelflow.sim.validation.studies.schemes import Scheme

_LAWS = {"viscous": (BLUE, "o"), "elastic": (VERMILION, "^")}  # colour, marker
_LINES = {"bdf1": "--", "bdf2": "-"}
_QUANTITIES = {"q": "q", "tactile": "marker forces"}


def draw(
    scenes: Sequence[Convergence], ball: Sequence[Scheme], schemes: Mapping[str, Sequence[Scheme]], path: Path
) -> None:
    """Draw convergence of the scenes, and errors over cost of the schemes on the ball and on scenes. Writes `path`."""
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(12.5, 9), layout="constrained")
    figure.suptitle(_title(scenes))
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1))  # an array: two rows
    top, bottom = halves
    names = list(dict.fromkeys(r.scene for r in scenes))
    for axes, name in zip(top.subplots(1, 3, sharey=True), names, strict=True):
        _draw_scene(axes, name, [r for r in scenes if r.scene == name])
    top.axes[0].set_ylabel("mean relative error [-]")
    handles, labels = top.axes[0].get_legend_handles_labels()
    top.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9)
    panels = {"ball on a plane, viscous": ball, **schemes}
    styles = {scheme.name: style for scheme, style in zip(ball, SERIES, strict=False)}
    for axes, (title, curves) in zip(bottom.subplots(1, 3, sharey=True), panels.items(), strict=False):
        for scheme in curves:
            color, marker = styles[scheme.name]
            axes.loglog(scheme.solves, scheme.errors, marker + "-", color=color, ms=4, label=scheme.name)
        axes.set(title=title, xlabel="cost: number of Newton iterations")
        axes.grid(alpha=0.3)
    bottom.axes[0].set_ylabel("relative error of q at the end [-]")
    handles, labels = bottom.axes[0].get_legend_handles_labels()
    bottom.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=9)
    save(figure, path, dpi=100)


def _title(scenes: Sequence[Convergence]) -> str:
    """Ranges of the orders of convergence of q over the finest steps."""
    parts = []
    for integrator in _LINES:
        orders = [r.slope("q") for r in scenes if r.integrator == integrator]
        parts.append(f"{integrator.upper()} {min(orders):.2f} to {max(orders):.2f}")
    return f"Order of convergence of q over the finest steps: {', '.join(parts)}"


def _draw_scene(axes: Any, name: str, curves: Sequence[Convergence]) -> None:
    """Errors of one scene over the step; filled markers for q and open ones for the marker forces."""
    for r in curves:
        for quantity, words in _QUANTITIES.items():
            color, marker = _LAWS[r.law]
            fill = color if quantity == "q" else "white"
            label = f"{r.integrator.upper()}, {r.law}, {words}"
            line = marker + _LINES[r.integrator]
            axes.loglog(r.steps, r.errors(quantity), line, color=color, mfc=fill, ms=4.5, label=label)
    steps = max((r.steps for r in curves), key=len)
    axes.loglog(steps, [s / steps[0] for s in steps], "k:", lw=1, label="slope 1")
    halved = [s for s in steps if s > 1e-5]
    axes.loglog(halved, [(s / steps[0]) ** 2 for s in halved], "k-.", lw=1, label="slope 2")
    axes.set(title=name, xlabel="time step [s]")
    axes.grid(alpha=0.3)
