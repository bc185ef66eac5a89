"""Gradients through PyTorch: over a hundred steps, step by step, and with respect to fitted parameters."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.sim import torch_layer
from gelflow.sim.scene import FRICTION_LAWS, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import converged_simulator, scene_in_contact

OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")


def rollout_loss(sim: Simulator, u: torch.Tensor, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    state = torch_layer.torch_state(sim)
    state = torch_layer.TorchState(q, v, state.anchors, state.anchored, state.history)
    run = torch_layer.torch_rollout(sim, state, u, read_after=(len(u) // 2, len(u)))
    return (run.q[-1] ** 2).sum() + (run.v**2).mean() + 10 * (run.tactile**2).sum()


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("name", ("rolling", "insertion"))
def test_gradient_over_a_hundred_steps(name: str, law: str) -> None:
    """dL/du, dL/dq0 and dL/dv0 of a loss with tactile terms agree with central differences along random directions.

    Stencils with other contact modes than the base run at any of the 100 steps are skipped and counted.
    """
    rng = np.random.default_rng(7)
    sim, u = scene_in_contact(name, law, "bdf1", rng)
    controls = torch.tensor(np.repeat(u.mean(0)[None, None], 100, axis=0), requires_grad=True)
    q = torch.tensor(sim.q.copy(), requires_grad=True)
    v = torch.tensor(sim.v.copy(), requires_grad=True)
    before = sim.q.copy()
    rollout_loss(sim, controls, q, v).backward()
    assert np.array_equal(sim.q, before), "a layer must not change the simulator's own state"
    signature = sim.contact_modes(sim.rollout(controls.detach().numpy(), read_after=(50, 100)))
    straight = torch.ones_like(q)
    for at_q, _ in gradient_check.quaternion_joints(sim.model):
        straight[:, at_q : at_q + 4] = 0  # components of a quaternion cannot be displaced individually
    kept = 0
    for tensor, size, mask in ((controls, 1e-6, 1.0), (q, 1e-8, straight), (v, 1e-6, 1.0)):
        for _ in range(5):
            d = torch.tensor(rng.normal(size=tuple(tensor.shape))) * mask
            for shrink in (1.0, 0.1, 0.01):
                moved = [
                    [x.detach() + (sign * shrink * size * d if x is tensor else 0) for x in (controls, q, v)]
                    for sign in (-1, 1)
                ]
                ends = [sim.rollout(a.numpy(), q=b.numpy(), v=c.numpy(), read_after=(50, 100)) for a, b, c in moved]
                if all((sim.contact_modes(end) == signature).all() for end in ends):
                    low, high = (float(rollout_loss(sim, *x)) for x in moved)
                    assert tensor.grad is not None
                    ours = float((tensor.grad * d).sum())
                    rounding = 1e-13 / (shrink * size)  # of two losses with states accurate to 1e-13
                    assert abs((high - low) / (2 * shrink * size) - ours) < 1e-4 * abs(ours) + rounding
                    kept += 1
                    break
    # Nearly every stencil over a hundred steps of stick and slip at 400 points crosses a kink: differences cover the
    # remaining ones of 15 directions, dual numbers all.
    assert kept >= 8
    for output in OUTPUTS:
        case = gradient_check.RolloutLoss.random(sim, controls.detach().numpy()[:, 0], output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=1, groups=False).error < 1e-6


def test_gradient_is_that_of_the_controls_of_the_rollout() -> None:
    """Controls that change after the forward pass, here to values that are clipped, do not change the gradient."""
    sim, u = scene_in_contact("insertion", "elastic", "bdf1", np.random.default_rng(3))
    controls = torch.tensor(u[:3, None], requires_grad=True)
    positions = torch_layer.torch_rollout(sim, torch_layer.torch_state(sim), controls).q.sum()
    before = torch.autograd.grad(positions, controls, retain_graph=True)[0]
    with torch.no_grad():
        controls.fill_(1e6)
    assert before.abs().max() > 0
    assert torch.equal(torch.autograd.grad(positions, controls)[0], before)


def test_single_steps_equal_the_rollout() -> None:
    sim, u = scene_in_contact("insertion", "elastic", "bdf1", np.random.default_rng(3))
    controls = torch.tensor(np.repeat(u[:, None], 4, axis=0), requires_grad=True)
    state = torch_layer.torch_state(sim)
    whole = torch_layer.torch_rollout(sim, state, controls, read_after=(len(controls),))
    gradient_whole = torch.autograd.grad((whole.tactile**2).sum(), controls)[0]
    for row in controls:
        state, tactile = torch_layer.torch_step(sim, state, row)
    gradient_steps = torch.autograd.grad((tactile**2).sum(), controls)[0]
    assert torch.equal(whole.tactile[0], tactile)
    assert torch.allclose(gradient_whole, gradient_steps, rtol=1e-9, atol=1e-9)


def test_invalid_tensors_raise() -> None:
    sim = converged_simulator("rolling", "viscous", "bdf1")
    state = torch_layer.torch_state(sim)
    with pytest.raises(UsageError, match=r"u must be a CPU tensor of torch\.float64"):
        torch_layer.torch_rollout(sim, state, torch.zeros((1, 1, 3), dtype=torch.float32))
    with pytest.raises(UsageError, match="u must have shape"):
        torch_layer.torch_rollout(sim, state, torch.zeros((1, 1, 5), dtype=torch.float64))
    with pytest.raises(UsageError, match="not finite"):
        torch_layer.torch_rollout(sim, state, torch.full((1, 1, 3), float("nan"), dtype=torch.float64))


def test_fit_recovers_stiffness_and_position() -> None:
    """Marker stiffness and pad position on the finger, from marker forces of a run with other values."""
    sim, u = scene_in_contact("rolling", "viscous", "bdf1", np.random.default_rng(5))
    controls, state = torch.from_numpy(np.repeat(u[:, None], 2, axis=0)), torch_layer.torch_state(sim)
    kept = sim.params.copy()

    def readings(stiffness: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        params = {"pad.kn": stiffness, "pad.markers.pos.x": place}
        return torch_layer.torch_rollout(sim, state, controls, read_after=(2, 4, 6), params=params).tactile

    with torch.no_grad():
        recorded = readings(torch.tensor(1.3, dtype=torch.float64), torch.tensor(0.7e-3, dtype=torch.float64))
    unknown = torch.tensor([1.0, 0.0], dtype=torch.float64, requires_grad=True)  # stiffness factor, offset [mm]
    optimizer = torch.optim.LBFGS([unknown], lr=1, max_iter=60, tolerance_change=1e-14, line_search_fn="strong_wolfe")

    def closure() -> float:
        optimizer.zero_grad()
        loss = 1e4 * ((readings(unknown[0], unknown[1] * 1e-3) - recorded) ** 2).sum()
        loss.backward()
        return float(loss.detach())

    first = closure()
    optimizer.step(closure)
    assert closure() < 1e-8 * first
    np.testing.assert_allclose(unknown.detach(), [1.3, 0.7], rtol=1e-4)
    assert np.array_equal(sim.params, kept), "the simulator's own parameters stay"


def test_parameters_of_environments_have_individual_gradients() -> None:
    one, u = scene_in_contact("pushing", "viscous", "bdf1", np.random.default_rng(2))
    sim = Simulator(one.model, num_envs=3)
    for name in ("q", "v", "params"):
        getattr(sim, name)[:] = getattr(one, name)
    controls = torch.from_numpy(np.repeat(u[:, None], 3, axis=1))
    kn = torch.tensor([90.0, 100.0, 110.0], dtype=torch.float64, requires_grad=True)
    common = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)
    params = {"pad_box.kn": kn, "box_ground.mu": common}
    run = torch_layer.torch_rollout(sim, torch_layer.torch_state(sim), controls, params=params)
    (run.v[-1] ** 2).sum().backward()
    assert kn.grad is not None and common.grad is not None and common.grad.shape == ()
    sim.params[:, sim.param_index["pad_box.kn"]] = kn.detach()
    trajectory = sim.rollout(controls.numpy())
    grad_v = np.zeros_like(trajectory.v)
    grad_v[-1] = 2 * trajectory.v[-1]
    expected = sim.rollout_gradient(trajectory, v=grad_v, params=True).params
    np.testing.assert_array_equal(kn.grad, expected[:, sim.param_index["pad_box.kn"]])
    assert float(common.grad) == pytest.approx(expected[:, sim.param_index["box_ground.mu"]].sum(), rel=1e-12)


def test_invalid_parameters_raise() -> None:
    sim = converged_simulator("rolling", "viscous", "bdf1")
    state, u = torch_layer.torch_state(sim), torch.zeros((1, 1, 3), dtype=torch.float64)
    for name, value, message in (
        ("pad.stiffness", torch.ones((), dtype=torch.float64), "no parameter 'pad.stiffness'"),
        ("pad.kn", torch.ones(2, dtype=torch.float64), r"pad\.kn must have shape \(1,\) or \(\), got \(2,\)"),
        ("pad.kn", torch.ones(1), r"pad\.kn must be a CPU tensor of torch\.float64"),
        ("pad.kn", torch.full((1,), torch.nan, dtype=torch.float64), r"pad\.kn is not finite"),
    ):
        with pytest.raises(UsageError, match=message):
            torch_layer.torch_rollout(sim, state, u, params={name: value})


@pytest.mark.parametrize("length", [0.5, 1.0, 2.0])
def test_gradient_by_a_quaternion_of_any_length(length: float) -> None:
    """A step and the poses of sites normalize it."""
    sim = Simulator(load_scene("rolling"))
    state, u = torch_layer.torch_state(sim), torch.zeros((1, 3), dtype=torch.float64)
    first, chosen = sim.joint_q("ball") + 3, torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)

    def orientation(quaternion: torch.Tensor) -> torch.Tensor:
        q = torch.cat([state.q[:, :first], quaternion[None], state.q[:, first + 4 :]], 1)
        return (torch_layer.torch_step(sim, replace(state, q=q), u)[0].q[0, first : first + 4] * chosen).sum()

    start = (length * torch.tensor([0.8, 0.6, 0.0, 0.0], dtype=torch.float64)).requires_grad_()
    (gradient,) = torch.autograd.grad(orientation(start), start)
    differences = [orientation(start.detach() + d) - orientation(start.detach() - d) for d in 1e-6 * torch.eye(4)]
    np.testing.assert_allclose(gradient, torch.stack(differences) / 2e-6, atol=1e-8)


def test_forces_do_not_depend_on_the_length_of_a_quaternion() -> None:
    """Before the first step too, and with the gradient of a site's pose."""
    sim = Simulator(load_scene("grasp"), num_envs=2)
    first = sim.joint_q("bar") + 3
    sim.q[1, first : first + 4] *= 1.2
    for values in (sim.tactile(), sim.wrenches(), sim.site_poses(), sim.poses()):
        np.testing.assert_allclose(values[0], values[1], rtol=1e-12, atol=1e-12)


def test_threads_on_one_simulator_are_refused_and_change_no_parameters() -> None:
    sim = Simulator(load_scene("pushing"), num_envs=16, threads=1)
    state, u = torch_layer.torch_state(sim), torch.zeros((5, 16, sim.model.nu), dtype=torch.float64)
    u[:, :, sim.scene.u("box_x")] = 2

    def end(mass: float) -> torch.Tensor:
        params = {"box.mass": torch.tensor(mass, dtype=torch.float64)}
        return torch_layer.torch_rollout(sim, state, u, params=params).q[-1]

    masses, mass = (0.2, 0.3), float(sim.param("box.mass")[0])
    expected = [end(mass) for mass in masses]
    refused = 0
    with ThreadPoolExecutor(2) as pool:
        jobs = [(k, pool.submit(end, masses[k])) for k in [0, 1] * 100]
        for k, job in jobs:
            try:
                assert torch.equal(job.result(), expected[k])
            except UsageError as error:
                assert "busy" in str(error)
                refused += 1
    assert refused < 200 and (sim.param("box.mass") == mass).all()
