"""Partly visible grids: the visible rows and columns are detected or given, and no marker is exchanged."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.observation import Grid, flow_map
from gelflow.perception import CameraMount, MarkerTracker, TrackerConfig, fit_calibration, tactile_frame
from gelflow.perception.camera_calibration import CameraCalibration
from gelflow.perception.mount_check import VisiblePart, find_visible_part, start_at_rest, visible_text
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer, RenderedImage
from gelflow.perception.synthetic.appearance import GELSLIM_GRID, PRESETS, DegradedGelAppearance
from gelflow.perception.synthetic.lens import Lens

SCALE = 15.7
STILL = np.zeros((252, 2))


@dataclass(frozen=True)
class View(DegradedGelAppearance):
    """A gel seen through a lens, moved by `shift` [px] and then rotated by `turn` [rad] in the image."""

    lens: Lens = field(default_factory=Lens)
    shift: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0

    def warp(self, positions: np.ndarray) -> np.ndarray:
        middle = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        turned = (np.asarray(positions) + self.shift - middle) @ np.array([[cos, sin], [-sin, cos]]) + middle
        return self.lens.apply(turned, self)


def view(preset: str = "typical", zoom: float = 1.0, grid: Grid = GELSLIM_GRID, **changed: object) -> View:
    scale = 22.0 / grid.pitch * zoom
    size = {"pixels_per_mm": scale, "radius": 0.2 * 22.0 * zoom, "light": 115.0, "grid": grid}
    return View(**{**size, **PRESETS[preset], "barrel": 0.0, **changed})


def shown(appearance: View, number: int = 0) -> tuple[RenderedImage, np.ndarray, np.ndarray]:
    """An image at rest, and positions and visibility of its markers in the order of the image."""
    grid = appearance.grid
    frame = AccurateGelRenderer(appearance).render(np.zeros((grid.rows * grid.cols, 2)), number=number)
    order = CameraMount(grid.rows, grid.cols, grid.pitch, grid.center).marker_order()
    position, visible = np.empty_like(frame.position), np.empty(len(order), dtype=bool)
    position[order], visible[order] = frame.position, frame.visible
    return frame, position.reshape(grid.rows, grid.cols, 2), visible.reshape(grid.rows, grid.cols)


def true_skips(part: VisiblePart, position: np.ndarray) -> tuple[int, int, int, int]:
    """The skipped lines, from the true position of the middle marker."""
    rows, cols = part.shape
    distance = np.linalg.norm(position - part.anchor, axis=-1)
    row, col = (int(k) for k in np.unravel_index(int(distance.argmin()), distance.shape))
    above, left = row - rows // 2, col - cols // 2
    return above, part.rows - rows - above, left, part.cols - cols - left


def random_view(rng: np.random.Generator) -> View:
    grid = [GELSLIM_GRID, Grid(10, 13, 1.4), Grid(9, 7, 2.6), Grid(14, 11, 1.8)][rng.integers(4)]
    tilt, distance = rng.uniform(-8, 8, 2), rng.uniform(25, 45)
    return view(
        ["typical", "hard"][rng.integers(2)],
        rng.uniform(0.9, 1.3),
        grid,
        lens=Lens((tilt[0], tilt[1]), distance, rng.uniform(-0.06, 0.06)),
        shift=tuple(rng.uniform(-0.2, 0.2, 2) * (320, 427) * (rng.random(2) < 0.6)),
        width=int((grid.cols + 1) * 22.0),
        height=int((grid.rows + 1) * 22.0),
        noise=rng.choice([1.5, 4.0]),
        seed=int(rng.integers(9)),
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_visible_lines_are_found_or_listed_and_no_marker_is_exchanged(seed: int) -> None:
    rng = np.random.default_rng(seed)
    appearance = random_view(rng)
    frame, position, visible = shown(appearance)
    grid = appearance.grid
    parts = find_visible_part(frame.image, grid.rows, grid.cols, either_way=False)
    true = true_skips(parts[0], position)
    assert true in [part.skipped for part in parts]
    part = next(part for part in parts if part.skipped == true)
    (first_row, last_row), (first_col, last_col) = part.lines
    window = slice(first_row - 1, last_row), slice(first_col - 1, last_col)
    assert visible[window].sum() > 0.85 * visible.sum()
    # The gel moves by up to half a millimetre before the next reference, and cameras without calibration may refuse.
    moved = rng.uniform(-0.3, 0.3, 2) * appearance.spacing + appearance.shift
    for anchor in (part.anchor, None):
        for number, shift in enumerate((appearance.shift, (moved[0], moved[1]))):
            image, now, seen = shown(replace(appearance, shift=shift), number)
            try:
                first = MarkerTracker(replace(part.tracker_config(), anchor=anchor)).start(image.image)
            except GelflowError:
                assert anchor is None or number == 1
                continue
            error = np.linalg.norm(first.position - now[window].reshape(-1, 2), axis=1)
            assert (error[first.valid] < 0.15 * first.spacing).all()
            assert first.valid.sum() > 0.85 * seen[window].sum()


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize(("degrees", "zoom"), [(4.0, 1.1), (8.0, 1.0), (14.0, 1.0)])
def test_grids_whose_corners_are_outside_the_image_are_measured(degrees: float, zoom: float, *, given: bool) -> None:
    turned = view(zoom=zoom, turn=np.radians(degrees))
    frame, position, visible = shown(turned)
    first = MarkerTracker(TrackerConfig(18, 14, False) if given else TrackerConfig()).start(frame.image)
    assert first.valid.sum() > 0.85 * visible.sum() and not first.valid.all()
    distance = np.linalg.norm(first.position[first.valid][:, None] - position.reshape(-1, 2), axis=2)
    assert distance.min(1).max() < 0.15 * first.spacing


@pytest.mark.parametrize("shift", [0.5, 1.0, -1.0])
def test_a_grid_that_moved_by_half_a_spacing_or_more_is_refused_with_a_calibration(shift: float) -> None:
    appearance = view(shift=(50.0, 0.0))  # two columns outside on the right
    frame, *_ = shown(appearance)
    (part,) = find_visible_part(frame.image, 18, 14, either_way=False)
    assert part.lines == ((1, 18), (1, 12))
    moved, *_ = shown(replace(appearance, shift=(50.0 + shift * appearance.spacing, 0.0)))
    with pytest.raises(GelflowError, match=r"calibrate the camera again|said to be outside"):
        MarkerTracker(part.tracker_config()).start(moved.image)


def test_without_a_calibration_the_image_must_show_the_end_of_the_grid() -> None:
    (part,) = find_visible_part(shown(view(shift=(50.0, 0.0)))[0].image, 18, 14, either_way=False)
    told = replace(part.tracker_config(), anchor=None)
    assert MarkerTracker(told).start(shown(view(shift=(53.0, 0.0)))[0].image).cols == 12
    near = shown(view(zoom=1.15, height=500, shift=(10.0, 0.0)))[0].image  # the border cuts columns off on both sides
    with pytest.raises(GelflowError, match="cannot be told apart"):
        MarkerTracker(TrackerConfig(18, 13, False, skipped=(0, 0, 0, 1))).start(near)


def calibrated(appearance: View) -> tuple[CameraCalibration, VisiblePart, RenderedImage]:
    frame, *_ = shown(appearance)
    parts = find_visible_part(frame.image, 18, 14, either_way=False)
    tracker = MarkerTracker(parts[0].tracker_config())
    first = tracker.start(frame.image)
    size = (appearance.width, appearance.height)
    fit = fit_calibration(tracker.rest, first.valid, rows=first.rows, cols=first.cols, spacing_mm=1.4, size=size)
    return replace(fit, skipped=parts[0].skipped), parts[0], frame


def test_frames_of_a_calibrated_partial_view_have_the_shape_of_the_whole_grid() -> None:
    appearance = view(shift=(-55.0, 40.0), lens=Lens((8.0, -8.0), 30.0, 0.06))
    calibration, part, frame = calibrated(appearance)
    mount = CameraMount(calibration=calibration)
    # Mirrored, so the left columns of the image are those at large y.
    assert mount.skipped == part.skipped == calibration.skipped and part.lines[1][0] > 1
    rest = start_at_rest(mount, frame.image)
    rows, cols = mount.pad_lines(mount.skipped)
    count = mount.image_grid[0] * mount.image_grid[1]
    assert visible_text(mount, rest).endswith(f"rows 1-{rows[1]} of 18, columns 1-{cols[1]} of 14")
    assert mount.visible_count == count < 252 and cols[1] < 14
    pad = tactile_frame([rest], [mount], stamp=0.0)
    assert pad.shear.shape == (1, 252, 2) and pad.grid == Grid(18, 14, 1.4, (2.0, 0.0))
    seen = pad.valid.reshape(18, 14)
    assert seen.sum() > 0.98 * frame.visible.sum() and not seen[rows[1] :].any() and not seen[:, cols[1] :].any()
    assert np.isnan(pad.shear[~pad.valid]).all()
    assert np.isfinite(flow_map([pad], pad, grid=Grid(13, 10, 1.9, (2.0, 0.0))).image).all()


def test_displacements_of_a_tilted_view_through_a_lens_are_within_5_percent() -> None:
    for seed, tilt, barrel in ((0, (8.0, 0.0), 0.06), (1, (-8.0, 8.0), -0.06), (2, (0.0, -8.0), 0.06)):
        appearance = view(shift=(12.0 * seed, 0.0), lens=Lens(tilt, 30.0, barrel), seed=seed)
        calibration, _, frame = calibrated(appearance)
        mount = CameraMount(calibration=calibration)
        tracker = MarkerTracker(mount.tracker_config())
        tracker.start(frame.image)
        renderer, rest = AccurateGelRenderer(appearance), appearance.positions_mm()
        for number, direction in enumerate(((0.5, 0.0), (0.0, 0.5), (-0.4, 0.3)), start=1):
            x, y = ((rest - (2.0, 0.0)) / 12).T
            moved = np.array(direction) * (1 + 0.3 * x - 0.2 * y)[:, None]  # [mm]
            tracked = tracker.track(renderer.render(moved, number=number).image)
            pad = tactile_frame([tracked], [mount], stamp=0.0)
            error = np.linalg.norm(pad.shear[0] - moved, axis=1) / np.linalg.norm(moved, axis=1)
            assert pad.valid.sum() > 0.95 * mount.visible_count
            assert np.quantile(error[pad.valid[0]], 0.99) < 0.05 and np.nanmedian(error) < 0.02


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [True, False])
def test_told_lines_are_mapped_to_the_pad_in_every_orientation(rotation: int, mirrored: bool) -> None:
    width, height = (320, 427) if rotation in (0, 180) else (427, 320)
    mount = CameraMount(
        rotation=rotation,  # type: ignore[arg-type]
        mirrored=mirrored,
        pixels_per_mm=22.0 / 1.4,
        visible_rows=(1, 15),
        visible_cols=(3, 14),
    )
    above, below, left, right = mount.skipped
    assert sorted(mount.skipped) == [0, 0, 2, 3] and mount.pad_lines(mount.skipped) == ((1, 15), (3, 14))
    outside = {0: 0.0, 2: 50.0, 3: 78.0}  # [px] that move so many lines out of the image
    shift = (outside[right] - outside[left], outside[below] - outside[above])
    appearance = view(width=width, height=height, rotation=rotation, mirrored=mirrored, shift=shift)
    renderer, tracker = AccurateGelRenderer(appearance), MarkerTracker(mount.tracker_config())
    x, y = appearance.positions_mm().T
    moved = np.stack([0.3 + 0.02 * y, -0.1 + 0.01 * x], axis=1)
    tracker.start(renderer.render(STILL).image)
    frame = tactile_frame([tracker.track(renderer.render(moved, number=1).image)], [mount], stamp=0.0)
    seen = frame.valid[0].reshape(18, 14)
    assert seen[:15, 2:].mean() > 0.95 and not seen[15:].any() and not seen[:, :2].any()
    assert np.nanmax(np.abs(frame.shear[0] - moved)) < 0.03


def test_the_error_of_preflight_names_the_lines_to_write() -> None:
    frame, *_ = shown(view(shift=(50.0, 0.0)))
    with pytest.raises(PeerError, match=r"write visible_rows = \[1, 18\] and visible_cols = \[3, 14\] in the lab file"):
        start_at_rest(CameraMount(pixels_per_mm=SCALE), frame.image)
    assert start_at_rest(CameraMount(pixels_per_mm=SCALE, visible_cols=(3, 14)), frame.image).cols == 12
    near, *_ = shown(view(zoom=1.2))
    with pytest.raises(PeerError, match=r"does not show which lines .* visible_cols = \[2, 13\], or "):
        start_at_rest(CameraMount(pixels_per_mm=1.2 * SCALE), near.image)
    with pytest.raises(PeerError, match="shows 90 of 252 markers, at least 40% are required"):
        start_at_rest(CameraMount(pixels_per_mm=SCALE, visible_rows=(1, 9), visible_cols=(5, 14)), frame.image)
    with pytest.raises(PeerError, match="which is no part of 12 rows of 9"):
        start_at_rest(CameraMount(12, 9, pixels_per_mm=SCALE), frame.image)


def test_a_mount_refuses_lines_that_do_not_exist_and_other_calibrations() -> None:
    for lines in ((0, 5), (1, 2), (5, 3), (1, 19)):
        with pytest.raises(UsageError, match="visible_rows must name the first and the last"):
            CameraMount(visible_rows=lines)
    with pytest.raises(UsageError, match="beyond two opposite borders of the image needs a calibration"):
        CameraMount(pixels_per_mm=SCALE, visible_rows=(2, 17))
    calibration, _, _ = calibrated(view(shift=(50.0, 0.0)))
    assert CameraMount(calibration=calibration).pad_lines(calibration.skipped) == ((1, 18), (3, 14))
    with pytest.raises(UsageError, match="calibrate with --rows 18 --cols 14"):
        CameraMount(calibration=replace(calibration, skipped=(0, 0, 0, 0)))


def test_a_line_of_dirt_does_not_replace_a_missing_line() -> None:
    frame, *_ = shown(view(shift=(0.0, -40.0)))  # the upper row is outside
    image = frame.image.copy()
    bottom = shown(view(shift=(0.0, -40.0)))[1][-1]
    step = bottom - shown(view(shift=(0.0, -40.0)))[1][-2]
    for right, down in (bottom + step)[[3, 9]].round().astype(int):
        image[down - 4 : down + 5, right - 4 : right + 5] = 20
    with pytest.raises(GelflowError, match="correct"):
        MarkerTracker(TrackerConfig(18, 14, False)).start(image)
