"""A step of the contact fit agrees with the same equations, solved for all unknowns at once without elimination."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import nnls

from gelflow.perception.force._contact_fit import REMAINDER, REMAINDER_FLOOR, SMALLEST_LOAD, ContactFit
from gelflow.perception.force.contact_fit import LayerModel

MODEL = LayerModel(5, 6, 0.48, 2.0)
N = MODEL.markers


def remainder_deviation(normal: np.ndarray, rigid: np.ndarray) -> np.ndarray:
    around = MODEL.smoothing @ (0.3 * np.sqrt(normal * normal.max()) + 0.7 * normal)
    shear = REMAINDER * (np.hypot(*rigid[:2]) + 1.3 * abs(rigid[2])) + REMAINDER_FLOOR
    return np.asarray(1.5 * around * shear + 1e-6)


def unit_loads(rigid: np.ndarray, arm: np.ndarray, inner: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Loads of all cells per unit of the unknowns, r of `inner` along both axes and p of `cells`, (3n, unknowns)."""
    unit = np.eye(3 * N)
    along, across = rigid[0] - rigid[2] * arm[:, 1], rigid[1] + rigid[2] * arm[:, 0]
    pressed = unit[:N] * along[:, None] + unit[N : 2 * N] * across[:, None] + unit[2 * N :]
    return np.concatenate([unit[inner], unit[N + inner], pressed[cells]]).T


def prior_precision(deviation: np.ndarray, scale: float, inner: np.ndarray, cells: np.ndarray) -> np.ndarray:
    correlation = MODEL.correlation[np.ix_(inner, inner)] + 0.01 * np.eye(inner.size)
    of_axis = np.linalg.inv(correlation * np.outer(deviation[inner], deviation[inner]))
    return np.asarray(block_diag(of_axis, of_axis, 0.048 / scale**2 * MODEL.roughness[np.ix_(cells, cells)]))


def solve_loads(loads: np.ndarray, prior: np.ndarray, k: int, measured: np.ndarray, weight: float) -> np.ndarray:
    """The first `k` unknowns are free, the others are not negative: a free one is a difference of two."""
    root = np.concatenate([np.sqrt(weight) * MODEL.compliance @ loads, np.linalg.cholesky(prior).T])
    target = np.concatenate([np.sqrt(weight) * measured, np.zeros(len(prior))])
    found = nnls(np.concatenate([root, -root[:, :k]], axis=1), target)[0]
    return np.asarray(found[: len(prior)] - np.pad(found[len(prior) :], (0, len(prior) - k)))


def check_step(measured: np.ndarray, weight: float, last: ContactFit, fit: ContactFit) -> None:
    normal = last.normal
    centre = normal @ MODEL.position / normal.sum()
    arm, (x, y) = MODEL.position - centre, centre - last.centre
    rigid = np.array([last.ratio[0] - last.twist * y, last.ratio[1] + last.twist * x, last.twist])
    deviation, scale = remainder_deviation(normal, rigid), max(np.sort(normal)[-10:].mean(), SMALLEST_LOAD)
    has_remainder = deviation > 0.05 * deviation.max()
    inner, cells = np.flatnonzero(has_remainder), np.flatnonzero(has_remainder | last.wanted | (normal > 0))
    loads, prior = unit_loads(rigid, arm, inner, cells), prior_precision(deviation, scale, inner, cells)
    found = solve_loads(loads, prior, 2 * inner.size, measured, weight)
    left = measured - MODEL.compliance @ loads @ found
    assert fit.cost == pytest.approx(weight * left @ left + found @ prior @ found, rel=1e-6)

    pressed, none = loads[2 * N :] @ found, np.zeros(N)
    motion = [[pressed, none, none], [none, pressed, none], [-arm[:, 1] * pressed, arm[:, 0] * pressed, none]]
    free = np.flatnonzero((found > 0) | (np.arange(len(found)) < 2 * inner.size))
    columns = np.concatenate([np.reshape(motion, (3, 3 * N)).T, loads[:, free]], axis=1)
    prior = np.asarray(block_diag(np.diag([1.0, 1.0, 4.0]), prior[np.ix_(free, free)]))
    response = MODEL.compliance @ columns
    hessian, values = weight * response.T @ response + prior, np.concatenate([rigid, found[free]])
    change = np.linalg.solve(hessian, weight * response.T @ left - prior @ values)
    change *= min(1.0, 0.3 / np.hypot(*change[:2]))
    found[free] += change[3:]
    remainder, moved = np.zeros((2, N)), np.zeros(N)
    remainder[:, inner], moved[cells] = found[: 2 * inner.size].reshape(2, -1), np.maximum(found[2 * inner.size :], 0)
    sums = [np.repeat(unit, N) for unit in np.eye(3)]
    of_unknowns = np.stack([*sums, np.concatenate([-arm[:, 1], arm[:, 0], none])]) @ columns

    np.testing.assert_allclose([*fit.ratio, fit.twist], rigid + change[:3], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(fit.centre, centre, atol=1e-12)
    np.testing.assert_allclose(fit.normal, moved, atol=1e-7 * moved.max())
    np.testing.assert_allclose(fit.remainder, remainder, atol=1e-7 * moved.max())
    np.testing.assert_allclose(fit.rigid_covariance, of_unknowns @ np.linalg.solve(hessian, of_unknowns.T), rtol=1e-6)
    everywhere = unit_loads(rigid, arm, np.arange(0), np.arange(N))
    improves = left @ MODEL.compliance @ everywhere > 0
    improves[cells] = False
    np.testing.assert_array_equal(fit.wanted, improves)


@pytest.mark.parametrize("seed", range(6))
def test_steps_agree_with_the_equations_of_all_unknowns(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = rng.uniform(-1.5, 1.5, 2)
    pressed = np.maximum(1 - ((MODEL.position - place) ** 2).sum(1) / rng.uniform(2, 5), 0.0)
    shear = rng.uniform(-0.5, 0.5, (2, 1)) * pressed + 0.02 * rng.normal(size=(2, N))
    measured = MODEL.compliance @ np.concatenate([shear.ravel(), pressed]) + 0.005 * rng.normal(size=2 * N)
    valid, noise = np.ones(N, bool), 0.01
    image = MODEL.fitter.equations(MODEL.gram(valid), measured.reshape(2, N).T, valid, noise)
    ratios, scales = rng.uniform(-0.5, 0.5, (3, 2)), np.full(3, 0.5)
    fit = MODEL.fitter.first(image, ratios=ratios, scales=scales, deviation=0.05, centre=place)
    for _ in range(3):
        last, fit = fit, MODEL.fitter.step(image, fit)
        check_step(measured, 1 / noise**2, last, fit)
