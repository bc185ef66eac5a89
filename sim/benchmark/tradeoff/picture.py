"""The picture of `gelflow tradeoff`: four errors over the time that they cost, with the fronts and the presets."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff

_PANELS = {
    "position": "largest error of a position [m]",
    "markers": "error of the marker field, relative",
    "flow": "error of the flow map's vectors",
    "gradient": "error of the gradient, relative",
}
_GROUPS = {  # group: what the legend says, colour, marker
    "default": ("the scene's own numbers", "black", "D"),
    "step": ("step and integrator", "tab:blue", "o"),
    "tolerance": ("Newton's tolerance", "tab:purple", "v"),
    "combined": ("the same, tolerance 1e-3", "tab:cyan", "s"),
    "single": ("the same in single precision", "tab:gray", "x"),
    "preset": ("preset", "tab:red", "*"),
    "reads": ("read less often", "tab:orange", "<"),
    "markers": ("other markers", "tab:green", "^"),
    "contacts": ("other contact points", "tab:brown", "P"),
}
_LEAST = 1e-7  # what is drawn for an error of 0


def draw(found: "Tradeoff", path: Path) -> None:
    """Draw the picture. Raises UsageError when it can't be written."""
    from matplotlib.figure import Figure  # here: slow to import

    figure = Figure(figsize=(11, 8.5), layout="constrained")
    figure.suptitle(f"{found.scene}: error over computing time per simulated second")
    for axis, (name, label) in zip(figure.subplots(2, 2).flat, _PANELS.items(), strict=True):
        _panel(axis, found, name)
        axis.set(xscale="log", yscale="log", xlabel="computing per simulated second [s]", ylabel=label)
        axis.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=90)
    except OSError as error:
        raise UsageError(f"cannot write the picture {path}: {error.strerror}") from error


def _panel(axis: Any, found: "Tradeoff", name: str) -> None:
    points = [
        (measurement.seconds, max(getattr(measurement.errors, name), _LEAST)) for measurement in found.measurements
    ]
    groups = [measurement.setting.group for measurement in found.measurements]
    for group, (label, color, marker) in _GROUPS.items():
        chosen = [point for point, of in zip(points, groups, strict=True) if of == group]
        if chosen:
            x, y = zip(*chosen, strict=True)
            axis.plot(x, y, marker, color=color, ms=5, alpha=0.75, label=label, ls="")
    same_world = [p for p, of in zip(points, groups, strict=True) if of not in ("single", "markers", "contacts")]
    axis.plot(*zip(*front(same_world), strict=True), "k-", lw=0.8, alpha=0.6, label="front")
    axis.margins(0.1)
    named = [
        (n, point) for measurement, point in zip(found.measurements, points, strict=True) for n in measurement.presets
    ]
    for at, (preset, point) in enumerate(named):
        axis.plot(*point, "o", mfc="none", mec="tab:red", ms=11, label="preset" if at == 0 else None)
        axis.annotate(preset, point, xytext=(0, 8), textcoords="offset points", ha="center", color="tab:red")


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other one is left of and below, from left to right."""
    found: list[tuple[float, float]] = []
    for point in sorted(points):
        if not found or point[1] < found[-1][1]:
            found.append(point)
    return found
