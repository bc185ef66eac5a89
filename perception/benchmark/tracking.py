"""`gelflow bench tracking`: marker tracking on rendered images with known truth, beside OpenCV's. No command."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gelflow.measurement.timing import BenchmarkOptions, Report
from gelflow.perception.benchmark.baselines import FOLLOWERS
from gelflow.perception.benchmark.metrics import Course, Figures, follow
from gelflow.perception.benchmark.speed import measure_speed
from gelflow.perception.synthetic.appearance import FACTORS, PRESETS, DegradedGelAppearance, make_appearance
from gelflow.perception.synthetic.error_bound import cramer_rao_errors
from gelflow.perception.synthetic.sequences import FIELDS, INITIAL_REST, Field, GelSequence

if TYPE_CHECKING:
    from gelflow.perception.benchmark.baselines import Follower

OWN, FLOW, DENSE = FOLLOWERS
SMALL, LARGE = (320, 240), (640, 480)  # of images [px]
MARKERS = (63, 130, 154)
FRAMES = 34  # from rest to the peak
QUICK_FRAMES = 10
IDENTITY = 0.8  # peak of the sequences that are about which marker is which, in spacings
JUMPS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # from one image to the next, in spacings
QUICK_JUMPS = (0.4, 0.7)
SURVIVED = 0.99  # share of the visible markers that must be where they should be, two images after a jump
REST_FRAMES, QUICK_REST_FRAMES = 40, 8
DRIFT, QUICK_DRIFT = 240, 15  # images after which the gel is back at rest
DRIFT_PERIOD = 60

# What must hold. Errors in px: (median, 95th percentile); shares of the visible markers within 0.1 spacing.
ERROR_BARS = {"clean": (0.02, 0.04), "typical": (0.03, 0.06), "hard": (0.08, 0.5)}
NEAR_BARS = dict.fromkeys(("5 % missing", "15 % damaged", "four bridges", "two highlights"), 0.99)
JITTER_BAR, DRIFT_BAR, JUMP_BAR = 0.02, 0.05, 0.7  # [px], [px], spacings: of the clean and the typical class


@dataclass(frozen=True)
class Case:
    """A class of images."""

    name: str
    preset: str
    changed: Mapping[str, Any]
    markers: int = 130
    size: tuple[int, int] = SMALL  # of the image [px]

    def appearance(self, seed: int) -> DegradedGelAppearance:
        width, height = self.size
        return make_appearance(
            self.preset, markers=self.markers, width=width, height=height, seed=seed, **dict(self.changed)
        )

    def follow(self, names: Iterable[str], fields: Sequence[Field], **motion: Any) -> dict[str, list[Course]]:
        """The courses of trackers on one sequence for each of `fields`, every one with another print and light."""
        courses: dict[str, list[Course]] = {name: [] for name in names}
        for field in fields:
            appearance = self.appearance(seed=FIELDS.index(field))
            followers: dict[str, Follower] = {name: FOLLOWERS[name]() for name in courses}
            found = follow(
                GelSequence(appearance, field, **motion), appearance.grid.rows, appearance.grid.cols, followers
            )
            for name, course in found.items():
                courses[name].append(course)
        return courses


CLASSES = tuple(Case(preset, preset, {}) for preset in PRESETS)
SIZED = tuple(
    Case(f"{preset} {markers}{' 640' if size == LARGE else ''}", preset, {}, markers, size)
    for preset in PRESETS
    for size in (SMALL, LARGE)
    for markers in MARKERS
    if (markers, size) != (130, SMALL)
)
FACTORED = tuple(Case(name, "typical", changed) for name, changed in FACTORS.items())


def measure_tracking(options: BenchmarkOptions) -> list[Report]:
    """All of it; with `options.quick` the three classes only, on two fields, and motion on the typical class alone."""
    cases = CLASSES if options.quick else (*CLASSES, *SIZED, *FACTORED)
    moved = CLASSES[1:2] if options.quick else (*CLASSES, *FACTORED)
    options.progress.begin("tracking: errors", len(cases))
    errors = _errors(cases, options)
    options.progress.begin("tracking: motion", len(moved))
    motion = _motion(moved, options)
    return [errors, motion, _speed(options)]


def _fields(options: BenchmarkOptions) -> Sequence[Field]:
    return FIELDS[::2] if options.quick else FIELDS


def _errors(cases: Sequence[Case], options: BenchmarkOptions) -> Report:
    rows, results = [], []
    violations: list[str] = []
    for case in cases:
        # The other trackers are measured on the images of the usual size.
        names = tuple(FOLLOWERS) if case.size == SMALL else (OWN,)
        frames = QUICK_FRAMES if options.quick else FRAMES
        figures = {n: Figures.of(c) for n, c in case.follow(names, _fields(options), frames=frames).items()}
        looks = [(case.appearance(FIELDS.index(field)), field) for field in _fields(options)]
        bounds = [cramer_rao_errors(GelSequence(shown, field, frames=frames)) for shown, field in looks]
        floor = np.concatenate(bounds)
        own, least = figures[OWN], float(np.median(floor))
        rows.append(
            (
                *(case.name, f"{own.median:.3f}", f"{own.high:.3f}", f"{own.displacement_high:.3f}", f"{least:.3f}"),
                *(f"{figures[n].median / own.median:.1f}" if n in figures else "" for n in (FLOW, DENSE)),
                *(f"{100 * share:.1f}" for share in (own.near, own.measured, own.recovered)),
            )
        )
        results.append({"images": case.name, "floor": least} | {name: one.plain() for name, one in figures.items()})
        violations += [f"tracking, {case.name}: {line}" for line in (*own.failed, *_errors_missed(case, own))]
        options.progress.advance()
    return Report(
        name="tracking",
        title="Tracking: endpoint errors on images with known truth, in px",
        columns=("images", "median", "95 %", "disp", "floor", "LK ×", "DIS ×", "near%", "meas%", "end%"),
        rows=rows,
        note="130 markers on 320 × 240 px where no number is said; 640: on 640 × 480 px. Press, shear, twist and slip "
        "up to 0.4 of the spacing. disp: 95th percentile of the displacement's error, in which it does not count what "
        "the middle of a damaged dot is off by. floor: median error of a least-squares fit that knows each dot's "
        "image. LK ×, DIS ×: how many times as large the median error of Lucas-Kanade and of dense flow is; both are "
        "told where the markers are at rest. near: of the visible markers, within 0.1 spacing of the truth; meas: "
        "measured, not guessed; end: both, in the last image.",
        results=results,
        violations=violations,
    )


def _errors_missed(case: Case, own: Figures) -> list[str]:
    """What of the errors does not hold, a line each."""
    lines = []
    median, high = ERROR_BARS.get(case.preset if case in CLASSES + SIZED else "", (np.inf, np.inf))
    if own.median > median or own.high > high:
        lines.append(f"errors {own.median:.3f} / {own.high:.3f} px, must be {median:g} / {high:g}")
    if own.near < NEAR_BARS.get(case.name, 0):
        lines.append(f"{own.near:.2%} of the visible markers within 0.1 spacing, must be {NEAR_BARS[case.name]:.0%}")
    if own.exchanged:
        lines.append(f"{own.exchanged} markers exchanged")
    return lines


@dataclass(frozen=True)
class Motion:
    """Trackers on one class of images, at rest and far from it; by tracker where all are measured."""

    images: str
    jitter: float | None  # [px]
    drift: float | None  # [px]
    exchanged: dict[str, int]  # markers
    largest_jump: dict[str, dict[str, float]]  # by field, in spacings

    def jump(self, name: str) -> float:
        """The largest that every field survives, in spacings."""
        return min(self.largest_jump[name].values())

    def missed(self) -> list[str]:
        """What does not hold, a line each."""
        lines = []
        if self.exchanged[OWN]:
            lines.append(f"{self.exchanged[OWN]} markers exchanged on the way to {IDENTITY:g} of the spacing")
        if self.images in ("clean", "typical"):
            for what, found, most in (("jitter", self.jitter, JITTER_BAR), ("drift", self.drift, DRIFT_BAR)):
                if found is None or found > most:
                    lines.append(f"{what} {_pixels(found)} px, must be {most:g}")
            if self.jump(OWN) < JUMP_BAR:
                lines.append(f"jumps of {self.jump(OWN):g} of the spacing survived, must be {JUMP_BAR:g}")
        return lines


def _pixels(found: float | None) -> str:
    return "none" if found is None else f"{found:.3f}"


def _moved(case: Case, options: BenchmarkOptions) -> Motion:
    rest_frames = QUICK_REST_FRAMES if options.quick else REST_FRAMES
    period, after = (QUICK_DRIFT, QUICK_DRIFT) if options.quick else (DRIFT_PERIOD, DRIFT)
    still = case.follow((OWN,), ("press",), motion="rest", frames=rest_frames)[OWN][0]
    back = case.follow((OWN,), ("shear",), frames=after + INITIAL_REST + 1, period=period)[OWN][0]
    large = case.follow(tuple(FOLLOWERS), _fields(options), peak=IDENTITY, frames=16, period=12)
    return Motion(
        images=case.name,
        jitter=still.jitter(),
        drift=back.drift(),
        exchanged={name: sum(course.exchanged() for course in courses) for name, courses in large.items()},
        largest_jump=_largest_jumps(case, options),
    )


def _motion(cases: Sequence[Case], options: BenchmarkOptions) -> Report:
    found = []
    for case in cases:
        found.append(_moved(case, options))
        options.progress.advance()
    rows = [
        (
            *(one.images, _pixels(one.jitter), _pixels(one.drift)),
            *(str(one.exchanged[name]) for name in FOLLOWERS),
            *(f"{one.jump(name):.1f}" for name in FOLLOWERS),
        )
        for one in found
    ]
    return Report(
        name="tracking_motion",
        title="Tracking: at rest, after 240 images, large motion",
        columns=("images", "jitter", "drift", "exch.", "LK", "DIS", "jump", "LK", "DIS"),
        rows=rows,
        note="jitter: at rest, standard deviation along an axis in px. drift: the median marker's displacement "
        f"after {DRIFT} images (quick: {QUICK_DRIFT}), back at rest, in px. exch.: markers exchanged on the way "
        f"to {IDENTITY:g} of the spacing in six images, all fields together; a marker is exchanged when it is said to "
        "be measured, and lies nearer to another one's place than to its own. jump: largest step from one image to the "
        "next, in spacings, that every field survives with no marker exchanged, and "
        f"{SURVIVED:.0%} of the visible ones in place two images later.",
        results=[asdict(one) for one in found],
        violations=[f"tracking, {one.images}: {line}" for one in found for line in one.missed()],
    )


def _largest_jumps(case: Case, options: BenchmarkOptions) -> dict[str, dict[str, float]]:
    """For each tracker and field the largest of the jumps that it and all smaller ones survived; 0 if none."""
    jumps = QUICK_JUMPS if options.quick else JUMPS
    best: dict[str, dict[str, float]] = {name: dict.fromkeys(_fields(options), 0.0) for name in FOLLOWERS}
    for field in _fields(options):
        alive = list(FOLLOWERS)
        for jump in jumps:
            courses = case.follow(alive, (field,), motion="jump", peak=jump, frames=6)
            alive = [n for n in alive if courses[n][0].exchanged() == 0 and courses[n][0].recovered() >= SURVIVED]
            for name in alive:
                best[name][field] = jump
            if not alive:
                break
    return best


def _speed(options: BenchmarkOptions) -> Report:
    sizes = [(130, SMALL), (130, LARGE)] if options.quick else [(n, size) for size in (SMALL, LARGE) for n in MARKERS]
    options.progress.begin("tracking: speed", len(sizes))
    rows, results = [], []
    for markers, (width, height) in sizes:
        appearance = make_appearance("typical", markers=markers, width=width, height=height)
        frames = list(GelSequence(appearance, "press", frames=QUICK_FRAMES if options.quick else FRAMES))
        images = [frame.image for frame in frames]
        first, grid = frames[0], appearance.grid
        timings = measure_speed(
            FOLLOWERS, images, first.position, first.visible, grid.rows, grid.cols, repeats=options.repeats
        )
        own = timings[OWN]
        rows.append(
            (
                *(f"{width} × {height}, {markers} markers", f"{own.start:.1f}", f"{own.frame:.2f}"),
                *(f"{timings[name].frame:.2f}" for name in (FLOW, DENSE)),
                *(f"{timings[name].frame / own.frame:.1f}" for name in (FLOW, DENSE)),
            )
        )
        results.append(
            {"markers": markers, "width": width, "height": height} | {n: asdict(t) for n, t in timings.items()}
        )
        options.progress.advance()
    return Report(
        name="tracking_speed",
        title="Tracking: milliseconds an image, after decoding",
        columns=("typical images", "start", "image", "LK", "DIS", "LK ×", "DIS ×"),
        rows=rows,
        note=f"Processor time on one thread, best of {options.repeats}. start: the first image, in which the grid is "
        "found; Lucas-Kanade and dense flow are told where it is.",
        results=results,
        violations=[],
    )
