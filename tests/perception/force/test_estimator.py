"""Forces from marker displacements: five shapes, noise, missing markers, units and wrong input."""

from dataclasses import replace

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.benchmark.forces import measure_forces
from gelflow.perception.force.estimator import ForceEstimate, ForceEstimator
from gelflow.perception.force.image_forces import GridScale, ImageForces
from gelflow.perception.synthetic.pressed_layer import SHAPES, Press, PressedGel, PressedLayer, Shape, random_press

GEL = ElasticGel(youngs_modulus=1.5e5, poisson_ratio=0.48, thickness=3e-3)
GRID = Grid(10, 13, 1.5)
VALID = np.ones(130, bool)
BALL = Press("ball", (1.0, -2.0), 3.5, 0.0, normal=2.0, ratio=0.3, direction=0.7)


@pytest.fixture(scope="module")
def layer() -> PressedLayer:
    return PressedLayer(GEL, GRID)


def estimate_of(gel: PressedGel, *, noise: float = 1.5e-6, seed: int = 0, steps: int = 4) -> ForceEstimate:
    """The estimate after the load has grown in steps."""
    rng, estimator = np.random.default_rng(seed), ForceEstimator(GEL, GRID)
    for step in range(1, steps + 1):
        moved = step / steps * gel.displacement_mm * 1e-3 + rng.normal(0, noise, (130, 2))
        found = estimator.estimate(moved, VALID)
    assert found is not None
    return found


@pytest.mark.parametrize("shape", SHAPES)
def test_forces_of_five_shapes(layer: PressedLayer, shape: Shape) -> None:
    rng = np.random.default_rng(7)
    errors = []
    for number in range(8):
        true = layer.press(random_press(shape, GRID, rng, normal=(0.5, 8.0)))
        found = estimate_of(true, seed=number)
        shear = float(np.linalg.norm(found.shear - true.shear))
        errors.append(
            (
                min(shear / 0.05, shear / max(0.05 * float(np.linalg.norm(true.shear)), 1e-9)),
                min(abs(found.normal - true.normal) / 0.1, abs(found.normal / true.normal - 1) / 0.1),
                min(abs(found.moment - true.moment) / 2e-4, abs(found.moment / true.moment - 1) / 0.1),
            )
        )
        assert found.centre_of_pressure is not None
        assert np.linalg.norm(1e3 * found.centre_of_pressure - true.centre_mm) < 0.5
        assert found.contact and found.unexplained < 0.05
    worst = np.sort(errors, axis=0)[-2]  # of eight
    assert (worst < 1.0).all(), worst


def test_forces_from_rendered_images() -> None:
    errors = [measure_forces(shape, 1, GEL, seed=5) for shape in SHAPES]
    assert all(error.within(error.shear, 0.05, 0.05) >= 0.95 for error in errors)
    assert all(error.within(error.normal, 0.15, 0.1) >= 0.95 for error in errors)
    assert np.mean([error.within(error.normal, 0.1, 0.1) for error in errors]) >= 0.9


def test_deviations_cover_the_errors(layer: PressedLayer) -> None:
    rng = np.random.default_rng(3)
    covered = []
    for number in range(24):
        true = layer.press(random_press(SHAPES[number % 5], GRID, rng, normal=(0.5, 8.0)))
        found = estimate_of(true, seed=number)
        covered += list(np.abs(found.shear - true.shear) < 2 * found.shear_deviation)
        covered.append(abs(found.normal - true.normal) < 2 * found.normal_deviation)
        covered.append(abs(found.moment - true.moment) < 2 * found.moment_deviation)
    assert np.mean(covered) >= 0.9


def test_noise_alone_is_no_contact() -> None:
    rng, estimator = np.random.default_rng(0), ForceEstimator(GEL, GRID, noise=2e-6)
    for _ in range(50):
        found = estimator.estimate(rng.normal(0, 2e-6, (130, 2)), VALID)
        assert found is not None and not found.contact
        assert found.normal == 0 and not found.shear.any() and found.centre_of_pressure is None
        assert 0 < found.normal_deviation < 0.05 and (found.shear_deviation < 0.05).all()


def test_markers_that_are_missing_change_little(layer: PressedLayer) -> None:
    true = layer.press(BALL)
    moved = true.displacement_mm * 1e-3 + np.random.default_rng(1).normal(0, 1.5e-6, (130, 2))
    valid = np.random.default_rng(2).uniform(size=130) > 0.2
    moved[~valid] = np.nan
    found = ForceEstimator(GEL, GRID).estimate(moved, valid)
    assert found is not None
    assert found.normal == pytest.approx(true.normal, rel=0.15)
    np.testing.assert_allclose(found.shear, true.shear, atol=0.05)


def test_few_markers_are_not_enough(layer: PressedLayer) -> None:
    moved = layer.press(BALL).displacement_mm * 1e-3
    valid = np.arange(130) < 60
    assert ForceEstimator(GEL, GRID).estimate(moved, valid) is None


def test_forces_scale_with_the_modulus(layer: PressedLayer) -> None:
    moved = layer.press(BALL).displacement_mm * 1e-3
    soft = ForceEstimator(GEL, GRID).estimate(moved, VALID)
    stiff_gel = replace(GEL, youngs_modulus=3 * GEL.youngs_modulus, youngs_modulus_deviation=0.2)
    stiff = ForceEstimator(stiff_gel, GRID).estimate(moved, VALID)
    assert soft is not None and stiff is not None
    assert stiff.normal == pytest.approx(3 * soft.normal, rel=1e-9)
    np.testing.assert_allclose(stiff.shear, 3 * soft.shear, rtol=1e-9)
    assert stiff.normal_deviation > 0.2 * stiff.normal


def test_a_contact_after_another_is_found_anew(layer: PressedLayer) -> None:
    estimator = ForceEstimator(GEL, GRID)
    first, second = layer.press(BALL), layer.press(replace(BALL, center=(-4.0, 4.0), direction=3.0, shape="square"))
    estimator.estimate(first.displacement_mm * 1e-3, VALID)
    estimator.estimate(np.zeros((130, 2)), VALID)
    after = estimator.estimate(second.displacement_mm * 1e-3, VALID)
    alone = ForceEstimator(GEL, GRID).estimate(second.displacement_mm * 1e-3, VALID)
    assert after is not None and alone is not None
    assert after.normal == alone.normal


def test_equal_displacements_give_equal_forces(layer: PressedLayer) -> None:
    moved = layer.press(BALL).displacement_mm * 1e-3
    found = [ForceEstimator(GEL, GRID).estimate(moved, VALID) for _ in range(2)]
    assert found[0] is not None and found[1] is not None
    np.testing.assert_array_equal(found[0].shear_field, found[1].shear_field)
    np.testing.assert_array_equal(found[0].normal_field, found[1].normal_field)


def test_forces_in_the_axes_of_an_image(layer: PressedLayer) -> None:
    true = layer.press(replace(BALL, direction=0.0, twist=0.3))  # down in the image
    image = ImageForces(GEL, 10, 13, GridScale(1.5, 40.0))
    found = image.estimate(true.displacement_mm[:, ::-1], VALID, 0.0)
    assert found is not None and found.centre_of_pressure is not None
    np.testing.assert_allclose(found.shear, true.shear[::-1], atol=0.03)
    np.testing.assert_allclose(1e3 * found.centre_of_pressure, true.centre_mm[::-1], atol=0.3)
    assert found.moment == pytest.approx(-true.moment, rel=0.15)


def test_the_sum_of_the_fields_is_the_total(layer: PressedLayer) -> None:
    found = estimate_of(layer.press(BALL))
    np.testing.assert_allclose(found.shear_field.sum(0), found.shear, rtol=1e-9)
    assert found.normal_field.sum() == pytest.approx(found.normal)
    assert found.normal_field.min() >= 0


@pytest.mark.parametrize(
    ("displacement", "named"),
    [(np.zeros((129, 2)), "shape"), (np.full((130, 2), np.nan), "finite")],
)
def test_wrong_displacements_are_refused(displacement: np.ndarray, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        ForceEstimator(GEL, GRID).estimate(displacement, VALID)


def test_grids_without_forces_are_refused() -> None:
    with pytest.raises(UsageError, match="3 × 3"):
        ForceEstimator(GEL, Grid(2, 5, 1.5))
    with pytest.raises(UsageError, match="1000"):
        ForceEstimator(GEL, Grid(40, 40, 1.5))
    with pytest.raises(UsageError, match="noise"):
        ForceEstimator(GEL, GRID, noise=0.0)
