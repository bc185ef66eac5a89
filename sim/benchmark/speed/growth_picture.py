"""Picture of the scaling measurement (`gelflow bench growth --picture FILE`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gelflow.sim.benchmark.speed.growth import UPPER, SweepResult

PANELS = (("bodies", "chain"), ("contacts",), ("markers",), ("environments",))


def draw(found: Sequence[SweepResult], file: Path) -> None:
    """Draw steps per second over size, with fitted power laws; one panel per quantity. Writes `file`."""
    by_name = {result.sweep.name: result for result in found}
    figure = Figure(figsize=(10, 7.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, names in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
        for k, name in enumerate(names):
            result = by_name[name]
            color = f"C{k}"
            axes.loglog(result.sizes, result.rates, "o", color=color)
            x = np.array(result.sizes[-max(2, round(UPPER * len(result.sizes))) :], float)
            y = np.array(result.rates[-len(x) :])
            level = np.exp(np.mean(np.log(y) + result.exponent * np.log(x)))
            axes.loglog(x, level * x**-result.exponent, color=color, label=f"{name}: time ~ n^{result.exponent:.2f}")
        axes.set_xlabel(by_name[names[0]].sweep.unit if len(names) == 1 else "bodies")
        axes.set_ylabel("steps per second" + (" of the batch" if names == ("environments",) else ""))
        axes.set_title(by_name[names[0]].sweep.threads, fontsize="medium")
        axes.grid(True, which="major", alpha=0.3)
        decades = np.log10(np.concatenate([by_name[name].rates for name in names]))
        axes.set_ylim(10 ** np.floor(decades.min()), 10 ** np.ceil(decades.max()))
        axes.legend(loc="lower left")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90)
