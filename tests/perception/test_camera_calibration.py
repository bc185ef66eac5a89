"""Camera calibration from the marker grid: recovery of lens and perspective, accuracy of the mapping, files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.errors import PeerError, UsageError
from gelflow.perception.camera_calibration import (
    CameraCalibration,
    fit_calibration,
    load_calibration,
    save_calibration,
    scale_by_ruler,
)
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.sequences import GelSequence
from gelflow.perception.tracker import MarkerTracker

SIZE = (320, 240)
ROWS, COLS, SPACING = 10, 13, 1.4
MARKERS = (np.stack(np.meshgrid(np.arange(COLS), np.arange(ROWS)), axis=-1).reshape(-1, 2) - (6, 4.5)) * SPACING
ALL = np.ones(len(MARKERS), dtype=bool)


def camera(positions_mm: np.ndarray, *, barrel: float, keystone: float, center: tuple[float, float]) -> np.ndarray:
    """Image positions [px] of an independent camera model: perspective, then Brown distortion about `center`."""
    turn = np.array([[np.cos(0.06), -np.sin(0.06), 0.5], [np.sin(0.06), np.cos(0.06), -0.3], [0, 0, 1]])
    plane = np.array([[15.5, 0, 159.5], [0, 15.0, 119.5], [keystone / 15, -keystone / 25, 1]]) @ turn
    flat = np.column_stack([positions_mm, np.ones(len(positions_mm))]) @ plane.T
    offset = flat[:, :2] / flat[:, 2:] - center
    square = (offset**2).sum(axis=1) / 200**2
    return np.asarray(offset * (1 - barrel * square + 0.3 * barrel * square**2)[:, None] + center)


def fitted(rest: np.ndarray, visible: np.ndarray = ALL) -> CameraCalibration:
    return fit_calibration(rest, visible, rows=ROWS, cols=COLS, spacing_mm=SPACING, size=SIZE)


def fitted_first(tracker: MarkerTracker, image: np.ndarray) -> CameraCalibration:
    first = tracker.start(image, rows=ROWS, cols=COLS)
    return fitted(tracker.rest, first.valid)


CAMERAS = [
    (0.0, 0.0, (159.5, 119.5)),
    (0.0, 0.15, (159.5, 119.5)),
    (0.08, 0.1, (159.5, 119.5)),
    (0.15, 0.1, (175.0, 110.0)),
    (-0.08, 0.05, (159.5, 119.5)),
]


@pytest.mark.parametrize(("barrel", "keystone", "center"), CAMERAS)
def test_displacements_in_millimetres_are_accurate_in_the_whole_image(
    barrel: float, keystone: float, center: tuple[float, float]
) -> None:
    rng = np.random.default_rng(0)
    rest = camera(MARKERS, barrel=barrel, keystone=keystone, center=center) + rng.normal(0, 0.02, MARKERS.shape)
    calibration = fitted(rest)
    assert calibration.residual_px < 0.04  # the noise is √2 × 0.02 px
    # Positions in the whole image, not only on the grid, displaced by 0.8 spacings.
    positions = rng.uniform(-1, 1, (2000, 2)) * (12, 9)
    moved = rng.normal(size=(2000, 2))
    moved *= 0.8 * SPACING / np.linalg.norm(moved, axis=1)[:, None]
    start, end = (camera(p, barrel=barrel, keystone=keystone, center=center) for p in (positions, positions + moved))
    shown = ((start > 0) & (end > 0) & (start < SIZE) & (end < SIZE)).all(axis=1)
    positions, moved, start, end = positions[shown], moved[shown], start[shown], end[shown]
    error = np.linalg.norm(calibration.displacement_mm(end, end - start) - moved, axis=1)
    near = (np.abs(positions) < np.abs(MARKERS).max(axis=0) + 0.5 * SPACING).all(axis=1)
    assert error[near].max() < 0.015 and error.max() < 0.05  # a uniform scale has errors up to 0.3 mm
    assert np.abs(calibration.to_pixels(calibration.to_mm(start)) - start).max() < 1e-6


@pytest.mark.parametrize("radial", [(), (-0.1,), (-0.1, -0.1)])
def test_the_selected_lens_model_has_the_true_number_of_coefficients(radial: tuple[float, ...]) -> None:
    matrix = ((13.0, 0.2, 0.1), (-0.2, 13.0, 0.3), (0.0, 0.0, 1.0))
    true = CameraCalibration(*SIZE, ROWS, COLS, SPACING, matrix, radial, (159.5, 119.5), 0.0, 0.0)
    for seed in range(3):
        calibration = fitted(true.to_pixels(MARKERS) + np.random.default_rng(seed).normal(0, 0.05, MARKERS.shape))
        assert len(calibration.radial) == len(radial) and calibration.center == true.center
        assert np.allclose(calibration.radial, radial, atol=0.03)


def test_hidden_markers_and_outliers_do_not_affect_the_fit() -> None:
    rest = camera(MARKERS, barrel=0.08, keystone=0.1, center=(159.5, 119.5))
    visible = ALL.copy()
    visible[[0, 40, 129]] = False
    bad = rest.copy()
    bad[~visible] = 1000.0
    bad[[10, 77]] += (3.0, -4.0)
    calibration = fitted(bad, visible)
    assert np.abs(calibration.to_mm(rest) - MARKERS).max() < 0.005 and calibration.largest_px < 0.1


def test_calibrated_displacements_of_a_rendered_gel_are_accurate() -> None:
    appearance = make_appearance("typical", keystone=0.15, barrel=0.08, seed=3)
    sequence = GelSequence(appearance, "twist", frames=31, peak=0.8)
    tracker, errors, with_one_scale = MarkerTracker(), [], []
    for number, frame in enumerate(sequence):
        if number == 0:
            calibration = fitted_first(tracker, frame.image)
            continue
        tracked, truth = tracker.track(frame.image), sequence.displacement(number)[:, ::-1]
        moved = calibration.displacement_mm(tracked.position, tracked.displacement)
        errors += np.linalg.norm(moved - truth, axis=1)[tracked.valid].tolist()
        scaled = tracked.displacement / np.mean(calibration.pixels_per_mm())
        with_one_scale += np.linalg.norm(scaled - truth, axis=1)[tracked.valid].tolist()
    # The error bounds of the tracker, 0.03 and 0.06 px, are 0.002 and 0.004 mm.
    assert np.median(errors) < 0.004 and np.percentile(errors, 95) < 0.008
    assert np.percentile(with_one_scale, 95) > 0.04


def test_rectification_straightens_the_grid() -> None:
    rest = camera(MARKERS, barrel=0.15, keystone=0.1, center=(159.5, 119.5))
    calibration = fitted(rest)
    image = np.full((240, 320, 3), 200, dtype=np.uint8)
    down, right = np.indices((240, 320))
    for position in rest:
        ink = np.clip(4.5 - np.hypot(right - position[0], down - position[1]), 0, 1)
        image -= (160 * ink).astype(np.uint8)[..., None]
    tracker = MarkerTracker()
    tracker.start(calibration.rectify(image), rows=ROWS, cols=COLS)
    grid = tracker.rest.reshape(ROWS, COLS, 2)
    lines, columns = grid[..., 1], grid[..., 0]
    assert lines.std(axis=1).mean() < 0.1 and columns.std(axis=0).mean() < 0.1  # several px before rectification


def test_a_deformed_gel_and_too_few_markers_are_rejected() -> None:
    rest = camera(MARKERS, barrel=0.05, keystone=0.05, center=(159.5, 119.5))
    bump = np.exp(-((MARKERS - (3.0, -2.0)) ** 2).sum(axis=1) / 18)[:, None]
    with pytest.raises(PeerError, match="check that the gel is undamaged"):
        fitted(rest + bump * (6.0, 4.0))
    with pytest.raises(PeerError, match="do not form a regular grid"):
        fitted(rest + np.random.default_rng(0).normal(0, 2.0, rest.shape))
    with pytest.raises(PeerError, match="10 markers are visible, at least 16"):
        fitted(rest, np.arange(len(MARKERS)) < 10)
    with pytest.raises(UsageError, match="spacing"):
        fit_calibration(rest, ALL, rows=ROWS, cols=COLS, spacing_mm=0.0, size=SIZE)


def test_a_ruler_gives_the_spacing_behind_perspective_and_lens() -> None:
    view: dict[str, Any] = {"barrel": 0.08, "keystone": 0.1, "center": (159.5, 119.5)}
    rng = np.random.default_rng(3)
    rest = camera(MARKERS, **view) + rng.normal(0, 0.02, MARKERS.shape)
    unscaled = fit_calibration(rest, ALL, rows=ROWS, cols=COLS, spacing_mm=1.0, size=SIZE)
    errors = []
    for _ in range(100):
        turn = rng.uniform(0, 2 * np.pi)
        ends = rng.uniform(-1.5, 1.5, 2) + np.outer([-4.5, 4.5], [np.cos(turn), np.sin(turn)])  # 9 mm apart
        read = camera(ends, **view) + rng.normal(0, 1.0, (2, 2))
        scaled = scale_by_ruler(unscaled, read, 9.0)
        errors.append(scaled.spacing_mm / SPACING - 1)
        assert scaled.scale_error is not None and 0.008 < scaled.scale_error < 0.013
    assert 0.5 < float(np.std(errors)) / 0.0105 < 1.5 and abs(np.mean(errors)) < 0.003
    np.testing.assert_allclose(scaled.to_mm(rest), fitted(rest).to_mm(rest) * (1 + errors[-1]), atol=0.02)


@pytest.mark.parametrize(
    ("points", "length", "message"),
    [
        ([[10, 10], [40, 10]], 2.0, "reading them makes the scale uncertain by 4.7 %.*further apart"),
        ([[10, 10], [400, 10]], 20.0, "must be in the image of 320 × 240 px"),
        ([[10, np.nan], [200, 10]], 20.0, "must be in the image"),
        ([[10, 10], [300, 10]], -1.0, "above 0 mm, got -1"),
        ([[10, 10], [300, 10]], 1e9, "check its points"),
    ],
)
def test_a_ruler_that_gives_no_scale_is_refused(points: list[list[float]], length: float, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        scale_by_ruler(fitted(camera(MARKERS, barrel=0, keystone=0, center=(159.5, 119.5))), np.array(points), length)


def rms_length_error(calibration: CameraCalibration, view: dict[str, Any]) -> float:
    """Root mean square relative error of short lengths at the markers, against the camera that `view` describes."""
    columns = []
    for step in np.eye(2) * 0.05:
        ends = (calibration.to_mm(camera(MARKERS + sign * step, **view)) for sign in (1, -1))
        columns.append((next(ends) - next(ends)) / 0.1)
    deviation = np.stack(columns, axis=-1) - np.eye(2)
    return float(np.sqrt((deviation**2).sum(axis=(1, 2)).mean() / 2))


@pytest.mark.parametrize("barrel", [0.0, 0.08])
@pytest.mark.parametrize("spread", [0.01, 0.03, 0.06])
def test_an_uneven_print_is_accepted_with_its_uncertainty(spread: float, barrel: float) -> None:
    view: dict[str, Any] = {"barrel": barrel, "keystone": 0.1, "center": (159.5, 119.5)}
    stated, true = [], []
    for seed in range(8):
        printed = MARKERS + np.random.default_rng(seed).normal(0, spread * SPACING, MARKERS.shape)
        calibration = fitted(camera(printed, **view))
        assert calibration.scale_error is not None and calibration.smooth_share is not None
        stated.append(calibration.scale_error)
        true.append(rms_length_error(calibration, view))
    assert 0.5 < np.mean(stated) / np.mean(true) < 2 and np.mean(stated) < 0.2 * spread


@pytest.mark.parametrize("strength", [0.25, 0.5, 0.8])
def test_a_touched_gel_is_stated_as_a_smooth_deviation(strength: float) -> None:
    view: dict[str, Any] = {"barrel": 0.05, "keystone": 0.05, "center": (159.5, 119.5)}
    bump = np.exp(-((MARKERS - (3.0, -2.0)) ** 2).sum(axis=1) / 18)[:, None]
    calibration = fitted(camera(MARKERS, **view) + strength * bump * (6.0, 4.0))
    assert calibration.scale_error is not None and calibration.smooth_share is not None
    assert 0.7 < calibration.scale_error / rms_length_error(calibration, view) < 1.4 and calibration.smooth_share > 0.5


def test_a_file_without_an_uncertainty_loads(tmp_path: Path) -> None:
    path = tmp_path / "gel.json"
    save_calibration(fitted(camera(MARKERS, barrel=0.0, keystone=0.0, center=(159.5, 119.5))), path)
    data = json.loads(path.read_text())
    path.write_text(json.dumps({name: data[name] for name in data if name not in ("scale_error", "smooth_share")}))
    assert load_calibration(path).scale_error is None


def test_a_saved_calibration_loads_equal_and_is_never_overwritten(tmp_path: Path) -> None:
    calibration = fitted(camera(MARKERS, barrel=0.08, keystone=0.1, center=(170.0, 119.5)))
    save_calibration(calibration, tmp_path / "gel.json")
    assert load_calibration(tmp_path / "gel.json") == calibration
    with pytest.raises(UsageError, match="exists; name a new file"):
        save_calibration(calibration, tmp_path / "gel.json")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"format": 2}, "calibration format 2; this gelflow reads format 1: update"),
        ({"format": None}, "it has no format"),
        ({"zoom": 3}, "unknown keys ['zoom']"),
        ({"matrix": [[1, 2], [3, 4]]}, "not a valid image-to-gel mapping"),
        ({"matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "not a valid image-to-gel mapping"),
        ({"radial": [0.1, "much"]}, "not a valid image-to-gel mapping"),
        ({"center": [float("nan"), 0.0]}, "not a valid image-to-gel mapping"),
        ({"width": "wide"}, "not a valid image-to-gel mapping"),
        ({"spacing_mm": -1.0}, "not a valid image-to-gel mapping"),
    ],
)
def test_an_invalid_calibration_file_is_rejected(tmp_path: Path, change: dict[str, object], expected: str) -> None:
    path = tmp_path / "gel.json"
    save_calibration(fitted(camera(MARKERS, barrel=0.0, keystone=0.0, center=(159.5, 119.5))), path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(UsageError) as error:
        load_calibration(path)
    assert expected in str(error.value) and "gel.json" in str(error.value)


@pytest.mark.parametrize("text", ["", "[1]", "\xff\xfe", "{"])
def test_a_foreign_file_is_rejected(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gel.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError, match="is not a calibration"):
        load_calibration(path)
    with pytest.raises(UsageError, match="cannot read"):
        load_calibration(tmp_path / "none.json")


def test_images_of_another_size_are_rejected() -> None:
    calibration = fitted(camera(MARKERS, barrel=0.0, keystone=0.0, center=(159.5, 119.5)))
    with pytest.raises(PeerError, match="images of 320 × 240 px, this one has 640 × 480"):
        calibration.check_size(np.zeros((480, 640, 3), dtype=np.uint8))


def test_a_rectified_image_is_centred_on_the_grid() -> None:
    middle = (np.array(SIZE) - 1) / 2
    calibration = fitted(middle + MARKERS * 15)
    distance = np.abs(np.arange(SIZE[0]) - middle[0]) / SIZE[0]
    image = np.tile((500 * distance).astype(np.uint8), (SIZE[1], 1))
    rectified = calibration.rectify(image).astype(int)
    assert np.abs(rectified - rectified[:, ::-1]).max() <= 1
