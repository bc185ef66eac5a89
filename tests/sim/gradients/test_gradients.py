"""Gradients in all scenes and on all shapes, with both friction laws and integrators, compared with dual numbers and
central differences. `python benchmarks/gradients.py` checks many more states."""

import numpy as np
import pytest

from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import FREE, SHAPES, cloud_on_shape, converged_simulator, scene_in_contact
from gelflow.sim.validation.reference_motions import PUBLISHED_ROLLING_FORCES, SCENES

OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", SCENES)
def test_gradients_equal_dual_numbers(name: str, law: str, integrator: str) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        sim, u = scene_in_contact(name, law, integrator, rng)
        assert sim.tactile().any(), "no marker force: the check would be meaningless"
        for output in OUTPUTS:
            case = gradient_check.RolloutLoss.random(sim, u, output, rng)
            assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", SCENES)
def test_gradients_agree_with_central_differences(name: str, law: str, integrator: str) -> None:
    """Controls and state for every output; parameters, which take most of the time, for one output in turn."""
    agreements, with_params = [], (FRICTION_LAWS.index(law) + 2 * INTEGRATORS.index(integrator)) % len(OUTPUTS)
    for seed, output in enumerate(OUTPUTS):
        rng = np.random.default_rng(100 + seed)
        sim, u = scene_in_contact(name, law, integrator, rng)
        case = gradient_check.RolloutLoss.random(sim, u, output, rng)
        agreements.append(gradient_check.compare_to_differences(case, params=seed == with_params))
    worst, skipped = max(a.error for a in agreements), np.mean([a.skipped for a in agreements])
    print(f"{name} {law} {integrator}: error {worst:.1e}, skipped {skipped:.1%}")
    assert worst < 1e-6
    assert skipped <= 0.05


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("kind", [*SHAPES, FREE])
def test_gradients_on_every_shape(kind: str, law: str, integrator: str) -> None:
    """Points pressed onto the shape; and a free body spinning on a plane, with arc corrections (arc_correction.hpp)."""
    skipped = []
    for seed, output in enumerate(OUTPUTS):
        rng = np.random.default_rng(seed)
        sim, u = cloud_on_shape(kind, law, integrator, rng)
        assert sim.tactile().any()
        case = gradient_check.RolloutLoss.random(sim, u, output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=1).error < 1e-10
        agreement = gradient_check.compare_to_differences(case)
        assert agreement.error < 1e-6
        skipped.append(agreement.skipped)
    assert np.mean(skipped) <= 0.05


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_first_110_steps_of_the_rolling_run(law: str, integrator: str) -> None:
    """100 steps of descent onto the ball, then rolling; final positions, and a loss of all marker forces."""
    (down, push), (_, roll) = PUBLISHED_ROLLING_FORCES[:2]
    sim = converged_simulator("rolling", law, integrator)
    u = np.array([push] * down + [roll] * (110 - down))
    reading = sim.rollout(u[:, None], read_after=(len(u),)).tactile[0, 0]
    assert (reading[:, 2] > 0).sum() > 20
    rng = np.random.default_rng(0)
    loss = gradient_check.RolloutLoss(sim, u, "tactile", reading)  # the gradient of ½ ‖reading‖²
    for case in (loss, gradient_check.RolloutLoss.random(sim, u, "q", rng)):
        error = gradient_check.compare_to_dual_numbers(case, rng, directions=1).error
        print(f"{law} {integrator} {case.output}: {error:.1e}")
        assert error < 1e-10


def test_check_detects_a_wrong_gradient() -> None:
    sim, u = scene_in_contact("rolling", "viscous", "bdf1", np.random.default_rng(0))
    case = gradient_check.RolloutLoss.random(sim, u, "v", np.random.default_rng(1))
    wrong = gradient_check.RolloutLoss(sim, u * (1 + 1e-3), case.output, case.weights)
    _, right, other = *gradient_check.reverse_gradient(case), gradient_check.reverse_gradient(wrong)[1]
    assert np.linalg.norm(right["q"] - other["q"]) / np.linalg.norm(right["q"]) > 1e-6
