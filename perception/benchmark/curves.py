"""The curves of `gelflow bench tracking --picture FILE`: errors against image degradation, time against size."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.measurement.timing import BenchmarkOptions, Report
from gelflow.perception.benchmark.baselines import TRACKERS
from gelflow.perception.benchmark.image_classes import LARGE, ImageClass
from gelflow.perception.benchmark.metrics import TrackingMetrics
from gelflow.perception.benchmark.speed import measure_speed
from gelflow.perception.synthetic.appearance import SIZES, make_appearance
from gelflow.perception.synthetic.sequences import FIELDS, GelSequence

_SEQUENCE: dict[str, Any] = {"frames": 20, "period": 32}  # from rest to the peak
_QUICK_SEQUENCE: dict[str, Any] = {"frames": 6, "period": 4}
_TIMED_FRAMES = 8
_STYLES = (("o-", "#0072b2"), ("s-", "#d55e00"), ("^-", "#555555"))  # marker and colour of each tracker


@dataclass(frozen=True)
class Curve:
    """A parameter of the class "typical" and its values."""

    name: str
    label: str
    values: tuple[float, ...]
    changes: Callable[[float], tuple[dict[str, Any], dict[str, Any]]]  # value → fields of appearance and of sequence


ERRORS = (
    Curve("noise", "noise [grey levels]", (0.5, 1, 1.5, 2, 3, 4, 6, 8), lambda value: ({"noise": value}, {})),
    Curve("motion", "largest motion [spacings]", (0.1, 0.2, 0.4, 0.6, 0.8, 1.0), lambda value: ({}, {"peak": value})),
    Curve(
        "missing", "missing dots [fraction]", (0, 0.02, 0.05, 0.1, 0.15, 0.2), lambda value: ({"missing": value}, {})
    ),
    Curve("occlusion", "number of occluders", (0, 1, 2, 3, 4), lambda value: ({"occluders": int(value)}, {})),
)
WIDTHS = (240, 320, 480, 640, 960, 1280)  # of images with aspect ratio 4:3 [px]


def measure_curves(options: BenchmarkOptions) -> Report:
    """Errors and times along all curves; with `options.quick` at their end points only."""
    rows: list[tuple[str, ...]] = []
    results: list[dict[str, Any]] = []
    for curve in ERRORS:
        _measure_errors(curve, options, rows, results)
    _measure_times(options, rows, results)
    return Report(
        name="tracking_curves",
        title="Tracking: curves",
        columns=("typical with", *TRACKERS),
        rows=rows,
        note="Median error in px for press and twist, 130 markers on 320 × 240 px; ms per image: number of markers on "
        f"{LARGE[0]} × {LARGE[1]} px, and 130 markers on images of different width.",
        results=results,
        violations=[],
    )


def _measure_errors(
    curve: Curve, options: BenchmarkOptions, rows: list[tuple[str, ...]], results: list[dict[str, Any]]
) -> None:
    fields, sequence = (FIELDS[:1], _QUICK_SEQUENCE) if options.quick else (FIELDS[::2], _SEQUENCE)
    values = curve.values[:: len(curve.values) - 1] if options.quick else curve.values
    options.progress.begin(f"tracking: {curve.name}", len(values))
    for value in values:
        changed, motion = curve.changes(value)
        tracked = ImageClass(curve.name, "typical", changed).track(TRACKERS, fields, **(sequence | motion))
        metrics = {name: TrackingMetrics.from_sequences(found) for name, found in tracked.items()}
        rows.append(
            (f"{curve.name} {value:g}", *("failed" if m.failed else f"{m.median:.3f}" for m in metrics.values()))
        )
        results.append({"curve": curve.name, "value": value} | {name: m.to_dict() for name, m in metrics.items()})
        options.progress.advance()


def _measure_times(options: BenchmarkOptions, rows: list[tuple[str, ...]], results: list[dict[str, Any]]) -> None:
    timed = [("markers", markers, markers, LARGE) for markers in SIZES]
    timed += [("width", width, 130, (width, width * 3 // 4)) for width in WIDTHS]
    for name, value, markers, size in [timed[0], timed[len(SIZES)]] if options.quick else timed:
        appearance = make_appearance("typical", markers=markers, width=size[0], height=size[1])
        frames = list(GelSequence(appearance, frames=_TIMED_FRAMES))
        images, first, grid = [frame.image for frame in frames], frames[0], appearance.grid
        start = (first.position, first.visible, grid.rows, grid.cols)
        timings = measure_speed(TRACKERS, images, *start, repeats=options.repeats)
        rows.append((f"ms: {name} {value}", *(f"{timing.frame:.2f}" for timing in timings.values())))
        results.append({"curve": name, "value": value} | {name: asdict(timing) for name, timing in timings.items()})


def draw(curves: Report, file: Path) -> None:
    """Draws six panels: median and 95th percentile of the errors over four parameters, and two of times."""
    from matplotlib.figure import Figure  # imported on use: slow

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    panels = [(curve.name, curve.label) for curve in ERRORS]
    panels += [("markers", f"markers on {LARGE[0]} × {LARGE[1]} px"), ("width", "image width [px]")]
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        points = [result for result in curves.results if result["curve"] == name]
        _draw_panel(axes, points)
        axes.set_yscale("log")
        axes.set_xlabel(label)
        axes.grid(True, which="major", alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), title="median; dashed: 95 %")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90)


def _draw_panel(axes: Any, points: list[dict[str, Any]]) -> None:
    x = [point["value"] for point in points]
    timed = "frame" in points[0][next(iter(TRACKERS))]
    axes.set_ylabel("time per image [ms]" if timed else "error [px]")
    for name, (line, colour) in zip(TRACKERS, _STYLES, strict=True):
        if timed:
            axes.plot(x, [point[name]["frame"] for point in points], line, color=colour, label=name, ms=3)
            continue
        for metric, style, label in (("median", line, name), ("percentile_95", "--", None)):
            values = [np.nan if (value := point[name][metric]) is None else value for point in points]
            axes.plot(x, values, style, color=colour, label=label, ms=3)
