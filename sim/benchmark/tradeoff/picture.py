"""Picture of the trade-off: four errors over computing time, with Pareto fronts and presets."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gelflow.figures import BLUE, GREEN, ORANGE, PURPLE, VERMILION, save, set_log_axis

if TYPE_CHECKING:
    from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff

_PANELS = {  # error → label, factor to its unit
    "position": ("largest position error [mm]", 1e3),
    "markers": ("relative error of the marker forces [%]", 100),
    "flow": ("mean flow vector error [% of the longest]", 100),
    "gradient": ("relative error of the gradient [%]", 100),
}
_GROUPS = {  # group → label, colour, marker
    "default": ("scene default", "black", "D"),
    "step": ("step and integrator", BLUE, "o"),
    "tolerance": ("Newton tolerance", PURPLE, "v"),
    "combined": ("step and integrator, tolerance 1e-3", "#56B4E9", "s"),
    "single": ("single precision, tolerance 1e-3", "#777777", "x"),
    "preset": (None, VERMILION, "*"),
    "reads": ("lower reading rate", ORANGE, "<"),
    "markers": ("other markers", GREEN, "^"),
    "contacts": ("other contact points", "#8C6D31", "P"),
}
_SEPARATE = ("single", "markers", "contacts")  # groups whose results differ in kind: not part of the front
_LEAST = 1e-7  # drawn for an error of 0


def draw(tradeoff: "Tradeoff", path: Path) -> None:
    """Draw the picture to a file. Raises UsageError when it cannot be written."""
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(11, 8.5), layout="constrained")
    figure.suptitle(_title(tradeoff), fontsize=11)
    for axes, (name, (label, factor)) in zip(figure.subplots(2, 2).flat, _PANELS.items(), strict=True):
        axes.set(xlabel="computing time per simulated second [ms]", ylabel=label)
        set_log_axis(axes, "x")
        set_log_axis(axes, "y", subs=(1, 3))
        axes.grid(alpha=0.3)
        _draw_panel(axes, tradeoff, name, factor)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9)
    save(figure, path, dpi=90)


def _title(tradeoff: "Tradeoff") -> str:
    """Computing time and error of the marker forces of each preset."""
    title = f"{tradeoff.scene}: error against computing time per simulated second"
    presets = [(preset, m) for m in tradeoff.measurements for preset in m.presets]
    presets.sort(key=lambda pair: -pair[1].errors.markers)
    results = [f"{preset} {100 * m.errors.markers:.2g} % in {1e3 * m.seconds:.2g} ms" for preset, m in presets]
    return f"{title}\nError of the marker forces with the presets: {'; '.join(results)}" if results else title


def _draw_panel(axes: Any, tradeoff: "Tradeoff", name: str, factor: float) -> None:
    from matplotlib.patheffects import withStroke  # deferred: slow to import

    points = [(1e3 * m.seconds, factor * max(getattr(m.errors, name), _LEAST)) for m in tradeoff.measurements]
    groups = [m.setting.group for m in tradeoff.measurements]
    for group, (label, color, marker) in _GROUPS.items():
        chosen = [point for point, of in zip(points, groups, strict=True) if of == group]
        if chosen:
            axes.plot(*zip(*chosen, strict=True), marker, color=color, ms=5, alpha=0.75, label=label, ls="")
    comparable = [point for point, of in zip(points, groups, strict=True) if of not in _SEPARATE]
    axes.plot(*zip(*front(comparable), strict=True), "k-", lw=0.8, alpha=0.6, label="Pareto front")
    axes.margins(0.14, 0.1)
    named = [(p, point) for m, point in zip(tradeoff.measurements, points, strict=True) for p in m.presets]
    for at, (preset, point) in enumerate(named):
        axes.plot(*point, "o", mfc="none", mec=VERMILION, mew=2, ms=12, label="preset" if at == 0 else None)
        text = axes.annotate(
            preset, point, xytext=(-6, -6), textcoords="offset points", ha="right", va="top", color="#A04000",
            weight="bold",
        )  # fmt: skip
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Pareto front of points (time, error): those without another point of less time and error, by time."""
    nondominated: list[tuple[float, float]] = []
    for point in sorted(points):
        if not nondominated or point[1] < nondominated[-1][1]:
            nondominated.append(point)
    return nondominated
