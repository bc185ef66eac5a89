"""Picture of a gel calibration: measured and fitted forces."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import BLUE, VERMILION, save
from gelflow.perception.force.gel_fit import ForceSamples, GelFit

Array = NDArray[np.float64]


def draw_gel_fit(samples: ForceSamples, fit: GelFit, scale: float, path: Path) -> None:
    """Fitted over measured forces, and both over time; `scale` is new / former Young's modulus.

    Raises UsageError when the picture cannot be written.
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    largest = 0.0
    for name, colour, estimated, measured in (
        ("normal", BLUE, samples.normal, samples.measured_normal),
        ("shear", VERMILION, samples.shear, samples.measured_shear),
    ):
        if not np.isfinite(measured).any():
            continue
        fitted = scale * estimated
        largest = max(largest, float(np.nanmax(measured)), float(fitted[np.isfinite(measured)].max()))
        left.plot(measured, fitted, ".", color=colour, markersize=4, label=name)
        right.plot(*_with_gaps(samples, measured), "-", color="black", linewidth=0.8)
        right.plot(samples.stamp, fitted, ".", color=colour, markersize=4, label=f"{name}, from markers")
    left.plot([0, largest], [0, largest], color="black", linewidth=0.8, label="measured")
    left.set(xlabel="measured force [N]", ylabel="force from markers, fitted gel [N]", title="all images with contact")
    right.set(xlabel="time of the image [s]", ylabel="force [N]", title="over time; black: measured")
    modulus, deviation = fit.gel.youngs_modulus, fit.gel.youngs_modulus_deviation
    figure.suptitle(f"Young's modulus {modulus:.4g} Pa ± {100 * deviation:.0f} % (standard deviation)", fontsize=11)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    save(figure, path, dpi=110)


def _with_gaps(samples: ForceSamples, force: Array) -> tuple[Array, Array]:
    """Times and forces with a NaN between two contacts, so that no line joins them."""
    ends = np.flatnonzero(np.diff(samples.contact)) + 1
    return np.insert(samples.stamp, ends, samples.stamp[ends]), np.insert(force, ends, np.nan)
