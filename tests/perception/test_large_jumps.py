"""Jumps by most of the spacing, as after dropped images, and single markers that move in the first images."""

import numpy as np
import pytest

from gelflow.perception import MarkerTracker

SPACING, RADIUS, MARGIN = 20.0, 4.5, 9.0  # of the dots [px]; MARGIN: from the centres of the outer dots to the border


def grid(rows: int, cols: int) -> np.ndarray:
    """Centres of a grid that fills its image up to MARGIN [px], shape (rows · cols, 2)."""
    v, u = np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij")
    return MARGIN + SPACING * np.stack([u, v], axis=-1).reshape(-1, 2)


def draw(centers: np.ndarray, rows: int, cols: int, *, seed: int = 0) -> np.ndarray:
    """An image of dark discs with blurred edges and noise; discs outside the image are not visible."""
    width, height = (int(2 * MARGIN + SPACING * (n - 1)) + 1 for n in (cols, rows))
    plane = np.full((height, width), 150.0)
    reach = int(RADIUS + 4)
    for x, y in centers:
        u, v = np.arange(int(x) - reach, int(x) + reach + 2), np.arange(int(y) - reach, int(y) + reach + 2)
        u, v = u[(u >= 0) & (u < width)], v[(v >= 0) & (v < height)]
        far = np.hypot(u[None, :] - x, v[:, None] - y)
        plane[v[:, None], u[None, :]] -= 90 / (1 + np.exp((far - RADIUS) / 0.35))
    noise = np.random.default_rng(seed).normal(0, 1.0, (height, width, 3))
    return (plane[..., None] + noise).clip(0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("shift", [(0.8, 0.0), (-0.8, 0.0), (0.0, 0.8), (0.0, -0.8), (0.6, 0.0), (0.6, -0.6)])
@pytest.mark.parametrize(("rows", "cols"), [(7, 9), (10, 13), (14, 18)])
def test_a_jump_that_moves_an_outer_line_out_of_the_image_exchanges_no_marker(
    rows: int, cols: int, shift: tuple[float, float]
) -> None:
    """All markers near the dots of their neighbours, and one line without dots, would explain the image as well."""
    rest = grid(rows, cols)
    tracker = MarkerTracker()
    assert tracker.start(draw(rest, rows, cols)).valid.all()
    for number, share in enumerate([1.0, 0.0], start=1):
        truth = rest + share * SPACING * np.array(shift)
        tracked = tracker.track(draw(truth, rows, cols, seed=number))
        off = np.linalg.norm(tracked.position - truth, axis=1)
        assert tracked.valid.mean() > 0.7 and off[tracked.valid].max() < 1.0
    assert tracked.valid.all()


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("columns", [True, False])
def test_a_covered_outer_line_exchanges_no_marker(columns: bool, side: int) -> None:
    """Its dots, and a shift that moves the opposite line out of the image, would explain the image as well."""
    rows, cols = 10, 13
    rest = grid(rows, cols)
    tracker = MarkerTracker()
    tracker.start(draw(rest, rows, cols))
    lines = np.arange(rows * cols).reshape(rows, cols)
    covered = (lines[:, -side] if columns else lines[-side]).tolist()
    for number in range(1, 13):
        visible = np.delete(rest, covered if number > 1 else [], axis=0)
        tracked = tracker.track(draw(visible, rows, cols, seed=number))
        off = np.linalg.norm(tracked.position - rest, axis=1)
        assert tracked.valid.sum() >= rows * cols - len(covered) and off[tracked.valid].max() < 1.0


def test_a_jump_after_a_dark_image_exchanges_no_marker() -> None:
    rest = grid(10, 13)
    tracker = MarkerTracker()
    tracker.start(draw(rest, 10, 13))
    tracker.track(draw(rest[:0], 10, 13, seed=1))
    truth = rest + np.array([0.8 * SPACING, 0.0])
    tracked = tracker.track(draw(truth, 10, 13, seed=2))
    off = np.linalg.norm(tracked.position - truth, axis=1)
    assert tracked.valid.mean() > 0.9 and off[tracked.valid].max() < 1.0


@pytest.mark.parametrize("shift", [0.7, 0.8, 0.9])
def test_a_jump_of_a_grid_of_many_lines_exchanges_no_marker(shift: float) -> None:
    rest = grid(40, 40)
    tracker = MarkerTracker()
    tracker.start(draw(rest, 40, 40))
    tracked = tracker.track(draw(rest + np.array([shift * SPACING, 0.0]), 40, 40, seed=1))
    off = np.linalg.norm(tracked.position - rest - np.array([shift * SPACING, 0.0]), axis=1)
    assert tracked.valid.mean() > 0.9 and off[tracked.valid].max() < 1.0


@pytest.mark.parametrize("moved", [[58], [58, 59]])
def test_a_marker_that_moves_in_the_first_images_keeps_its_rest_position(moved: list[int]) -> None:
    rest = grid(10, 13)
    tracker = MarkerTracker()
    started = tracker.start(draw(rest, 10, 13)).position
    for number in range(1, 8):
        centers = rest.copy()
        centers[moved] += [2.0, 0.0]
        tracker.track(draw(centers, 10, 13, seed=number))
    assert np.abs(tracker.rest - started)[moved].max() < 0.1


def test_a_wrong_marker_does_not_hide_a_common_motion_in_the_first_images() -> None:
    rest = grid(10, 13)
    tracker = MarkerTracker()
    started = tracker.start(draw(rest, 10, 13)).position
    centers = rest + np.array([0.4, 0.0])
    centers[58] += [8.0, 0.0]
    tracker.track(draw(centers, 10, 13, seed=1))
    assert np.median(np.abs(tracker.rest - started)) < 0.05
