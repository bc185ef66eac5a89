"""Gradients through couplings, loop closures and tendons, compared with dual numbers and central differences."""

import numpy as np
import pytest

from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.coupled_mechanism import coupled_mechanism

OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_gradients_of_a_coupled_mechanism(law: str, integrator: str) -> None:
    skipped = []
    for seed, output in enumerate(OUTPUTS):
        rng = np.random.default_rng(seed)
        sim, u = coupled_mechanism(law, integrator, rng)
        assert sim.tactile().any()
        case = gradient_check.RolloutLoss.random(sim, u, output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10
        agreement = gradient_check.compare_to_differences(case)
        assert agreement.error < 1e-6
        skipped.append(agreement.skipped)
    assert np.mean(skipped) <= 0.05


def test_states_that_break_a_coupling_have_gradients_too() -> None:
    """The position set for a follower has no effect, and its gradient is 0."""
    rng = np.random.default_rng(3)
    sim, u = coupled_mechanism("viscous", "bdf2", rng)
    lift = sim.joint_q("lift")
    sim.q[0, lift] += 0.1
    case = gradient_check.RolloutLoss.random(sim, u, "v", rng)
    assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10
    _, gradient = gradient_check.reverse_gradient(case)
    assert gradient["q"][sim.joint_v("lift")] == 0
