"""The curves of `gelflow bench tracking --picture FILE`: errors as images get worse, time as they grow. No command."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.measurement.timing import BenchmarkOptions, Report
from gelflow.perception.benchmark.baselines import FOLLOWERS
from gelflow.perception.benchmark.metrics import Figures
from gelflow.perception.benchmark.speed import measure_speed
from gelflow.perception.benchmark.tracking import LARGE, Case
from gelflow.perception.synthetic.appearance import SIZES, make_appearance
from gelflow.perception.synthetic.sequences import FIELDS, GelSequence

_SEQUENCE: dict[str, Any] = {"frames": 20, "period": 32}  # from rest to the peak
_TIMED = 8  # images of a timed run


@dataclass(frozen=True)
class Curve:
    """What of the typical class changes, and through which values."""

    name: str
    label: str
    values: tuple[float, ...]
    at: Callable[
        [float], tuple[dict[str, Any], dict[str, Any]]
    ]  # value → changes of the appearance and of the sequence


ERRORS = (
    Curve("noise", "noise [grey levels]", (0.5, 1, 1.5, 2, 3, 4, 6, 8), lambda value: ({"noise": value}, {})),
    Curve("motion", "largest motion [spacings]", (0.1, 0.2, 0.4, 0.6, 0.8, 1.0), lambda value: ({}, {"peak": value})),
    Curve("missing", "missing dots [share]", (0, 0.02, 0.05, 0.1, 0.15, 0.2), lambda value: ({"missing": value}, {})),
    Curve("occlusion", "occluders that pass", (0, 1, 2, 3, 4), lambda value: ({"occluders": int(value)}, {})),
)
WIDTHS = (240, 320, 480, 640, 960, 1280)  # of images of 4:3 [px]


def measure_curves(options: BenchmarkOptions) -> Report:
    """Errors and times along every curve; with `options.quick` at their ends alone."""
    rows: list[tuple[str, ...]] = []
    results: list[dict[str, Any]] = []
    fields, sequence = (FIELDS[:1], {"frames": 6, "period": 4}) if options.quick else (FIELDS[::2], _SEQUENCE)
    for curve in ERRORS:
        values = curve.values[:: len(curve.values) - 1] if options.quick else curve.values
        options.progress.begin(f"tracking: {curve.name}", len(values))
        for value in values:
            changed, motion = curve.at(value)
            courses = Case(curve.name, "typical", changed).follow(FOLLOWERS, fields, **(sequence | motion))
            figures = {name: Figures.of(found) for name, found in courses.items()}
            medians = ("gave up" if one.failed else f"{one.median:.3f}" for one in figures.values())
            rows.append((f"{curve.name} {value:g}", *medians))
            results.append({"curve": curve.name, "at": value} | {name: one.plain() for name, one in figures.items()})
            options.progress.advance()
    timed = [("markers", markers, markers, LARGE) for markers in SIZES]
    timed += [("width", width, 130, (width, width * 3 // 4)) for width in WIDTHS]
    for name, value, markers, size in [timed[0], timed[len(SIZES)]] if options.quick else timed:
        appearance = make_appearance("typical", markers=markers, width=size[0], height=size[1])
        frames = list(GelSequence(appearance, frames=_TIMED))
        images, first, grid = [frame.image for frame in frames], frames[0], appearance.grid
        timings = measure_speed(
            FOLLOWERS, images, first.position, first.visible, grid.rows, grid.cols, repeats=options.repeats
        )
        rows.append((f"ms: {name} {value}", *(f"{one.frame:.2f}" for one in timings.values())))
        results.append({"curve": name, "at": value} | {who: asdict(one) for who, one in timings.items()})
    return Report(
        name="tracking_curves",
        title="Tracking: the curves",
        columns=("typical, but", *FOLLOWERS),
        rows=rows,
        note="Median error in px on press and twist, 130 markers on 320 × 240 px; ms an image: markers on "
        f"{LARGE[0]} × {LARGE[1]} px, 130 markers on images of any width.",
        results=results,
        violations=[],
    )


def draw(curves: Report, file: Path) -> None:
    """Six panels: four of errors, median and 95th percentile, and two of times."""
    from matplotlib.figure import Figure  # here: slow to import

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    panels = [(curve.name, curve.label) for curve in ERRORS]
    panels += [("markers", f"markers on {LARGE[0]} × {LARGE[1]} px"), ("width", "width of the image [px]")]
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        points = [result for result in curves.results if result["curve"] == name]
        at = [point["at"] for point in points]
        for k, who in enumerate(FOLLOWERS):
            if "frame" in points[0][who]:
                axes.plot(at, [point[who]["frame"] for point in points], "o-", color=f"C{k}", label=who, ms=3)
                axes.set_ylabel("ms an image")
            else:
                for figure_name, line in (("median", "o-"), ("high", "--")):
                    values = [np.nan if (v := point[who][figure_name]) is None else v for point in points]
                    label_once = who if figure_name == "median" else None
                    axes.plot(at, values, line, color=f"C{k}", label=label_once, ms=3)
                axes.set_ylabel("error [px]")
        axes.set_yscale("log")
        axes.set_xlabel(label)
        axes.grid(True, which="major", alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), title="median; dashed: 95 %")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90)
