"""Markers in rendered gel images, against where they were drawn."""

import numpy as np
import pytest

from gelflow.errors import PeerError, UsageError
from gelflow.hardware_mocks.gel import GelLook, GelRenderer
from gelflow.observation import Grid
from gelflow.perception.frames import CameraMount, decode, tactile_frame
from gelflow.perception.tracker import MarkerTracker, StartRefused, TrackerConfig

MOUNT = CameraMount(pixels_per_mm=15.7)
SPACING = 1.4  # [mm]


def press(rest: np.ndarray, rng: np.random.Generator, largest: float) -> np.ndarray:
    """A smooth patch of displacement [mm] at a random place, `largest` at its centre."""
    centre = rng.uniform((-4, -6), (8, 6))
    angle = rng.uniform(0, 2 * np.pi)
    bump = np.exp(-((rest - centre) ** 2).sum(1) / (2 * rng.uniform(3, 7) ** 2))
    field: np.ndarray = bump[:, None] * largest * np.array([np.cos(angle), np.sin(angle)])
    return field


def follow(look: GelLook, fields: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Endpoint errors [px] of the valid markers and the valid flags, for each field after the one at rest."""
    renderer, mount = GelRenderer(look), CameraMount(mirrored=look.mirrored, pixels_per_mm=look.pixels_per_mm)
    tracker = MarkerTracker(mount.tracker_config())
    tracker.start(decode(renderer.encode(renderer.render(np.zeros_like(fields[0])))))
    results = []
    for number, field in enumerate(fields, start=1):
        tracked = tracker.track(decode(renderer.encode(renderer.render(field, sequence=number))))
        frame = tactile_frame([tracked], [mount], stamp=0.0)
        valid = frame.valid[0]
        error = np.linalg.norm(frame.shear[0][valid] - field[valid], axis=1) * look.pixels_per_mm
        results.append((error, valid))
    return results


@pytest.mark.parametrize("bright", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.05])
def test_markers_that_jump_half_a_spacing_are_found_to_a_tenth_of_a_pixel(missing: float, bright: bool) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        look = GelLook(seed=seed, missing=missing, bright=bright)
        rest = look.positions_mm()
        # Each patch begins and ends within one image: between images markers move by up to half the spacing.
        fields = [press(rest, rng, 0.5 * SPACING) if k % 2 else np.zeros_like(rest) for k in range(1, 9)]
        for error, valid in follow(look, fields):
            assert valid.sum() == round((1 - missing) * valid.size)
            assert np.median(error) < 0.1
            assert error.max() < 0.5  # nobody is taken for a neighbour


def test_a_common_shift_of_nearly_half_a_spacing_is_not_taken_for_the_opposite_one() -> None:
    look = GelLook(seed=4, missing=0.05)
    shifts = [np.tile(np.array(s) * SPACING, (252, 1)) for s in ((0.45, 0), (0, 0.0), (0.3, -0.3), (-0.1, 0.1))]
    for error, valid in follow(look, shifts):
        assert valid.mean() > 0.93 and error.max() < 0.5


def test_noise_blur_and_weak_contrast_do_not_break_it() -> None:
    rng = np.random.default_rng(0)
    for look in (GelLook(noise=5.0), GelLook(blur=2.2), GelLook(contrast=0.3, colour=0.8), GelLook(light=60.0)):
        for error, valid in follow(look, [press(look.positions_mm(), rng, 0.5)]):
            assert valid.mean() > 0.98 and np.median(error) < 0.15 and error.max() < 1.0


def test_other_numbers_of_lines_are_found_without_being_told() -> None:
    look = GelLook(grid=Grid(rows=10, cols=7, pitch=2.6), radius=6.0)
    renderer = GelRenderer(look)
    tracked = MarkerTracker().start(renderer.render(np.zeros((70, 2))))
    assert (tracked.rows, tracked.cols) == (10, 7) and tracked.valid.all()
    assert np.abs(tracked.spacing - 2.6 * look.pixels_per_mm) < 0.5


def test_the_same_images_give_the_same_numbers() -> None:
    renderer = GelRenderer(GelLook(missing=0.05))
    rng = np.random.default_rng(1)
    data = [renderer.encode(renderer.render(rng.normal(0, 0.1, (252, 2)), sequence=k)) for k in range(4)]
    runs = []
    for _ in range(2):
        tracker = MarkerTracker(MOUNT.tracker_config())
        runs.append([tracker.track(decode(d)) for d in data])
    for a, b in zip(*runs, strict=True):
        assert a.position.tobytes() == b.position.tobytes()
        assert a.displacement.tobytes() == b.displacement.tobytes() and (a.valid == b.valid).all()


def test_another_start_takes_a_new_reference() -> None:
    renderer = GelRenderer()
    moved = renderer.render(np.full((252, 2), 0.3))
    tracker = MarkerTracker()
    tracker.track(renderer.render(np.zeros((252, 2))))
    assert np.nanmedian(np.abs(tracker.track(moved).displacement)) > 4
    assert not tracker.start(moved).displacement.any()


def test_a_covered_marker_is_invalid_and_comes_back() -> None:
    renderer = GelRenderer()
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
    renderer = GelRenderer()
    field = np.zeros((252, 2))
    field[100], field[101] = (0, 0.55), (0, -0.55)  # neighbours in a row meet
    tracker = MarkerTracker(MOUNT.tracker_config())
    tracker.start(renderer.render(np.zeros((252, 2))))
    tracked = tracker.track(renderer.render(field))
    frame = tactile_frame([tracked], [MOUNT], stamp=0.0)
    assert not frame.valid[0, [100, 101]].any()
    assert frame.valid[0].sum() >= 248


def test_it_recovers_after_blank_images() -> None:
    renderer = GelRenderer()
    tracker = MarkerTracker(MOUNT.tracker_config())
    tracker.start(renderer.render(np.zeros((252, 2))))
    for _ in range(3):
        assert not tracker.track(np.full((427, 320, 3), 90, dtype=np.uint8)).valid.any()
    field = np.tile([0.5, 0.2], (252, 1))
    tracked = tracker.track(renderer.render(field))
    frame = tactile_frame([tracked], [MOUNT], stamp=0.0)
    assert frame.valid.all() and np.abs(frame.shear[0] - field).max() < 0.02


@pytest.mark.parametrize(
    "image",
    [np.full((240, 320, 3), 120), np.random.default_rng(0).integers(0, 255, (240, 320, 3))],
    ids=["blank", "noise"],
)
def test_an_image_without_markers_is_refused(image: np.ndarray) -> None:
    with pytest.raises(StartRefused, match=r"no .*grid of markers found"):
        MarkerTracker().start(image.astype(np.uint8))


@pytest.mark.parametrize(("rows", "cols"), [(17, 14), (19, 14), (14, 18), (10, 7)])
def test_wrong_rows_and_columns_are_refused(rows: int, cols: int) -> None:
    image = GelRenderer().render(np.zeros((252, 2)))
    with pytest.raises(StartRefused, match="18 lines of 14 whole markers"):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols, either_way=False)).start(image)


def test_rows_and_columns_may_be_turned_unless_forbidden() -> None:
    image = GelRenderer().render(np.zeros((252, 2)))
    tracked = MarkerTracker(TrackerConfig(rows=14, cols=18)).start(image)
    assert (tracked.rows, tracked.cols) == (18, 14)


@pytest.mark.parametrize(("rows", "cols"), [(18, None), (2, 14), (18, 1000)])
def test_impossible_numbers_are_refused(rows: int, cols: int | None) -> None:
    with pytest.raises(UsageError):
        MarkerTracker(TrackerConfig(rows=rows, cols=cols)).start(GelRenderer().render(np.zeros((252, 2))))


def test_an_image_of_another_size_is_refused() -> None:
    image = GelRenderer().render(np.zeros((252, 2)))
    tracker = MarkerTracker()
    tracker.start(image)
    with pytest.raises(PeerError, match="320 × 427 px to 320 × 400 px"):
        tracker.track(image[:400])
