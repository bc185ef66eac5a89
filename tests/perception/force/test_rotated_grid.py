"""Forces on a pad whose grid is rotated in the image: those of the upright grid, in the axes of the image."""

import re
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.camera_calibration import CameraCalibration, fit_calibration
from gelflow.perception.force.estimator import ForceEstimate
from gelflow.perception.force.image_forces import GridScale, ImageForces, grid_angle
from gelflow.perception.frames import CameraMount
from gelflow.perception.output.forces import force_text
from gelflow.perception.synthetic.pressed_layer import Press, PressedLayer
from gelflow.perception.tracker import TrackingResult
from gelflow.protocols import CameraImage
from gelflow.real.runner.touch.pad_forces import PadForces, RestingPad

GEL = ElasticGel(1.5e5, 0.48, 3e-3)
GRID = Grid(10, 13, 1.5)
SCALE = 20.0  # [px/mm]
REST = SCALE * GRID.positions()[:, ::-1] + 300.0  # right, down [px]
VALID = np.ones(130, bool)
ANGLE = np.radians(15)
ROTATION = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])  # clockwise
WAIT = 30.0  # [s]


def rotated(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (right, down), shape (..., 2), rotated in the image."""
    return np.asarray(vectors @ ROTATION.T)


@pytest.fixture(scope="module")
def moved() -> NDArray[np.float64]:
    """Displacements (right, down) [mm] under a pure press with shear down the image, without twist."""
    press = Press("disc", (1.0, -2.0), 3.0, 0.0, normal=1.0, ratio=0.3, direction=0.0)
    return PressedLayer(GEL, GRID).press(press).displacement_mm[:, ::-1]


@pytest.fixture(scope="module")
def upright(moved: NDArray[np.float64]) -> ForceEstimate:
    estimate = ImageForces(GEL, 10, 13, GridScale(1.5, SCALE)).estimate(moved, VALID, 0.0)
    assert estimate is not None
    return estimate


def test_the_axes_of_a_grid_follow_from_its_rest_positions() -> None:
    assert grid_angle(REST, 10, 13) == pytest.approx(0.0, abs=1e-12)
    assert grid_angle(rotated(REST), 10, 13) == pytest.approx(ANGLE)
    stretched = REST * [1.0, 1.1]
    assert grid_angle(rotated(stretched), 10, 13) == pytest.approx(ANGLE)


def test_a_rotated_grid_has_the_forces_of_the_upright_one(moved: NDArray[np.float64], upright: ForceEstimate) -> None:
    forces = ImageForces(GEL, 10, 13, GridScale(1.5, SCALE), grid_angle(rotated(REST), 10, 13))
    found = forces.estimate(rotated(moved), VALID, 0.0)
    assert found is not None and found.centre_of_pressure is not None and upright.centre_of_pressure is not None
    assert found.normal == pytest.approx(upright.normal, rel=1e-6)
    assert abs(found.moment) < 2e-5  # [N m]
    np.testing.assert_allclose(found.shear, rotated(upright.shear), atol=1e-6)
    np.testing.assert_allclose(found.centre_of_pressure, rotated(upright.centre_of_pressure), atol=1e-8)
    np.testing.assert_allclose(found.shear_field, rotated(upright.shear_field), atol=1e-6)
    assert (found.shear_deviation > 0.9 * upright.shear_deviation.min()).all()


@pytest.mark.parametrize("angle", [0.0, ANGLE, np.radians(45)])
def test_an_uncertain_modulus_is_one_factor_of_all_forces(moved: NDArray[np.float64], angle: float) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    guess = replace(GEL, youngs_modulus_deviation=0.5)
    found = ImageForces(guess, 10, 13, GridScale(1.5, SCALE), angle).estimate(moved @ turn.T, VALID, 0.0)
    assert found is not None
    tolerance = 0.05 * float(np.linalg.norm(found.shear))
    np.testing.assert_allclose(found.shear_deviation, 0.5 * np.abs(found.shear), atol=tolerance)
    printed = re.search(r"shear (\S+) \+- (\S+) N", force_text(found))
    assert printed is not None
    assert float(printed[2]) == pytest.approx(0.5 * float(printed[1]), rel=0.05, abs=0.01)


class Recorder:
    """Accepts forces and events."""

    def force(self, sensor: int, stamp: float, values: dict[str, Any]) -> None:
        assert sensor == 0

    def event(self, name: str, values: dict[str, Any]) -> None:
        raise AssertionError(f"{name}: {values}")


def calibrated() -> CameraCalibration:
    return fit_calibration(rotated(REST), VALID, rows=10, cols=13, spacing_mm=1.5, size=(640, 480))


@pytest.mark.parametrize(
    "mount",
    [CameraMount(10, 13, 1.5, pixels_per_mm=SCALE), CameraMount(10, 13, 1.5, calibration=calibrated())],
    ids=["scale", "calibration"],
)
def test_the_forces_of_a_run_are_in_the_axes_of_the_image(
    mount: CameraMount, moved: NDArray[np.float64], upright: ForceEstimate
) -> None:
    position = rotated(REST) + SCALE * rotated(moved)
    seen = TrackingResult(position, SCALE * rotated(moved), VALID, ~VALID, VALID * 1.0, 10, 13, 1.5 * SCALE)
    image = CameraImage(b"", 10.0, 1)
    record, end = None, time.monotonic() + WAIT
    with PadForces([GEL], [mount], Recorder()) as forces:  # type: ignore[arg-type]
        forces.set_rest([RestingPad(rotated(REST), VALID)])
        forces.add(0, image, seen)
        while record is None and time.monotonic() < end:
            record = forces.of([image])[0]
    assert record is not None and upright.centre_of_pressure is not None
    assert record["normal"] == pytest.approx(upright.normal, rel=1e-4)
    assert record["shear"] == pytest.approx(rotated(upright.shear), abs=1e-4)
    assert record["centre_mm"] == pytest.approx(1e3 * rotated(upright.centre_of_pressure), abs=1e-3)
    assert abs(record["moment"]) < 2e-5
