"""Gradients of reduced readings and of rollouts with a touch stop."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gelflow.sim import reductions, torch_layer
from gelflow.sim.reductions import TactileReduction
from gelflow.sim.scene import FRICTION_LAWS, Scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.trajectory import TouchStop
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import scene_in_contact

OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")


def all_rows(scene: Scene) -> TactileReduction:
    """Forces, moments, mean shear and random rows of all pads."""
    rng = np.random.default_rng(3)
    random = TactileReduction(rng.normal(size=(4, scene.num_markers, 3)), tuple("abcd"))
    parts = [reductions.pad_forces(scene), reductions.pad_moments(scene), reductions.mean_shear(scene), random]
    return TactileReduction.concatenate(parts)


def stopping(sim: Simulator, u: NDArray[np.float64]) -> TouchStop:
    """A stop after the second of three steps."""
    stop = TouchStop(0.0)
    assert sim.rollout(u[:, None], stop=stop).stopped_at.tolist() == [1], "the case needs a shear that changes"
    return TouchStop(0.0, after_step=2)


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", ("rolling", "insertion", "dclaw"))
def test_gradients_of_reduced_readings(name: str, law: str) -> None:
    rng = np.random.default_rng(11)
    sim, u = scene_in_contact(name, law, "bdf1", rng)
    case = gradient_check.RolloutLoss.random(sim, u, "tactile", rng, reduction=all_rows(sim.scene))
    assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10
    agreement = gradient_check.compare_to_differences(case, params=name == "rolling")
    assert agreement.error < 1e-6
    assert agreement.skipped <= 0.05


@pytest.mark.parametrize("integrator", ("bdf1", "bdf2"))
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", ("rolling", "insertion"))
def test_gradients_of_stopped_rollouts(name: str, law: str, integrator: str) -> None:
    """A rollout that stopped is differentiated as the steps that it took."""
    for output in OUTPUTS:
        rng = np.random.default_rng(12)
        sim, u = scene_in_contact(name, law, integrator, rng)
        case = gradient_check.RolloutLoss.random(sim, u, output, rng, stop=stopping(sim, u))
        trajectory, gradient = gradient_check.reverse_gradient(case)
        assert trajectory.stopped_at.tolist() == [2]
        assert gradient["u"][:2].any() and not gradient["u"][2:].any()
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=1, groups=False).error < 1e-10
        agreement = gradient_check.compare_to_differences(case, params=False)
        assert agreement.error < 1e-6
        assert agreement.skipped <= 0.05


def test_reduced_gradient_equals_that_of_the_markers() -> None:
    """The same loss on reduced readings and on marker forces, also in single precision and for later readings."""
    rng = np.random.default_rng(5)
    one, u = scene_in_contact("insertion", "elastic", "bdf1", rng)
    reduction = all_rows(one.scene)
    reads, stop = (0, 1, 2, 3), TouchStop(0.0, after_step=2)
    weights = rng.normal(size=(len(reads), 1, len(reduction.names)))
    found: dict[Any, Any] = {}
    for precision in ("double", "single"):
        sim = Simulator(one.scene, precision=precision)
        for name in ("q", "v", "anchors", "anchored"):
            getattr(sim, name)[:] = getattr(one, name)
        options: dict[str, Any] = {"read_after": reads, "stop": stop}
        full = sim.rollout(u[:, None], **options)
        reduced = sim.rollout(u[:, None], **options, reduction=reduction)
        tolerance = 1e-12 if precision == "double" else 1e-5
        scale = np.abs(reduced.tactile).max()
        np.testing.assert_allclose(reduced.tactile, reduction(full.tactile), rtol=0, atol=tolerance * scale)
        by_markers = np.tensordot(weights, reduction.matrix, axes=(2, 0))
        ours = sim.rollout_gradient(reduced, tactile=weights, params=True)
        theirs = sim.rollout_gradient(full, tactile=by_markers, params=True)
        for name in ("u", "q", "v", "anchors", "params"):
            a, b = getattr(ours, name), getattr(theirs, name)
            np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(np.abs(b).max(), 1e-30), err_msg=name)
        found[precision] = ours
    u_double, u_single = found["double"].u, found["single"].u
    assert np.linalg.norm(u_single - u_double) < 0.02 * np.linalg.norm(u_double)


def test_torch_rollout_with_reduction_and_stop() -> None:
    rng = np.random.default_rng(6)
    sim, u = scene_in_contact("insertion", "elastic", "bdf1", rng)
    reduction = all_rows(sim.scene)
    controls = torch.tensor(u[:, None], requires_grad=True)
    state = torch_layer.torch_state(sim)
    stop = TouchStop(0.0, after_step=2)
    run = torch_layer.torch_rollout(sim, state, controls, read_after=(1, 3), reduction=reduction, stop=stop)
    assert run.stopped_at.tolist() == [2]
    assert run.tactile.shape == (2, 1, len(reduction.names))
    gradient = torch.autograd.grad((run.tactile**2).sum() + run.end.q.sum(), controls)[0]
    taken = torch.tensor(u[:2, None], requires_grad=True)
    plain = torch_layer.torch_rollout(sim, state, taken, read_after=(1, 2))
    expected = torch.autograd.grad((reduction(plain.tactile) ** 2).sum() + plain.end.q.sum(), taken)[0]
    torch.testing.assert_close(gradient[:2], expected, rtol=1e-9, atol=1e-12)
    assert not gradient[2:].any()


def test_resting_environments_in_torch() -> None:
    one, u = scene_in_contact("pushing", "viscous", "bdf1", np.random.default_rng(2))
    sim = Simulator(one.model, num_envs=2)
    for name in ("q", "v"):
        getattr(sim, name)[:] = getattr(one, name)
    state = torch_layer.torch_state(sim)
    controls = torch.tensor(np.repeat(u[:, None], 2, axis=1), requires_grad=True)
    run = torch_layer.torch_rollout(sim, state, controls, active=[True, False])
    assert torch.equal(run.end.q[1], state.q[1]) and not torch.equal(run.end.q[0], state.q[0])
    gradient = torch.autograd.grad((run.v[-1] ** 2).sum(), controls)[0]
    assert gradient[:, 0].any() and not gradient[:, 1].any()


def test_a_detached_state_ends_the_gradient() -> None:
    """Two windows: the gradient of the second with respect to the first is cut, its own is unchanged."""
    sim, u = scene_in_contact("insertion", "elastic", "bdf1", np.random.default_rng(4))
    controls = torch.tensor(u[:, None], requires_grad=True)
    start = torch_layer.torch_state(sim)
    middle = torch_layer.torch_rollout(sim, start, controls[:2]).end
    gradients = []
    for state in (middle, middle.detach()):
        end = torch_layer.torch_rollout(sim, state, controls[2:]).end
        gradients.append(torch.autograd.grad((end.v**2).sum(), controls, retain_graph=True)[0])
    whole, window = gradients
    assert whole[:2].any() and not window[:2].any()
    assert torch.equal(whole[2:], window[2:])


def test_center_of_pressure_has_gradients_without_contact() -> None:
    force = torch.zeros((2, 3), dtype=torch.float64)
    force[0] = torch.tensor([0.1, 0.2, -2.0])
    force.requires_grad_()
    moment = torch.tensor([[0.002, -0.004, 0.0]] * 2, dtype=torch.float64, requires_grad=True)
    center = reductions.center_of_pressure(force, moment)
    np.testing.assert_allclose(center.detach(), [[-0.002, -0.001], [0.0, 0.0]], rtol=1e-12)
    np.testing.assert_array_equal(
        center.detach(), reductions.center_of_pressure(force.detach().numpy(), moment.detach().numpy())
    )
    by_force, by_moment = torch.autograd.grad(center.sum(), (force, moment))
    assert torch.isfinite(by_force).all() and by_moment[0].any() and not by_moment[1].any()
