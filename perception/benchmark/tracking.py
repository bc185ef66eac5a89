"""`gelflow bench tracking`: marker tracking on rendered images with ground truth, compared with OpenCV's trackers."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gelflow.measurement.timing import BenchmarkOptions, Report
from gelflow.perception.benchmark.baselines import TRACKERS
from gelflow.perception.benchmark.image_classes import (
    CLASSES,
    FACTORED,
    LARGE,
    MARKERS,
    MOST_MARKERS,
    SIZED,
    SMALL,
    ImageClass,
)
from gelflow.perception.benchmark.metrics import TrackingMetrics
from gelflow.perception.benchmark.speed import measure_speed
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.error_bound import cramer_rao_errors
from gelflow.perception.synthetic.sequences import FIELDS, INITIAL_REST, Field, GelSequence

GELFLOW, LUCAS_KANADE, DENSE_FLOW = TRACKERS
FRAMES, QUICK_FRAMES = 34, 10  # images from rest to the peak, which is in the last one
LARGE_PEAK = 0.8  # peak displacement of the sequences for identity switches / spacing
JUMPS, QUICK_JUMPS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0), (0.4, 0.7)  # displacement within one image / spacing
RECOVERED = 0.99  # required fraction of recovered markers two images after a jump
REST_FRAMES, QUICK_REST_FRAMES = 40, 8  # images of the sequences at rest
DRIFT, QUICK_DRIFT = 240, 15  # images until the gel is back at rest
DRIFT_PERIOD = 60

# Bounds of the errors of gelflow: (median, 95th percentile) [px], and the fraction of markers within 0.1 spacings.
ERROR_BOUNDS = {"clean": (0.02, 0.04), "typical": (0.03, 0.06), "hard": (0.08, 0.5), "print": (0.03, 0.08)}
NEAR_BOUNDS = dict.fromkeys(("5 % missing", "15 % damaged", "four bridges", "two highlights"), 0.99)
# Bounds for the classes "clean" and "typical": [px], [px], spacings.
JITTER_BOUND, DRIFT_BOUND, JUMP_BOUND = 0.02, 0.05, 0.7


def measure_tracking(options: BenchmarkOptions) -> list[Report]:
    """Measures errors, motion and speed.

    With `options.quick`, errors are measured on the four classes with two fields, motion on the class "typical".
    """
    classes = CLASSES if options.quick else (*CLASSES, *SIZED, *FACTORED)
    moved = CLASSES[1:2] if options.quick else (*CLASSES, *FACTORED)
    options.progress.begin("tracking: errors", len(classes))
    errors = _error_report(classes, options)
    options.progress.begin("tracking: motion", len(moved))
    motion = _motion_report(moved, options)
    return [errors, motion, _speed_report(options)]


def _fields(options: BenchmarkOptions) -> Sequence[Field]:
    return FIELDS[::2] if options.quick else FIELDS


def _error_report(classes: Sequence[ImageClass], options: BenchmarkOptions) -> Report:
    rows, results = [], []
    violations: list[str] = []
    for images in classes:
        bound, metrics = _errors(images, options)
        own = metrics[GELFLOW]
        ratios = (metrics[name].median / own.median if name in metrics else None for name in (LUCAS_KANADE, DENSE_FLOW))
        errors = (own.median, own.percentile_95, own.displacement_percentile_95, bound)
        rows.append(
            (
                images.name,
                *(f"{error:.3f}" for error in errors),
                *("" if ratio is None else f"{ratio:.1f}" for ratio in ratios),
                *(f"{100 * share:.1f}" for share in (own.near, own.measured, own.recovered)),
            )
        )
        results.append(
            {"images": images.name, "error_bound": bound} | {name: one.to_dict() for name, one in metrics.items()}
        )
        violations += [f"tracking, {images.name}: {line}" for line in (*own.failed, *_error_violations(images, own))]
        options.progress.advance()
    return Report(
        name="tracking",
        title="Tracking: errors on images with ground truth, in px",
        columns=("images", "median", "95 %", "disp", "bound", "LK ×", "DIS ×", "near%", "meas%", "end%"),
        rows=rows,
        note="130 markers on 320 × 240 px unless stated otherwise; 640: on 640 × 480 px. Press, shear, twist and slip "
        "up to 0.4 spacings. disp: 95th percentile of the displacement error, which excludes the constant offset of a "
        "damaged dot. bound: median error of an efficient estimator (Cramér-Rao). LK ×, DIS ×: median error of "
        "Lucas-Kanade and dense flow, which start from the true positions at rest, relative to gelflow. near: fraction "
        "of the visible markers within 0.1 spacings of the true position; meas: measured, not inferred; end: measured "
        "within 0.1 spacings in the last image.",
        results=results,
        violations=violations,
    )


def _errors(images: ImageClass, options: BenchmarkOptions) -> tuple[float, dict[str, TrackingMetrics]]:
    """Median of the error bound [px], and the metrics of each tracker. OpenCV runs on the small images only."""
    names = tuple(TRACKERS) if images.size == SMALL else (GELFLOW,)
    frames = QUICK_FRAMES if options.quick else FRAMES
    period = 2 * (frames - 1 - INITIAL_REST)
    tracked = images.track(names, _fields(options), frames=frames, period=period)
    sequences = [
        GelSequence(images.appearance(FIELDS.index(field)), field, frames=frames, period=period)
        for field in _fields(options)
    ]
    bound = float(np.median(np.concatenate([cramer_rao_errors(sequence) for sequence in sequences])))
    return bound, {name: TrackingMetrics.from_sequences(results) for name, results in tracked.items()}


def _error_violations(images: ImageClass, own: TrackingMetrics) -> list[str]:
    """One line for each error that exceeds its bound."""
    lines = []
    bounds = ERROR_BOUNDS.get(images.preset if images in CLASSES + SIZED else "", (np.inf, np.inf))
    if own.median > bounds[0] or own.percentile_95 > bounds[1]:
        lines.append(f"errors {own.median:.3f} / {own.percentile_95:.3f} px, must be {bounds[0]:g} / {bounds[1]:g}")
    if own.near < NEAR_BOUNDS.get(images.name, 0):
        bound = NEAR_BOUNDS[images.name]
        lines.append(f"{own.near:.2%} of the visible markers within 0.1 spacing, must be {bound:.0%}")
    if own.identity_switches:
        lines.append(f"{own.identity_switches} identity switches")
    return lines


@dataclass(frozen=True)
class MotionResult:
    """The trackers on one class of images, at rest and in large motion."""

    images: str
    jitter: float | None  # of gelflow [px]
    drift: float | None  # of gelflow [px]
    identity_switches: dict[str, int]  # tracker → markers
    largest_jump: dict[str, dict[str, float]]  # tracker → field → spacings

    def jump(self, name: str) -> float:
        """Largest jump that a tracker survives in all fields, in spacings."""
        return min(self.largest_jump[name].values())

    def violations(self) -> list[str]:
        """One line for each result that exceeds its bound."""
        lines = []
        if self.identity_switches[GELFLOW]:
            lines.append(f"{self.identity_switches[GELFLOW]} identity switches at {LARGE_PEAK:g} spacings")
        if self.images in ("clean", "typical"):
            for name, value, bound in (("jitter", self.jitter, JITTER_BOUND), ("drift", self.drift, DRIFT_BOUND)):
                if value is None or value > bound:
                    lines.append(f"{name} {_pixels(value)} px, must be {bound:g}")
            if self.jump(GELFLOW) < JUMP_BOUND:
                lines.append(f"jumps of {self.jump(GELFLOW):g} spacings survived, must be {JUMP_BOUND:g}")
        return lines


def _pixels(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"


def _measure_motion(images: ImageClass, options: BenchmarkOptions) -> MotionResult:
    rest_frames = QUICK_REST_FRAMES if options.quick else REST_FRAMES
    period, after = (QUICK_DRIFT, QUICK_DRIFT) if options.quick else (DRIFT_PERIOD, DRIFT)
    still = images.track((GELFLOW,), ("press",), motion="rest", frames=rest_frames)[GELFLOW][0]
    back = images.track((GELFLOW,), ("shear",), frames=after + INITIAL_REST + 1, period=period)[GELFLOW][0]
    large = images.track(tuple(TRACKERS), _fields(options), peak=LARGE_PEAK, frames=16, period=12)
    return MotionResult(
        images=images.name,
        jitter=still.jitter(),
        drift=back.drift(),
        identity_switches={name: sum(one.identity_switches() for one in results) for name, results in large.items()},
        largest_jump=_largest_jumps(images, options),
    )


def _motion_report(classes: Sequence[ImageClass], options: BenchmarkOptions) -> Report:
    results = []
    for images in classes:
        results.append(_measure_motion(images, options))
        options.progress.advance()
    rows = [
        (
            *(one.images, _pixels(one.jitter), _pixels(one.drift)),
            *(str(one.identity_switches[name]) for name in TRACKERS),
            *(f"{one.jump(name):.1f}" for name in TRACKERS),
        )
        for one in results
    ]
    return Report(
        name="tracking_motion",
        title="Tracking: at rest, after 240 images, large motion",
        columns=("images", "jitter", "drift", "switch", "LK", "DIS", "jump", "LK", "DIS"),
        rows=rows,
        note="jitter: standard deviation at rest along an axis in px. drift: median displacement after "
        f"{DRIFT} images (quick: {QUICK_DRIFT}), back at rest, in px. switch: markers with an identity switch on the "
        f"way to {LARGE_PEAK:g} spacings in six images, summed over the fields: measured closer to the true position "
        "of another marker than to their own. jump: largest displacement within one image, in spacings, that a tracker "
        f"survives in all fields: no identity switch, and {RECOVERED:.0%} of the visible markers measured within "
        "0.1 spacings two images later.",
        results=[asdict(one) for one in results],
        violations=[f"tracking, {one.images}: {line}" for one in results for line in one.violations()],
    )


def _largest_jumps(images: ImageClass, options: BenchmarkOptions) -> dict[str, dict[str, float]]:
    """For each tracker and field the largest jump such that it and all smaller ones are survived; 0 if none."""
    jumps = QUICK_JUMPS if options.quick else JUMPS
    largest: dict[str, dict[str, float]] = {name: dict.fromkeys(_fields(options), 0.0) for name in TRACKERS}
    for field in _fields(options):
        names = list(TRACKERS)
        for jump in jumps:
            results = {
                n: found[0] for n, found in images.track(names, (field,), motion="jump", peak=jump, frames=6).items()
            }
            names = [n for n in names if results[n].identity_switches() == 0 and results[n].recovered() >= RECOVERED]
            for name in names:
                largest[name][field] = jump
            if not names:
                break
    return largest


def _speed_report(options: BenchmarkOptions) -> Report:
    numbers = (130,) if options.quick else (*MARKERS, MOST_MARKERS)
    sizes = [(n, size) for size in (SMALL, LARGE) for n in numbers]
    options.progress.begin("tracking: speed", len(sizes))
    rows: list[tuple[str, ...]] = []
    results: list[dict[str, Any]] = []
    for markers, (width, height) in sizes:
        appearance = make_appearance("typical", markers=markers, width=width, height=height)
        frames = list(GelSequence(appearance, "press", frames=QUICK_FRAMES if options.quick else FRAMES))
        images, first, grid = [frame.image for frame in frames], frames[0], appearance.grid
        start = (first.position, first.visible, grid.rows, grid.cols)
        timings = measure_speed(TRACKERS, images, *start, repeats=options.repeats)
        own, others = timings[GELFLOW], [timings[name].frame for name in (LUCAS_KANADE, DENSE_FLOW)]
        rows.append(
            (
                *(f"{width} × {height}, {markers} markers", f"{own.start:.1f}", f"{own.frame:.2f}"),
                *(f"{other:.2f}" for other in others),
                *(f"{other / own.frame:.1f}" for other in others),
            )
        )
        size = {"markers": markers, "width": width, "height": height}
        results.append(size | {name: asdict(timing) for name, timing in timings.items()})
        options.progress.advance()
    return Report(
        name="tracking_speed",
        title="Tracking: milliseconds per decoded image",
        columns=("typical images", "start", "image", "LK", "DIS", "LK ×", "DIS ×"),
        rows=rows,
        note=f"Processor time on one thread, minimum of {options.repeats}. start: the first image, in which gelflow "
        "detects the grid; Lucas-Kanade and dense flow start from the true positions.",
        results=results,
        violations=[],
    )
