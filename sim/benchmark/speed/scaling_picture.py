"""Picture of the scaling measurement (`gelflow bench scaling --out FOLDER`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.figures import SERIES, save
from gelflow.sim.benchmark.speed.scaling import fitted_sizes

# Title and label of the horizontal axis, and the sweeps with their names in the legend.
_PANELS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("Bodies", "number of bodies", {"bodies": "independent", "chain": "in a chain"}),
    ("Contact points", "number of contact points", {"contacts": ""}),
    ("Markers", "number of markers", {"markers": ""}),
    ("Environments", "number of environments", {"environments": ""}),
)


def draw(records: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Draw step rates over size, with fitted power laws; one panel per quantity. Writes `file`.

    `records` are the results of the report of `measure_scaling`.
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    by_name = {record["of"]: record for record in records}
    figure = Figure(figsize=(10, 7.4), layout="constrained")
    for axes, (title, label, sweeps) in zip(figure.subplots(2, 2).flat, _PANELS, strict=True):
        exponents = []
        for name, style in zip(sweeps, SERIES, strict=False):
            _draw_sweep(axes, by_name[name], sweeps[name], *style)
            exponents.append(f"n$^{{{by_name[name]['exponent']:.2f}}}$ {sweeps[name]}".rstrip())
        threads = by_name[next(iter(sweeps))]["threads"]
        unit = "steps of the batch" if "environments" in sweeps else "steps"
        axes.set_title(f"{title}: step time ∝ {', '.join(exponents)}", fontsize=11)
        axes.set(xlabel=f"{label} n", ylabel=f"{unit} per second [1/s], {threads}")
        axes.grid(True, which="major", alpha=0.3)
        rates = [size["per_second"] for name in sweeps for size in by_name[name]["sizes"]]
        axes.set_ylim(10 ** np.floor(np.log10(min(rates))), 10 ** np.ceil(np.log10(max(rates))))
        if len(sweeps) > 1:
            axes.legend(loc="lower left")
    save(figure, file, dpi=90)


def _draw_sweep(axes: Any, record: Mapping[str, Any], label: str, color: str, marker: str) -> None:
    """Measured rates, and the power law over the sizes to which it was fitted."""
    sizes = np.array([size["size"] for size in record["sizes"]], float)
    rates = np.array([size["per_second"] for size in record["sizes"]])
    axes.loglog(sizes, rates, marker, color=color, label=label)
    n, fitted = sizes[fitted_sizes(len(sizes))], rates[fitted_sizes(len(sizes))]
    level = np.exp(np.mean(np.log(fitted) + record["exponent"] * np.log(n)))
    axes.loglog(n, level * n ** -record["exponent"], color=color)
