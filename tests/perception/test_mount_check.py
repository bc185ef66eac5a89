"""The check of a camera's scale against the printed pitch of its markers."""

from dataclasses import replace

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.perception import CameraMount, MarkerTracker, check_scale, fit_calibration
from gelflow.perception.mount_check import neighbour_spacing
from gelflow.perception.synthetic.appearance import GelAppearance, make_appearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.sequences import GelSequence
from gelflow.perception.tracker import TrackingResult


@pytest.fixture(scope="module")
def rest() -> TrackingResult:
    appearance = GelAppearance()  # 15.7 px/mm
    return MarkerTracker().start(FastGelRenderer(appearance).render(np.zeros((252, 2))))


@pytest.mark.parametrize("scale", [1e-3, 1.57, 14.0, 17.5, 31.4, 157.0, 1e12])
def test_a_wrong_scale_is_refused_with_the_fitting_value(rest: TrackingResult, scale: float) -> None:
    with pytest.raises(UsageError, match=r"22\.\d px apart in a row .* pixels_per_mm = 15\.7\d* would fit") as error:
        check_scale(CameraMount(pixels_per_mm=scale), rest)
    assert f"1.4 mm × {scale:g} px/mm is {1.4 * scale:.4g} px" in str(error.value)


@pytest.mark.parametrize("scale", [15.0, 15.7, 16.4])
def test_a_scale_within_the_tolerance_is_accepted(rest: TrackingResult, scale: float) -> None:
    check_scale(CameraMount(pixels_per_mm=scale), rest)
    check_scale(CameraMount(), rest)  # without a scale nothing is compared


def test_a_wrong_pitch_is_refused(rest: TrackingResult) -> None:
    with pytest.raises(UsageError, match=r"pitch 1\.8 mm × 15\.7 px/mm is 28\.26 px"):
        check_scale(CameraMount(pitch=1.8, pixels_per_mm=15.7), rest)


def test_different_pitches_in_rows_and_columns_are_refused(rest: TrackingResult) -> None:
    stretched = replace(rest, position=rest.position * (1.0, 1.25))
    with pytest.raises(UsageError, match="no single pixels_per_mm fits both directions: calibrate the camera"):
        check_scale(CameraMount(pixels_per_mm=15.7), stretched)


def test_hidden_markers_do_not_affect_the_spacing(rest: TrackingResult) -> None:
    valid = rest.valid.copy()
    valid[::7] = False
    moved = np.where(valid[:, None], rest.position, 1e6)
    assert neighbour_spacing(moved, valid, rest.rows, rest.cols) == pytest.approx((21.98, 21.98), abs=0.05)
    assert np.isnan(neighbour_spacing(moved, np.zeros_like(valid), rest.rows, rest.cols)).all()


@pytest.mark.parametrize("keystone", [0.0, 0.1])
@pytest.mark.parametrize("barrel", [0.0, 0.06])
def test_perspective_and_lens_are_within_the_tolerance(keystone: float, barrel: float) -> None:
    appearance = make_appearance("typical", keystone=keystone, barrel=barrel)
    image = next(iter(GelSequence(appearance, motion="rest", frames=1))).image
    tracked = MarkerTracker().start(image)
    grid, pitch = appearance.grid, appearance.grid.pitch
    middle = (1 - keystone / (2 - keystone)) * appearance.pixels_per_mm  # scale at the image centre [px/mm]
    uniform = CameraMount(grid.rows, grid.cols, pitch, pixels_per_mm=middle)
    spacing = neighbour_spacing(tracked.position, tracked.valid, grid.rows, grid.cols)
    assert np.abs(np.array(spacing) / (middle * pitch) - 1).max() < 0.05
    check_scale(uniform, tracked)
    calibration = fit_calibration(
        tracked.position, tracked.valid, rows=grid.rows, cols=grid.cols, spacing_mm=pitch, size=(320, 240)
    )
    calibrated = CameraMount(grid.rows, grid.cols, pitch, calibration=calibration)
    check_scale(calibrated, tracked)
    nearer = replace(tracked, position=1.15 * (tracked.position - (159.5, 119.5)) + (159.5, 119.5))
    with pytest.raises(UsageError, match=r"1\.6\d+ mm apart in a row .* pitch is 1.4 mm: calibrate the camera"):
        check_scale(calibrated, nearer)
