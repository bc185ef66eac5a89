"""Curves of `gelflow bench tracking --out FOLDER`: errors over image degradation, and time over size."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gelflow.figures import SERIES, save, set_log_axis
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


@dataclass(frozen=True)
class Curve:
    """A parameter of the class "typical" and its values."""

    name: str
    label: str
    values: tuple[float, ...]
    changes: Callable[[float], tuple[dict[str, Any], dict[str, Any]]]  # value → fields of appearance and of sequence


ERRORS = (
    Curve("noise", "noise [grey levels]", (0.5, 1, 1.5, 2, 3, 4, 6, 8), lambda value: ({"noise": value}, {})),
    Curve(
        "motion",
        "largest motion [spacings]",
        (0.1, 0.2, 0.4, 0.6, 0.8, 1.0),
        lambda value: ({}, {"peak": value}),
    ),
    Curve(
        "missing", "share of missing dots [-]", (0, 0.02, 0.05, 0.1, 0.15, 0.2), lambda value: ({"missing": value}, {})
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


def draw(results: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Draw the results of `measure_curves`: errors over four parameters, and times over markers and image width."""
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = [(curve.name, curve.label) for curve in ERRORS]
    panels += [("markers", f"number of markers on {LARGE[0]} × {LARGE[1]} px"), ("width", "image width [px]")]
    for axes, (name, label) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        points = [result for result in results if result["curve"] == name]
        axes.set_xlabel(label)
        set_log_axis(axes, "y")
        axes.grid(True, which="major", alpha=0.3)
        if name in ("markers", "width"):
            _draw_times(axes, points)
        else:
            _draw_errors(axes, points)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    legend = "solid: median; dashed: 95th percentile; cross: a grid is not found"
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), title=legend)
    figure.suptitle(_title(results), fontsize=11)
    save(figure, file, dpi=90)


def _title(results: Sequence[Mapping[str, Any]]) -> str:
    """Range of the median errors and times of the other trackers relative to those of gelflow."""
    own, *others = TRACKERS
    parts = []
    for other in others:
        ranges = []
        for metric in ("median", "frame"):
            pairs = [(r[own][metric], r[other][metric]) for r in results if metric in r[own]]
            ratios = [theirs / ours for ours, theirs in pairs if ours is not None and theirs is not None]
            ranges.append(" to ".join(f"{end:.{0 if end >= 10 else 1}f}" for end in (min(ratios), max(ratios))))
        parts.append(f"{other}: {ranges[0]} × the median error, {ranges[1]} × the time")
    return "\n".join((f"Relative to {own}, where it finds the grid", *parts))


def _draw_errors(axes: Any, points: Sequence[Mapping[str, Any]]) -> None:
    axes.set_ylabel("position error [px]")
    for name, (color, marker) in zip(TRACKERS, SERIES, strict=False):
        for metric, style, fill, label in (("median", "-", color, name), ("percentile_95", "--", "white", None)):
            measured = [(p["value"], p[name][metric]) for p in points if p[name][metric] is not None]
            axes.plot(*zip(*measured, strict=True), marker + style, color=color, mfc=fill, label=label, ms=4)
        failed = [p["value"] for p in points if p[name]["failed"]]
        axes.plot(failed, [0.04] * len(failed), "x", color=color, ms=8, mew=2, transform=axes.get_xaxis_transform())


def _draw_times(axes: Any, points: Sequence[Mapping[str, Any]]) -> None:
    axes.set_ylabel("time per image [ms]")
    for name, (color, marker) in zip(TRACKERS, SERIES, strict=False):
        times = [(p["value"], p[name]["frame"]) for p in points]
        axes.plot(*zip(*times, strict=True), marker + "-", color=color, ms=4)
