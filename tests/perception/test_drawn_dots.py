"""Images of drawn discs: patterns that are not grids, and grids with dots of very different sizes."""

import cv2
import numpy as np
import pytest

from gelflow.perception import MarkerTracker, TrackerInitError

SIZE = (320, 240)
MIDDLE = (160.0, 120.0)


def draw(centers: np.ndarray, radii: np.ndarray, *, bright: bool = False, seed: int = 0) -> np.ndarray:
    """An image of discs, eight times oversampled, with blur and noise."""
    fine, shift, margin = 8, 4, 8  # the blur mixes in what is beyond the image border
    size = (SIZE[0] + 2 * margin, SIZE[1] + 2 * margin)
    plane = np.full((size[1] * fine, size[0] * fine), 60 if bright else 150, dtype=np.uint8)
    at = (centers + margin + 0.5) * fine * 2**shift
    for center, radius in zip(at.round().astype(int).tolist(), radii, strict=True):
        cv2.circle(plane, tuple(center), round(radius * fine * 2**shift), 220 if bright else 60, -1, shift=shift)
    small = cv2.GaussianBlur(cv2.resize(plane, size, interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.8)
    small = small[margin:-margin, margin:-margin]
    noise = np.random.default_rng(seed).normal(0, 1.0, (*small.shape, 3))
    return (small[..., None] + noise).clip(0, 255).round().astype(np.uint8)


def hexagonal(turn: float, *, limit: float | None = None) -> np.ndarray:
    """Centres 22 px apart, each with six neighbours, rotated by `turn` [deg]; inside a circle of `limit` [px]."""
    row, col = (a.reshape(-1) for a in np.meshgrid(np.arange(-20, 21), np.arange(-20, 21), indexing="ij"))
    points = 22 * np.stack([col + 0.5 * (row % 2), row * np.sqrt(3) / 2], axis=1)
    angle = np.deg2rad(turn)
    points = points @ [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    inside = (np.abs(points) < (144, 104)).all(axis=1)
    if limit is not None:
        inside &= np.linalg.norm(points, axis=1) < limit
    return np.asarray(points[inside] + MIDDLE)


def concentric() -> np.ndarray:
    """Five rings of 6, 12, ... dots around one."""
    rings = [np.array(MIDDLE)[None]]
    for ring in range(1, 6):
        angle = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        rings.append(20 * ring * np.stack([np.cos(angle), np.sin(angle)], axis=1) + MIDDLE)
    return np.concatenate(rings)


@pytest.mark.parametrize("bright", [False, True])
@pytest.mark.parametrize("turn", [0.0, 15.0, 30.0, 77.0])
@pytest.mark.parametrize("limit", [None, 100.0])
def test_a_hexagonal_pattern_is_refused_as_such(turn: float, limit: float | None, bright: bool) -> None:
    points = hexagonal(turn, limit=limit)
    image = draw(points, np.full(len(points), 4.5), bright=bright)
    with pytest.raises(TrackerInitError, match="hexagonal or concentric pattern; only rectangular grids"):
        MarkerTracker().start(image)


def test_a_concentric_pattern_is_refused_as_such() -> None:
    points = concentric()
    with pytest.raises(TrackerInitError, match=r"concentric.*only rectangular grids"):
        MarkerTracker().start(draw(points, np.full(len(points), 4.0)))


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(13) * 22 + 28.3, np.arange(10) * 22 + 21.2), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("angle", [-25.0, 12.0, 25.0])
def test_a_rotated_grid_is_not_mistaken_for_another_pattern(angle: float) -> None:
    turn = np.deg2rad(angle)
    points = (grid() - MIDDLE) * 0.75 @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + MIDDLE
    tracked = MarkerTracker().start(draw(points, np.full(130, 3.6)))
    assert (tracked.rows, tracked.cols) == (10, 13) and tracked.valid.all()


@pytest.mark.parametrize("factor", [0.75, 1.2, 1.4, 1.5])
def test_a_few_dots_of_another_size_are_measured(factor: float) -> None:
    radii, others = np.full(130, 4.6), [20, 45, 60, 84, 101, 110]
    radii[others] *= factor
    tracker = MarkerTracker()
    tracker.start(draw(grid(), radii))
    for step in range(1, 6):
        moved = step * np.array([0.5, -0.33])
        tracked = tracker.track(draw(grid() + moved, radii, seed=step))
        error = np.linalg.norm(tracked.displacement - moved, axis=1)
        assert tracked.valid.all() and error.max() < 0.1 and np.median(error) < 0.03


@pytest.mark.parametrize("bright", [False, True])
def test_a_dot_that_leaves_the_image_is_right_or_not_valid(bright: bool) -> None:
    points = np.stack(np.meshgrid(np.arange(13) * 24 + 15.3, np.arange(9) * 24 + 22.2), axis=-1).reshape(-1, 2)
    radii, leaving = np.full(len(points), 5.0), np.arange(len(points)) % 13 == 0
    tracker = MarkerTracker()
    tracker.start(draw(points, radii, bright=bright))
    for step in range(1, 13):
        moved = np.array([-1.75 * step, 0.3])
        tracked = tracker.track(draw(points + moved, radii, bright=bright, seed=step))
        error = np.linalg.norm(tracked.displacement - moved, axis=1)
        assert tracked.valid[~leaving].all() and error[tracked.valid].max() < 0.1
    assert not tracked.valid[leaving].any()
