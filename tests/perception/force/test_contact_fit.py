"""The fit of contact forces keeps matrices between images: they give the result of a fit that starts anew."""

import numpy as np
import pytest

from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force._contact_fit import ContactFit
from gelflow.perception.force.contact_fit import LayerModel, fit_contact
from gelflow.perception.force.estimator import ForceEstimator
from gelflow.perception.synthetic.pressed_layer import SHAPES, Press, PressedLayer, Shape

GEL = ElasticGel(youngs_modulus=1.5e5, poisson_ratio=0.48, thickness=3e-3)
GRID = Grid(10, 13, 1.5)
VALID = np.ones(130, bool)
NOISE = 0.01  # [pitches]


@pytest.fixture(scope="module")
def layer() -> PressedLayer:
    return PressedLayer(GEL, GRID)


def new_model() -> LayerModel:
    return LayerModel(10, 13, GEL.poisson_ratio, 2.0)


def displacements(layer: PressedLayer, shape: Shape, fraction: float) -> np.ndarray:
    """Displacements [pitches] under an object whose shear grows with its normal force, shape (130, 2)."""
    press = Press(
        shape, (1.0, -2.0), 3.0, 0.4, normal=5 * fraction, ratio=0.4 * fraction, direction=0.7, twist=0.3 * fraction
    )
    noise = np.random.default_rng(int(16 * fraction)).normal(0, 1.5e-3, (130, 2))
    return np.asarray(layer.press(press).displacement_mm / GRID.pitch + noise)


def fit_sequence(layer: PressedLayer, model: LayerModel, valid: list[np.ndarray]) -> ContactFit:
    """The last fit of a growing load; `valid` are the measured markers of each image."""
    fit = None
    for image, measured in enumerate(valid):
        fit = fit_contact(model, displacements(layer, "disc", (image + 1) / len(valid)), measured, NOISE, fit)
    assert fit is not None
    return fit


def test_markers_that_come_and_go_change_the_normal_equations_as_if_computed_anew() -> None:
    model, rng = new_model(), np.random.default_rng(0)
    for share in (0.02, 0.0, 0.3, 0.5):
        valid = rng.uniform(size=130) >= share
        rows = model.compliance[np.concatenate([valid, valid])]
        np.testing.assert_allclose(model.gram(valid), rows.T @ rows, atol=1e-12 * np.abs(model.gram(VALID)).max())


def test_a_model_that_fitted_other_images_gives_the_same_fit(layer: PressedLayer) -> None:
    used, rng = new_model(), np.random.default_rng(1)
    valid = [rng.uniform(size=130) > 0.1 * (image % 2) for image in range(6)]
    fit_sequence(layer, used, valid[::-1])
    again, fresh = fit_sequence(layer, used, valid), fit_sequence(layer, new_model(), valid)
    np.testing.assert_allclose(again.normal, fresh.normal, atol=1e-9 * fresh.normal.max())
    np.testing.assert_allclose(again.shear(used.position), fresh.shear(used.position), atol=1e-9 * fresh.normal.max())
    np.testing.assert_allclose(again.rigid_covariance, fresh.rigid_covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_fit_that_follows_a_load_agrees_with_one_that_starts_there(layer: PressedLayer, shape: Shape) -> None:
    """In the first and the fifth image at the final load: normal force to 2 %, shear force to 0.1 % of it."""
    following, starting = ForceEstimator(GEL, GRID), ForceEstimator(GEL, GRID)
    for image in range(1, 16):
        following.estimate(displacements(layer, shape, image / 16) * GRID.pitch * 1e-3, VALID)
    moved = displacements(layer, shape, 1.0) * GRID.pitch * 1e-3
    pairs = [(following.estimate(moved, VALID), starting.estimate(moved, VALID)) for _ in range(5)]
    for warm, cold in (pairs[0], pairs[-1]):
        assert warm is not None and cold is not None
        assert warm.normal == pytest.approx(cold.normal, rel=0.02)
        np.testing.assert_allclose(warm.shear, cold.shear, atol=0.001 * cold.normal)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_single_step_at_constant_load_leaves_the_forces_unchanged(layer: PressedLayer, shape: Shape) -> None:
    """Equal images change the normal force by less than 0.2 %: it may alternate where a cell is barely pressed."""
    model, moved = new_model(), displacements(layer, shape, 1.0)
    fits: list[ContactFit] = []
    for _ in range(12):
        fits.append(fit_contact(model, moved, VALID, NOISE, fits[-1] if fits else None))
    sums = np.array([fit.normal.sum() for fit in fits[-4:]])
    assert np.ptp(sums) < 0.002 * sums.mean()
