"""Markers in rendered gel images, against where they were drawn."""

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
    """A smooth patch of displacement [mm] at a random place, `largest` at its centre."""
    centre = rng.uniform((-4, -6), (8, 6))
    angle = rng.uniform(0, 2 * np.pi)
    bump = np.exp(-((rest - centre) ** 2).sum(1) / (2 * rng.uniform(3, 7) ** 2))
    field: np.ndarray = bump[:, None] * largest * np.array([np.cos(angle), np.sin(angle)])
    return field


def follow(appearance: GelAppearance, fields: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Endpoint errors [px] of the valid markers and the valid flags, for each field after the one at rest."""
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
def test_markers_that_jump_half_a_spacing_are_found_to_a_tenth_of_a_pixel(missing: float, bright: bool) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        appearance = GelAppearance(seed=seed, missing=missing, bright=bright)
        rest = appearance.positions_mm()
        # Each patch begins and ends within one image: between images markers move by up to half the spacing.
        fields = [press(rest, rng, 0.5 * SPACING) if k % 2 else np.zeros_like(rest) for k in range(1, 9)]
        for error, valid in follow(appearance, fields):
            assert valid.sum() == round((1 - missing) * valid.size)
            assert np.median(error) < 0.1
            assert error.max() < 0.5  # nobody is taken for a neighbour


def test_a_common_shift_of_nearly_half_a_spacing_is_not_taken_for_the_opposite_one() -> None:
    appearance = GelAppearance(seed=4, missing=0.05)
    shifts = [np.tile(np.array(s) * SPACING, (252, 1)) for s in ((0.45, 0), (0, 0.0), (0.3, -0.3), (-0.1, 0.1))]
    for error, valid in follow(appearance, shifts):
        assert valid.mean() > 0.93 and error.max() < 0.5


def test_noise_blur_and_weak_contrast_do_not_break_it() -> None:
    rng = np.random.default_rng(0)
    for appearance in (
        GelAppearance(noise=5.0),
        GelAppearance(blur=2.2),
        GelAppearance(contrast=0.3, colour=0.8),
        GelAppearance(light=60.0),
    ):
        for error, valid in follow(appearance, [press(appearance.positions_mm(), rng, 0.5)]):
            assert valid.mean() > 0.98 and np.median(error) < 0.15 and error.max() < 1.0


def test_other_numbers_of_lines_are_found_without_being_told() -> None:
    appearance = GelAppearance(grid=Grid(rows=10, cols=7, pitch=2.6), radius=6.0)
    renderer = FastGelRenderer(appearance)
    tracked = MarkerTracker().start(renderer.render(np.zeros((70, 2))))
    assert (tracked.rows, tracked.cols) == (10, 7) and tracked.valid.all()
    assert np.abs(tracked.spacing - 2.6 * appearance.pixels_per_mm) < 0.5


def test_the_same_images_give_the_same_numbers() -> None:
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


def test_another_start_takes_a_new_reference() -> None:
    renderer = FastGelRenderer()
    moved = renderer.render(np.full((252, 2), 0.3))
    tracker = MarkerTracker()
    tracker.track(renderer.render(np.zeros((252, 2))))
    assert np.nanmedian(np.abs(tracker.track(moved).displacement)) > 4
    assert not tracker.start(moved).displacement.any()


def test_a_covered_marker_is_invalid_and_comes_back() -> None:
    renderer = FastGelRenderer()
    rest = renderer.render(np.zeros((252, 2)))
    tracker = MarkerTracker(MOUNT.tracker_config())
    first = tracker.start(rest)
    covered = rest.copy()
    place = first.position[100]
    right, down = place.round().astype(int)
    covered[down - 8 : down + 9, right - 8 : right + 9] = covered[down - 10, right - 10]
    lost = tracker.track(covered)
    assert np.flatnonzero(~lost.valid).tolist() == [100]
    assert np.flatnonzero(lost.inferred).tolist() == [100] and lost.quality[100] == 0
    assert np.linalg.norm(lost.position[100] - place) < 0.5  # expected where its neighbours say
    back = tracker.track(rest)
    assert back.valid.all() and np.linalg.norm(back.displacement[100]) < 0.1


def test_two_merged_markers_are_not_believed() -> None:
    renderer = FastGelRenderer()
    field = np.zeros((252, 2))
    field[100], field[101] = (0, 0.55), (0, -0.55)  # neighbours in a row meet
    tracker = MarkerTracker(MOUNT.tracker_config())
    tracker.start(renderer.render(np.zeros((252, 2))))
    tracked = tracker.track(renderer.render(field))
    frame = tactile_frame([tracked], [MOUNT], stamp=0.0)
    assert not frame.valid[0, [100, 101]].any()
    assert frame.valid[0].sum() >= 248


def test_it_recovers_after_blank_images() -> None:
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
def test_wrong_rows_and_columns_are_refused(rows: int, cols: int) -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    with pytest.raises(TrackerInitError, match="18 rows of 14 entire markers"):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols, either_way=False)).start(image)


def test_rows_and_columns_may_be_turned_unless_forbidden() -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    tracked = MarkerTracker(TrackerConfig(rows=14, cols=18)).start(image)
    assert (tracked.rows, tracked.cols) == (18, 14)


@pytest.mark.parametrize(("rows", "cols"), [(18, None), (2, 14), (18, 1000)])
def test_impossible_numbers_are_refused(rows: int, cols: int | None) -> None:
    with pytest.raises(UsageError):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols)).start(FastGelRenderer().render(np.zeros((252, 2))))


def test_an_image_of_another_size_is_refused() -> None:
    image = FastGelRenderer().render(np.zeros((252, 2)))
    tracker = MarkerTracker()
    tracker.start(image)
    with pytest.raises(PeerError, match="320 × 427 px to 320 × 400 px"):
        tracker.track(image[:400])


def through(sequence: GelSequence) -> list[tuple[RenderedImage, TrackingResult, np.ndarray]]:
    """For each image after the first: the truth, what was tracked, and how far the displacements are off [px]."""
    tracker, frames = MarkerTracker(), list(sequence)
    first = tracker.start(frames[0].image)
    assert (first.rows, first.cols) == (sequence.appearance.grid.rows, sequence.appearance.grid.cols)
    results = []
    for frame in frames[1:]:
        tracked = tracker.track(frame.image)
        off = np.linalg.norm(tracked.displacement - (frame.position - frames[0].position), axis=1)
        results.append((frame, tracked, off))
    return results


def near(sequence: GelSequence) -> float:
    """Share of the visible markers that are said to be within 0.1 spacing of where they are."""
    return float(
        np.mean(np.concatenate([off[f.visible] for f, _, off in through(sequence)]) < 0.1 * sequence.appearance.spacing)
    )


@pytest.mark.parametrize(
    ("preset", "median", "high"), [("clean", 0.02, 0.04), ("typical", 0.03, 0.06), ("hard", 0.08, 0.5)]
)
def test_errors_are_near_what_noise_allows(preset: str, median: float, high: float) -> None:
    results = through(GelSequence(make_appearance(preset, seed=1), "twist", frames=10, period=12))
    errors = np.concatenate([off[tracked.valid & frame.visible] for frame, tracked, off in results])
    assert np.median(errors) < median and np.quantile(errors, 0.95) < high
    assert np.mean([tracked.valid[frame.visible].mean() for frame, tracked, _ in results]) > 0.98


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("changed", [{}, {"missing": 0.05, "bridges": 2}, {"cut_row": True, "markers": 63}])
def test_a_jump_by_most_of_a_spacing_exchanges_no_marker(field: Field, changed: dict[str, float]) -> None:
    appearance = make_appearance("typical", seed=2, **changed)  # type: ignore[arg-type]
    for frame, tracked, off in through(GelSequence(appearance, field, frames=5, motion="jump", peak=0.7)):
        assert tracked.valid[frame.visible].mean() > 0.99
        assert (off[tracked.valid] < 0.1 * appearance.spacing).all()


def test_a_whole_grid_that_jumps_back_and_forth_is_told_from_its_neighbouring_line() -> None:
    appearance = make_appearance("typical", cut_row=True)
    renderer, tracker, still = AccurateGelRenderer(appearance), MarkerTracker(), np.zeros((130, 2))
    rest = renderer.render(still).position
    tracker.start(renderer.render(still).image)
    for number, way in enumerate([(0.7, 0.0), (0.0, 0.0), (-0.5, 0.4), (-0.1, -0.1)], start=1):
        frame = renderer.render(still + np.array(way) * appearance.grid.pitch, number=number)
        tracked = tracker.track(frame.image)
        assert tracked.valid.all() and np.abs(tracked.displacement - (frame.position - rest)).max() < 0.5


@pytest.mark.parametrize("name", FACTORS)
def test_every_kind_of_image_is_tracked_without_being_told(name: str) -> None:
    assert near(GelSequence(make_appearance("typical", seed=3, **FACTORS[name]), "press", frames=5, period=5)) > 0.99


def test_what_is_hidden_is_guessed_and_found_again() -> None:
    results = through(GelSequence(make_appearance("typical", occluders=1), "shear", frames=24, period=30))
    hidden = np.array([~frame.visible for frame, _, _ in results])
    valid, inferred = (np.array([getattr(one, name) for _, one, _ in results]) for name in ("valid", "inferred"))
    quality, spacing = np.array([one.quality for _, one, _ in results]), results[0][1].spacing
    far = np.array([off for _, _, off in results]) > 0.1 * spacing
    assert hidden.sum() > 30 and inferred[hidden].mean() > 0.5  # of many a dot enough is seen to measure it
    assert (far & valid)[hidden].mean() < 0.05 and far[hidden].mean() < 0.1
    assert (valid ^ inferred).all() and not quality[inferred].any() and quality[~hidden].min() > 0.5
    assert valid[-1].all() and not far[-1].any()


def test_at_rest_nothing_jitters_or_drifts_and_the_reference_gets_finer() -> None:
    frames = list(GelSequence(make_appearance("typical"), motion="rest", frames=16))
    tracker = MarkerTracker()
    tracker.start(frames[0].image)
    one = tracker.rest
    places = np.array([tracker.track(frame.image).position for frame in frames[1:]])
    assert np.median(places.std(axis=0)) < 0.02
    error, finer = (np.linalg.norm(rest - frames[0].position, axis=1).mean() for rest in (one, tracker.rest))
    assert finer < 0.7 * error
    moved = GelSequence(make_appearance("typical"), "shear", frames=64, period=30)
    _, _, off = through(moved)[-1]
    assert np.median(off) < 0.05


def garbage(kind: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    if kind == "noise":
        return rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    if kind == "soft noise":
        return np.asarray(cv2.GaussianBlur(garbage("noise"), (0, 0), 3))
    image = np.full((240, 320, 3), {"black": 0, "white": 255}.get(kind, 150), dtype=np.uint8)
    for place in rng.integers((0, 0), (320, 240), ({"one dot": 1, "10 000 dots": 10_000}.get(kind, 0), 2)).tolist():
        cv2.circle(image, place, 2, (20, 20, 20), -1)
    return image


@pytest.mark.parametrize("kind", ["noise", "soft noise", "black", "white", "one dot", "10 000 dots"])
def test_an_image_without_markers_is_refused_and_does_no_harm(kind: str) -> None:
    image = garbage(kind)
    with pytest.raises(TrackerInitError, match=r"dots detected|same shape|lie between|no regular grid") as refusal:
        MarkerTracker().start(image)
    assert refusal.value.picture.shape == image.shape and refusal.value.picture.dtype == np.uint8
    renderer, still = AccurateGelRenderer(make_appearance("typical")), np.zeros((130, 2))
    tracker = MarkerTracker()
    tracker.start(renderer.render(still).image)
    lost = tracker.track(image)
    assert lost.valid.mean() < 0.1 and np.isfinite(lost.position).all()
    assert np.isnan(lost.displacement[~lost.valid & ~lost.inferred]).all()
    assert tracker.track(renderer.render(still, number=1).image).valid.all()


def test_a_grid_turned_too_far_is_not_taken_for_one_of_its_diagonals() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    for angle, right in ((25, True), (43, False)):
        turn = cv2.getRotationMatrix2D((160, 120), angle, 0.7)
        turned = np.asarray(cv2.warpAffine(image, turn, (320, 240), borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)
        if right:
            assert MarkerTracker().start(turned).valid.all()
        else:
            with pytest.raises(TrackerInitError, match="between the rows and columns"):
                MarkerTracker().start(turned)


def test_what_is_no_image_is_refused() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    wrong = [image.astype(float), image[..., :2], np.dstack([image, image[..., :1]]), image[:0], image.tobytes(), None]
    for thing in wrong:
        for use in (MarkerTracker().start, tracker.track):
            with pytest.raises(UsageError, match="expected an image"):
                use(thing)  # type: ignore[arg-type]


def test_size_one_images_and_strips_are_refused() -> None:
    for shape in ((1, 1, 3), (1, 300, 3), (900, 2, 3), (7, 7, 3)):
        with pytest.raises(GelflowError, match="no grid of markers"):
            MarkerTracker().start(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))


def test_grey_images_and_views_are_images_too() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    places = [MarkerTracker().start(one).position for one in (image, np.stack([image, image], axis=1)[:, 0], grey)]
    assert (places[0] == places[1]).all() and np.abs(places[0] - places[2]).max() < 0.02


def test_of_an_image_whose_lower_half_did_not_arrive_the_upper_one_is_tracked() -> None:
    image = AccurateGelRenderer(make_appearance("typical")).render(np.zeros((130, 2))).image
    tracker = MarkerTracker()
    tracker.start(image)
    image[120:] = 128
    tracked = tracker.track(image)
    valid = tracked.valid.reshape(10, 13)
    assert valid[:4].all() and not valid[-4:].any() and (tracked.inferred ^ tracked.valid).all()


def test_before_the_start_there_is_no_rest() -> None:
    with pytest.raises(UsageError, match="no rest positions yet"):
        _ = MarkerTracker().rest
