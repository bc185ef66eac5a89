"""Picture of the trade-off: four errors over computing time, with Pareto fronts and presets."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff

_PANELS = {
    "position": "largest position error [m]",
    "markers": "relative error of the marker forces",
    "flow": "mean error of flow vectors (longest = 1)",
    "gradient": "relative error of the gradient",
}
_GROUPS = {  # group → label, colour (Okabe and Ito), marker
    "default": ("scene default", "black", "D"),
    "step": ("step and integrator", "#0072B2", "o"),
    "tolerance": ("Newton's tolerance", "#CC79A7", "v"),
    "combined": ("step and integrator, tolerance 1e-3", "#56B4E9", "s"),
    "single": ("single precision, tolerance 1e-3", "#777777", "x"),
    "preset": ("preset", "#D55E00", "*"),
    "reads": ("lower reading rate", "#E69F00", "<"),
    "markers": ("other markers", "#009E73", "^"),
    "contacts": ("other contact points", "#8C6D31", "P"),
}
_LEAST = 1e-7  # drawn for an error of 0


def draw(found: "Tradeoff", path: Path) -> None:
    """Draw the picture to a file. Raises UsageError when it cannot be written."""
    from matplotlib.figure import Figure  # deferred: slow to import
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure = Figure(figsize=(11, 8.5), layout="constrained")
    figure.suptitle(f"{found.scene}: error over computing time")
    for axis, (name, label) in zip(figure.subplots(2, 2).flat, _PANELS.items(), strict=True):
        _panel(axis, found, name)
        axis.set(xscale="log", yscale="log", xlabel="computing time per simulated second [ms]", ylabel=label)
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:.0e}"))
        for side in (axis.xaxis, axis.yaxis):
            side.set_minor_formatter(NullFormatter())
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
        (1e3 * measurement.seconds, max(getattr(measurement.errors, name), _LEAST))
        for measurement in found.measurements
    ]
    groups = [measurement.setting.group for measurement in found.measurements]
    for group, (label, color, marker) in _GROUPS.items():
        chosen = [point for point, of in zip(points, groups, strict=True) if of == group]
        if chosen:
            x, y = zip(*chosen, strict=True)
            axis.plot(x, y, marker, color=color, ms=5, alpha=0.75, label=label, ls="")
    comparable = [p for p, of in zip(points, groups, strict=True) if of not in ("single", "markers", "contacts")]
    axis.plot(*zip(*front(comparable), strict=True), "k-", lw=0.8, alpha=0.6, label="front")
    axis.margins(0.1)
    named = [
        (n, point) for measurement, point in zip(found.measurements, points, strict=True) for n in measurement.presets
    ]
    for at, (preset, point) in enumerate(named):
        axis.plot(*point, "o", mfc="none", mec="#D55E00", ms=11, label="preset" if at == 0 else None)
        axis.annotate(preset, point, xytext=(0, 8), textcoords="offset points", ha="center", color="#D55E00")


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Pareto front of points (time, error): those without another point of less time and error, by time."""
    found: list[tuple[float, float]] = []
    for point in sorted(points):
        if not found or point[1] < found[-1][1]:
            found.append(point)
    return found
