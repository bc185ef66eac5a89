"""Check of the pads at a grasp: the part's weight is shown by both, and scales the thresholds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.observation import Grid, TactileFrame
from gelflow.real.runner.lab import DescentSettings
from gelflow.real.runner.touch.grasp_check import TouchImplausible, check_grasp, check_release
from gelflow.real.runner.touch.observer import TactileReading

GRID = Grid(rows=3, cols=3, pitch=1.4)
NOISE = 5e-4  # [mm]
WEIGHT = [[0.056, 0.0], [0.056, 0.0]]  # of the scene's part on the scene's gels [mm]


def readings(mean: object, *, seed: int = 0) -> list[TactileReading]:
    """Five readings with this mean change of both pads [mm] and noise."""
    rng = np.random.default_rng(seed)
    changes: NDArray[np.float64] = np.asarray(mean, dtype=float) + rng.normal(0, NOISE, (5, 2, 2))
    frame = TactileFrame(
        np.zeros((2, 9, 2), np.float32), np.ones((2, 9), bool), GRID.positions().astype(np.float32), 0.0, "mm"
    )
    return [TactileReading(frame, (), 0.0, change) for change in changes]


FREE = readings(np.zeros((2, 2)))


def test_thresholds_of_the_lab_file_hold_for_the_gel_of_the_scene() -> None:
    thresholds = check_grasp(FREE, readings(WEIGHT, seed=1), DescentSettings()).thresholds
    assert thresholds.contact == pytest.approx(0.04, rel=0.03)
    assert thresholds.stop == pytest.approx(3 * thresholds.contact)


@pytest.mark.parametrize("stiffness", [2.0, 5.0, 8.0])
def test_stiffer_gels_lower_all_thresholds_in_proportion(stiffness: float) -> None:
    thresholds = check_grasp(FREE, readings(np.array(WEIGHT) / stiffness, seed=1), DescentSettings()).thresholds
    assert thresholds.contact == pytest.approx(0.7 * 0.056 / stiffness, rel=0.1)
    assert thresholds.stop == pytest.approx(3 * thresholds.contact)


def test_softer_gels_and_heavier_parts_do_not_raise_the_thresholds() -> None:
    """Except that of fast motions far above the hole."""
    thresholds = check_grasp(FREE, readings(4 * np.array(WEIGHT), seed=1), DescentSettings()).thresholds
    assert thresholds.contact == 0.04
    assert thresholds.stop == pytest.approx(0.12) and thresholds.stuck == pytest.approx(0.24)
    assert thresholds.fast == pytest.approx(0.3 * 4 * 0.056, rel=0.03)


@pytest.mark.parametrize(
    ("weight", "named"),
    [
        ([[0.056, 0.0], [0.0, 0.0]], "right camera: the pad shows no weight"),
        ([[0.0, 0.0], [0.056, 0.0]], "left camera: the pad shows no weight"),
        ([[-0.056, 0.0], [0.056, 0.0]], "left camera: .* is [+-]180° from"),
        ([[0.056, 0.0], [0.0, 0.056]], "right camera: .* is [+]90° from"),
        ([[0.0, 0.0], [0.0, 0.0]], "left camera: the pad shows no weight"),
        ([[0.0, 0.056], [0.0, 0.056]], "left camera: .* is [+](89|90|91)° from"),
        ([[0.0, 0.056], [0.0, -0.056]], "left camera: .* is [+](89|90|91)° from"),
        ([[0.056, -0.07], [-0.056, -0.07]], "right camera: .* from the direction to the fingertip"),
    ],
)
def test_pad_that_does_not_show_the_weight_is_refused(weight: list[list[float]], named: str) -> None:
    with pytest.raises(TouchImplausible, match=named):
        check_grasp(FREE, readings(weight, seed=1), DescentSettings())


def test_sideways_shear_by_the_grip_itself_is_accepted() -> None:
    """A plug without parallel sides: the pads are sheared sideways, with opposite forces on the part."""
    check = check_grasp(FREE, readings([[0.055, -0.065], [0.05, -0.039]], seed=1), DescentSettings())
    assert check.thresholds.contact == pytest.approx(0.7 * 0.05, rel=0.1)


def test_weight_below_the_noise_is_refused() -> None:
    with pytest.raises(TouchImplausible, match="too stiff or the part is too light"):
        check_grasp(FREE, readings(np.array(WEIGHT) / 18, seed=1), DescentSettings())


def test_check_can_be_omitted_for_light_parts() -> None:
    check = check_grasp(FREE, readings(np.zeros((2, 2)), seed=1), DescentSettings(weight_check=False))
    assert check.thresholds.contact == 0.04


def test_release_without_a_change_of_the_pads_is_not_believed() -> None:
    held = readings(WEIGHT, seed=1)
    check = check_grasp(FREE, held, DescentSettings())
    check_release(held, readings(np.zeros((2, 2)), seed=2), check)
    with pytest.raises(
        TouchImplausible, match=r"right camera: the pad shows no change at the release .* does not count as inserted"
    ):
        check_release(held, readings([[0.0, 0.0], WEIGHT[1]], seed=2), check)
