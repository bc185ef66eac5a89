"""Picture of the accuracy of distance grids: errors of distance, normal and contact force over the resolution."""

from collections.abc import Sequence
from pathlib import Path

from gelflow.figures import SERIES, save, set_log_axis
from gelflow.sim.validation.studies.mesh_distance import RESOLUTIONS, Result

_PANELS = (  # title, label, field of the result, factor to the unit of the label
    ("distance", "rms error of the distance [µm]", "distance_rms", 1e6),
    ("normal", "rms error of the normal [-]", "normal_rms", 1.0),
    ("contact force", "median error of the contact force [%]", "force_median", 100),
)
_NAMES = {"rounded": "rounded box"}  # solids whose label differs from the name
_LIMIT = 0.01  # relative force error of the title


def draw(results: Sequence[Result], file: Path) -> None:
    """Draw errors over resolution. Writes `file`."""
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(12, 4.6), layout="constrained")
    figure.suptitle(_title(results))
    solids = dict.fromkeys(r.solid for r in results)
    for axes, (title, label, field, factor) in zip(figure.subplots(1, 3), _PANELS, strict=True):
        for solid, (color, marker) in zip(solids, SERIES, strict=False):
            chosen = [r for r in results if r.solid == solid]
            sizes, errors = [r.resolution for r in chosen], [factor * getattr(r, field) for r in chosen]
            axes.loglog(sizes, errors, marker + "-", color=color, ms=6, label=_NAMES.get(solid, solid))
        set_log_axis(axes, "y", subs=(1,))
        axes.set_xticks(RESOLUTIONS, [str(n) for n in RESOLUTIONS])
        axes.xaxis.minorticks_off()
        axes.set(title=title, xlabel="number of cells along the longest side", ylabel=label)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    save(figure, file, dpi=100)


def _title(results: Sequence[Result]) -> str:
    """The resolution from which the median force error of all solids stays below the limit."""
    above = [r.resolution for r in results if r.force_median >= _LIMIT]
    below = [n for n in sorted({r.resolution for r in results}) if n > max(above, default=0)]
    title = "Distance grids of meshes: errors over the resolution"
    return f"{title}; median force error below {100 * _LIMIT:g} % from {below[0]} cells" if below else title
