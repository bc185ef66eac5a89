"""The marker tracker on rendered gel images with ground truth."""

import cv2
import numpy as np
import pytest

from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.observation import Grid
from gelflow.perception import MarkerTracker, TrackerConfig, TrackerInitError, TrackingResult
from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer, RenderedImage
from gelflow.perception.synthetic.appearance import FACTORS, GelAppearance, make_appearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.sequences import FIELDS, Field, GelSequence

MOUNT = CameraMount(pixels_per_mm=15.7)
SPACING = 1.4  # [mm]


def press(rest: np.ndarray, rng: np.random.Generator, largest: float) -> np.ndarray:
    """A smooth displacement field [mm] around a random centre, of length `largest` there."""
    centre = rng.uniform((-4, -6), (8, 6))
    angle = rng.uniform(0, 2 * np.pi)
    bump = np.exp(-((rest - centre) ** 2).sum(1) / (2 * rng.uniform(3, 7) ** 2))
    field: np.ndarray = bump[:, None] * largest * np.array([np.cos(angle), np.sin(angle)])
    return field


def track_fields(appearance: GelAppearance, fields: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Errors [px] of the valid markers and the valid flags, for each displacement field after rest."""
    renderer, mount = (
        FastGelRenderer(appearance),
        CameraMount(mirrored=appearance.mirrored, pixels_per_mm=appearance.pixels_per_mm),
    )
    tracker = MarkerTracker(mount.tracker_config())
    tracker.start(decode_image(renderer.encode(renderer.render(np.zeros_like(fields[0])))))
    results = []
    for number, field in enumerate(fields, start=1):
        tracked = tracker.track(decode_image(renderer.encode(renderer.render(field, sequence=number))))
        frame = tactile_frame([tracked], [mount], stamp=0.0)
        valid = frame.valid[0]
        error = np.linalg.norm(frame.shear[0][valid] - field[valid], axis=1) * appearance.pixels_per_mm
        results.append((error, valid))
    return results


@pytest.mark.parametrize("bright", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.05])
def test_jumps_by_half_a_spacing_are_tracked_to_a_tenth_of_a_pixel(missing: float, bright: bool) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        appearance = GelAppearance(seed=seed, missing=missing, bright=bright)
        rest = appearance.positions_mm()
        # Each field starts and ends within one image, so markers move by up to half a spacing between images.
        fields = [press(rest, rng, 0.5 * SPACING) if k % 2 else np.zeros_like(rest) for k in range(1, 9)]
        for error, valid in track_fields(appearance, fields):
            assert valid.sum() == round((1 - missing) * valid.size)
            assert np.median(error) < 0.1
            assert error.max() < 0.5  # no identity switches


def test_a_common_shift_of_nearly_half_a_spacing_keeps_its_sign() -> None:
    appearance = GelAppearance(seed=4, missing=0.05)
    shifts = [np.tile(np.array(s) * SPACING, (252, 1)) for s in ((0.45, 0), (0, 0.0), (0.3, -0.3), (-0.1, 0.1))]
    for error, valid in track_fields(appearance, shifts):
        assert valid.mean() > 0.93 and error.max() < 0.5


def test_tracking_works_with_noise_blur_and_low_contrast() -> None:
    rng = np.random.default_rng(0)
    for appearance in (
        GelAppearance(noise=5.0),
        GelAppearance(blur=2.2),
        GelAppearance(contrast=0.3, colour=0.8),
        GelAppearance(light=60.0),
    ):
        for error, valid in track_fields(appearance, [press(appearance.positions_mm(), rng, 0.5)]):
            assert valid.mean() > 0.98 and np.median(error) < 0.15 and error.max() < 1.0


def test_the_numbers_of_rows_and_columns_are_detected() -> None:
    appearance = GelAppearance(grid=Grid(rows=10, cols=7, pitch=2.6), radius=6.0)
    renderer = FastGelRenderer(appearance)
    tracked = MarkerTracker().start(renderer.render(np.zeros((70, 2))))
    assert (tracked.rows, tracked.cols) == (10, 7) and tracked.valid.all()
    assert np.abs(tracked.spacing - 2.6 * appearance.pixels_per_mm) < 0.5


def test_equal_images_give_identical_results() -> None:
    renderer = FastGelRenderer(GelAppearance(missing=0.05))
    rng = np.random.default_rng(1)
    data = [renderer.encode(renderer.render(rng.normal(0, 0.1, (252, 2)), sequence=k)) for k in range(4)]
    runs = []
    for _ in range(2):
        tracker = MarkerTracker(MOUNT.tracker_config())
        runs.append([tracker.track(decode_image(d)) for d in data])
    for a, b in zip(*runs, strict=True):
        assert a.position.tobytes() == b.position.tobytes()
        assert a.displacement.tobytes() == b.displacement.tobytes() and (a.valid == b.valid).all()


def test_a_second_start_replaces_the_reference() -> None:
    renderer = FastGelRenderer()
    moved = renderer.render(np.full((252, 2), 0.3))
    tracker = MarkerTracker()
    tracker.track(renderer.render(np.zeros((252, 2))))
    assert np.nanmedian(np.abs(tracker.track(moved).displacement)) > 4
    assert not tracker.start(moved).displacement.any()


def test_a_covered_marker_is_inferred_and_recovers() -> None:
    renderer = FastGelRenderer()
    rest = renderer.render(np.zeros((252, 2)))
    tracker = MarkerTracker(MOUNT.tracker_config())
    first = tracker.start(rest)
    covered = rest.copy()
    position = first.position[100]
    right, down = position.round().astype(int)
    covered[down - 8 : down + 9, right - 8 : right + 9] = covered[down - 10, right - 10]
    lost = tracker.track(covered)
    assert np.flatnonzero(~lost.valid).tolist() == [100]
    assert np.flatnonzero(lost.inferred).tolist() == [100] and lost.quality[100] == 0
    assert np.linalg.norm(lost.position[100] - position) < 0.5  # interpolated from the neighbours
    back = tracker.track(rest)
    assert back.valid.all() and np.linalg.norm(back.displacement[100]) < 0.1


def test_two_merged_markers_are_not_valid() -> None:
    renderer = FastGelRenderer()
    field = np.zeros((252, 2))
    field[100], field[101] = (0, 0.55), (0, -0.55)  # neighbours in a row meet
    tracker = MarkerTracker(MOUNT.tracker_config())
    tracker.start(renderer.render(np.zeros((252, 2))))
    tracked = tracker.track(renderer.render(field))
    frame = tactile_frame([tracked], [MOUNT], stamp=0.0)
    assert not frame.valid[0, [100, 101]].any()
    assert frame.valid[0].sum() >= 248


def test_tracking_recovers_after_blank_images() -> None:
    renderer = FastGelRenderer()
    tracker = MarkerTracker(MOUNT.tracker_config())
    tracker.start(renderer.render(np.zeros((252, 2))))
    for _ in range(3):
        assert not tracker.track(np.full((427, 320, 3), 90, dtype=np.uint8)).valid.any()
    field = np.tile([0.5, 0.2], (252, 1))
    tracked = tracker.track(renderer.render(field))
    frame = tactile_frame([tracked], [MOUNT], stamp=0.0)
    assert frame.valid.all() and np.abs(frame.shear[0] - field).max() < 0.02


@pytest.mark.parametrize(("rows", "cols"), [(17, 14), (19, 14), (14, 18), (10, 7)])
def test_a_grid_of_another_shape_is_rejected(rows: int, cols: int) -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    with pytest.raises(TrackerInitError, match="18 rows of 14 entire markers"):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols, either_way=False)).start(image)


def test_transposed_rows_and_columns_are_accepted_by_default() -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    tracked = MarkerTracker(TrackerConfig(rows=14, cols=18)).start(image)
    assert (tracked.rows, tracked.cols) == (18, 14)


@pytest.mark.parametrize(("rows", "cols"), [(18, None), (2, 14), (18, 1000)])
def test_impossible_numbers_of_rows_and_columns_are_rejected(rows: int, cols: int | None) -> None:
    with pytest.raises(UsageError):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols)).start(FastGelRenderer().render(np.zeros((252, 2))))


def test_an_unknown_polarity_is_rejected() -> None:
    with pytest.raises(UsageError, match="polarity must be one of auto, dark, bright, got 'black'"):
        TrackerConfig(polarity="black")  # type: ignore[arg-type]


def test_an_image_of_another_size_is_rejected() -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    tracker = MarkerTracker()
    tracker.start(image)
    with pytest.raises(PeerError, match="320 × 427 px to 320 × 400 px"):
        tracker.track(image[:400])


def track_sequence(sequence: GelSequence) -> list[tuple[RenderedImage, TrackingResult, np.ndarray]]:
    """For each image after the first: ground truth, tracking result and displacement errors [px]."""
    tracker, frames = MarkerTracker(), list(sequence)
    first = tracker.start(frames[0].image)
    assert (first.rows, first.cols) == (sequence.appearance.grid.rows, sequence.appearance.grid.cols)
    results = []
    for frame in frames[1:]:
        tracked = tracker.track(frame.image)
        off = np.linalg.norm(tracked.displacement - (frame.position - frames[0].position), axis=1)
        results.append((frame, tracked, off))
    return results


def near_fraction(sequence: GelSequence) -> float:
    """Fraction of the visible markers with errors below 0.1 spacings."""
    return float(
        np.mean(
            np.concatenate([off[f.visible] for f, _, off in track_sequence(sequence)])
            < 0.1 * sequence.appearance.spacing
        )
    )


@pytest.mark.parametrize(
    ("preset", "median", "high"), [("clean", 0.02, 0.04), ("typical", 0.03, 0.06), ("hard", 0.08, 0.5)]
)
def test_errors_are_close_to_the_error_bound(preset: str, median: float, high: float) -> None:
    results = track_sequence(GelSequence(make_appearance(preset, seed=1), "twist", frames=10, period=12))
    errors = np.concatenate([off[tracked.valid & frame.visible] for frame, tracked, off in results])
    assert np.median(errors) < median and np.quantile(errors, 0.95) < high
    assert np.mean([tracked.valid[frame.visible].mean() for frame, tracked, _ in results]) > 0.98


@pytest.mark.parametrize(("width", "height", "markers"), [(320, 240, 63), (640, 480, 130), (640, 480, 63)])
@pytest.mark.parametrize(
    ("preset", "spread", "median", "high"),
    [("clean", 0.06, 0.02, 0.04), ("typical", 0.06, 0.03, 0.06), ("typical", 0.12, 0.03, 0.08)],
)
def test_dots_of_different_sizes_and_ragged_outlines_are_tracked_as_exactly(
    width: int, height: int, markers: int, preset: str, spread: float, median: float, high: float
) -> None:
    size = {"width": width, "height": height, "markers": markers}
    appearance = make_appearance(preset, seed=2, radius_spread=spread, ragged=0.04, **size)
    results = track_sequence(GelSequence(appearance, "twist", frames=8, period=10))
    for errors in (
        np.concatenate([off[tracked.valid] for _, tracked, off in results]),
        np.concatenate([np.linalg.norm(t.position - f.position, axis=1)[t.valid] for f, t, _ in results]),
    ):
        assert np.median(errors) < median and np.quantile(errors, 0.95) < high
    assert np.mean([tracked.valid[frame.visible].mean() for frame, tracked, _ in results]) > 0.998


@pytest.mark.parametrize("seed", [2000, 2001])
def test_uneven_dots_in_a_fast_press_are_tracked_as_exactly(seed: int) -> None:
    appearance = make_appearance("clean", seed=seed, radius_spread=0.06, ragged=0.04, markers=63, width=640, height=480)
    results = track_sequence(GelSequence(appearance, "press", frames=8, period=10))
    for _, tracked, off in results:
        assert tracked.valid.all() and np.quantile(off, 0.95) < 0.04


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("changed", [{}, {"missing": 0.05, "bridges": 2}, {"cut_row": True, "markers": 63}])
def test_a_jump_by_most_of_a_spacing_causes_no_identity_switch(field: Field, changed: dict[str, float]) -> None:
    appearance = make_appearance("typical", seed=2, **changed)  # type: ignore[arg-type]
    for frame, tracked, off in track_sequence(GelSequence(appearance, field, frames=5, motion="jump", peak=0.7)):
        assert tracked.valid[frame.visible].mean() > 0.99
        assert (off[tracked.valid] < 0.1 * appearance.spacing).all()


def test_markers_beside_an_occluder_are_not_exchanged() -> None:
    appearance = make_appearance("hard", markers=63, width=640, height=480, seed=200)
    sequence = GelSequence(appearance, "press", frames=34)
    renderer, tracker = AccurateGelRenderer(appearance), MarkerTracker()
    for number in (0, 1, 2, *range(6, 14)):
        frame = renderer.render(sequence.displacement(number), number=number, **sequence.render_arguments(number))
        tracked = tracker.track(frame.image)
        off = np.linalg.norm(tracked.position - frame.position, axis=1)
        assert (off[tracked.valid] < 0.3 * appearance.spacing).all()


def test_a_jump_of_the_whole_grid_is_not_confused_with_its_neighbouring_row() -> None:
    appearance = make_appearance("typical", cut_row=True)
    renderer, tracker, still = AccurateGelRenderer(appearance), MarkerTracker(), np.zeros((130, 2))
    rest = renderer.render(still).position
    tracker.start(renderer.render(still).image)
    for number, shift in enumerate([(0.7, 0.0), (0.0, 0.0), (-0.5, 0.4), (-0.1, -0.1)], start=1):
        frame = renderer.render(still + np.array(shift) * appearance.grid.pitch, number=number)
        tracked = tracker.track(frame.image)
        assert tracked.valid.all() and np.abs(tracked.displacement - (frame.position - rest)).max() < 0.5


@pytest.mark.parametrize("name", FACTORS)
def test_every_image_class_is_tracked_without_prior_knowledge(name: str) -> None:
    assert (
        near_fraction(GelSequence(make_appearance("typical", seed=3, **FACTORS[name]), "press", frames=5, period=5))
        > 0.99
    )


@pytest.mark.parametrize(("markers", "seed"), [(63, 2), (63, 5), (63, 11), (130, 3), (130, 13)])
def test_an_outer_line_with_half_of_its_dots_belongs_to_the_grid(markers: int, seed: int) -> None:
    appearance = make_appearance("typical", markers=markers, seed=seed, missing=0.15)
    frame = next(iter(GelSequence(appearance, frames=1)))
    started = MarkerTracker().start(frame.image)
    assert (started.rows, started.cols) == (appearance.grid.rows, appearance.grid.cols)
    off = np.linalg.norm(started.position - frame.position, axis=1)
    assert started.valid[frame.visible].mean() > 0.95 and not started.valid[~frame.visible].any()
    assert (off < 0.3 * appearance.spacing).all()  # of the missing ones as well


def test_hidden_markers_are_inferred_and_recovered() -> None:
    results = track_sequence(GelSequence(make_appearance("typical", occluders=1), "shear", frames=24, period=30))
    hidden = np.array([~frame.visible for frame, _, _ in results])
    valid, inferred = (np.array([getattr(one, name) for _, one, _ in results]) for name in ("valid", "inferred"))
    quality, spacing = np.array([one.quality for _, one, _ in results]), results[0][1].spacing
    far = np.array([off for _, _, off in results]) > 0.1 * spacing
    assert hidden.sum() > 30 and inferred[hidden].mean() > 0.5  # partly covered dots may still be measured
    assert (far & valid)[hidden].mean() < 0.05 and far[hidden].mean() < 0.1
    assert (valid ^ inferred).all() and not quality[inferred].any() and quality[~hidden].min() > 0.5
    assert valid[-1].all() and not far[-1].any()


def test_jitter_and_drift_at_rest_are_small_and_the_reference_improves() -> None:
    frames = list(GelSequence(make_appearance("typical"), motion="rest", frames=16))
    tracker = MarkerTracker()
    tracker.start(frames[0].image)
    one = tracker.rest
    positions = np.array([tracker.track(frame.image).position for frame in frames[1:]])
    assert np.median(positions.std(axis=0)) < 0.02
    error, finer = (np.linalg.norm(rest - frames[0].position, axis=1).mean() for rest in (one, tracker.rest))
    assert finer < 0.7 * error
    moved = GelSequence(make_appearance("typical"), "shear", frames=64, period=30)
    _, _, off = track_sequence(moved)[-1]
    assert np.median(off) < 0.05


def image_without_markers(kind: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    if kind == "noise":
        return rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    if kind == "soft noise":
        return np.asarray(cv2.GaussianBlur(image_without_markers("noise"), (0, 0), 3))
    image = np.full((240, 320, 3), {"black": 0, "white": 255}.get(kind, 150), dtype=np.uint8)
    for position in rng.integers((0, 0), (320, 240), ({"one dot": 1, "10 000 dots": 10_000}.get(kind, 0), 2)).tolist():
        cv2.circle(image, position, 2, (20, 20, 20), -1)
    return image


@pytest.mark.parametrize("kind", ["noise", "soft noise", "black", "white", "one dot", "10 000 dots"])
def test_images_without_markers_are_rejected_and_tracking_continues(kind: str) -> None:
    image = image_without_markers(kind)
    with pytest.raises(TrackerInitError, match=r"dots detected|same shape|lie between|no regular grid") as error:
        MarkerTracker().start(image)
    assert error.value.picture.shape == image.shape and error.value.picture.dtype == np.uint8
    renderer, still = AccurateGelRenderer(make_appearance("typical")), np.zeros((130, 2))
    tracker = MarkerTracker()
    tracker.start(renderer.render(still).image)
    lost = tracker.track(image)
    assert lost.valid.mean() < 0.1 and np.isfinite(lost.position).all()
    assert np.isnan(lost.displacement[~lost.valid & ~lost.inferred]).all()
    assert tracker.track(renderer.render(still, number=1).image).valid.all()


def test_a_grid_rotated_too_far_is_not_confused_with_its_diagonals() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    for angle, right in ((25, True), (43, False)):
        turn = cv2.getRotationMatrix2D((160, 120), angle, 0.7)
        turned = np.asarray(cv2.warpAffine(image, turn, (320, 240), borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)
        if right:
            assert MarkerTracker().start(turned).valid.all()
        else:
            with pytest.raises(TrackerInitError, match="between the rows and columns"):
                MarkerTracker().start(turned)


def test_values_that_are_no_images_are_rejected() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    wrong = [image.astype(float), image[..., :2], np.dstack([image, image[..., :1]]), image[:0], image.tobytes(), None]
    for value in wrong:
        for use in (MarkerTracker().start, tracker.track):
            with pytest.raises(UsageError, match="expected an image"):
                use(value)  # type: ignore[arg-type]


def test_tiny_images_and_strips_are_rejected() -> None:
    for shape in ((1, 1, 3), (1, 300, 3), (900, 2, 3), (7, 7, 3)):
        with pytest.raises(GelflowError, match="no grid of markers"):
            MarkerTracker().start(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))


def test_grey_images_and_array_views_are_accepted() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    positions = [MarkerTracker().start(one).position for one in (image, np.stack([image, image], axis=1)[:, 0], grey)]
    assert (positions[0] == positions[1]).all() and np.abs(positions[0] - positions[2]).max() < 0.02


def test_the_upper_half_is_tracked_when_the_lower_half_of_an_image_is_missing() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    image[120:] = 128
    tracked = tracker.track(image)
    valid = tracked.valid.reshape(10, 13)
    assert valid[:4].all() and not valid[-4:].any() and (tracked.inferred ^ tracked.valid).all()


def test_rest_positions_require_a_start() -> None:
    with pytest.raises(UsageError, match="no rest positions yet"):
        _ = MarkerTracker().rest
