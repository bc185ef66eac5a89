"""Gradients of both scenes under both friction laws: exact by dual numbers, right by finite differences, and through
torch over a rollout of 100 steps."""

import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.sim import _core, gradient_check, torch_layer
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

SCENES = ("rolling", "insertion")
LAWS = ("viscous", "elastic")
INTEGRATORS = ("bdf1", "bdf2")
OUTPUTS: tuple[gradient_check.Output, ...] = ("q", "v", "tactile")


def exact_simulator(name: str, law: str, integrator: str) -> Simulator:
    """The scene with Newton's tolerance at the rounding floor: a difference must see the step, not the solver."""
    overrides = {"pads.pad.rows": 24, "pads.pad.cols": 24} if name == "rolling" else {}
    spec = _core.ModelSpec()
    load_scene(name, friction=law, overrides=overrides).describe_to(spec)
    spec.tolerance = 1e-13
    spec.integrator = integrator
    return Simulator(_core.Model(spec))


def in_contact(name: str, law: str, rng: np.random.Generator, integrator: str = "bdf1") -> tuple[Simulator, np.ndarray]:
    """A simulator in the middle of contact, and the controls that hold it there, disturbed at random."""
    sim = exact_simulator(name, law, integrator)
    if name == "rolling":
        hold, spread = np.array([0.1, 0.03, 0.2]), np.array([0.05, 0.05, 0.01])
        sim.step([0, 0, 0.2], 120)  # down onto the ball
        sim.step(hold + rng.normal(size=3) * spread, 10)
    else:
        index = {actuator: i for i, actuator in enumerate(sim.model.actuator_names)}
        q = np.array(sim.model.q0)
        start = {"arm_z": 0.0555, "finger_left": -0.0175, "finger_right": -0.0175}
        for joint, value in start.items():
            q[sim.joint_q(joint)] = value
        part = sim.joint_q("part")
        q[part : part + 3] = [0.004, 0.003, 0.0555]
        sim.q[0] = q
        sim.q[0, sim.joint_q("arm_x")], sim.q[0, sim.joint_q("arm_y")] = 0.004, 0.003
        hold = np.zeros(sim.model.nu)
        hold[[index["finger_left"], index["finger_right"]]] = 5.0
        hold[index["hold_left"]] = hold[index["hold_right"]] = -0.0175
        hold[[index["arm_x"], index["arm_y"], index["arm_z"]]] = 0.004, 0.003, 0.0585
        sim.step(hold, 20)
        hold[index["arm_z"]] -= 2e-3  # onto the rim
        spread = np.zeros(sim.model.nu)
        spread[[index[a] for a in ("arm_x", "arm_y", "arm_z")]] = 1e-3
        spread[index["arm_yaw"]] = 0.02
        spread[[index["finger_left"], index["finger_right"]]] = 0.5
        sim.step(hold + rng.normal(size=sim.model.nu) * spread, 25)
    sim.check()
    return sim, hold + rng.normal(size=(3, sim.model.nu)) * spread


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SCENES)
def test_exact_against_dual_numbers(name: str, law: str, integrator: str) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        sim, u = in_contact(name, law, rng, integrator)
        assert sim.tactile().any(), "the markers must feel something for the check to mean anything"
        for output in OUTPUTS:
            case = gradient_check.Case.random(sim, u, output, rng)
            assert gradient_check.against_dual(case, rng).error < 1e-10


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SCENES)
def test_right_against_central_differences(name: str, law: str, integrator: str) -> None:
    left_out, worst = [], 0.0
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        sim, u = in_contact(name, law, rng, integrator)
        output = OUTPUTS[seed % 3]
        agreement = gradient_check.against_differences(gradient_check.Case.random(sim, u, output, rng))
        left_out.append(agreement.left_out)
        worst = max(worst, agreement.error)
    print(f"{name} {law} {integrator}: error {worst:.1e}, left out {np.mean(left_out):.1%}")
    assert worst < 1e-6
    assert np.mean(left_out) <= 0.1


def test_the_checker_notices_a_wrong_gradient() -> None:
    sim, u = in_contact("rolling", "viscous", np.random.default_rng(0))
    case = gradient_check.Case.random(sim, u, "v", np.random.default_rng(1))
    wrong = gradient_check.Case(sim, u * (1 + 1e-3), case.output, case.weights)
    _, right, other = *gradient_check.analytic(case), gradient_check.analytic(wrong)[1]
    assert np.linalg.norm(right["q"] - other["q"]) / np.linalg.norm(right["q"]) > 1e-6


def rollout_loss(sim: Simulator, u: torch.Tensor, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    state = torch_layer.state_of(sim)
    state = torch_layer.TorchState(q, v, state.anchors, state.anchored, state.history)
    run = torch_layer.rollout(sim, state, u, read_after=(len(u) // 2, len(u)))
    return (run.q[-1] ** 2).sum() + (run.v**2).mean() + 10 * (run.tactile**2).sum()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SCENES)
def test_hundred_steps_through_torch(name: str, law: str) -> None:
    """dL/du, dL/dq0 and dL/dv0 of a loss with tactile terms, against central differences along random directions.

    Stencils that leave the branches of the middle run at any of the 100 steps are left out, and counted.
    """
    rng = np.random.default_rng(7)
    sim, u = in_contact(name, law, rng)
    controls = torch.tensor(np.repeat(u.mean(0)[None, None], 100, axis=0), requires_grad=True)
    q = torch.tensor(sim.q.copy(), requires_grad=True)
    v = torch.tensor(sim.v.copy(), requires_grad=True)
    before = sim.q.copy()
    rollout_loss(sim, controls, q, v).backward()
    assert np.array_equal(sim.q, before), "a layer must not change the simulator's own state"
    signature = sim.branches(sim.rollout(controls.detach().numpy(), read_after=(50, 100)))
    straight = torch.ones_like(q)
    for at_q, _ in gradient_check.turning_joints(sim.model):
        straight[:, at_q : at_q + 4] = 0  # a quaternion's entries can not be moved one by one
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
                if all((sim.branches(end) == signature).all() for end in ends):
                    low, high = (float(rollout_loss(sim, *x)) for x in moved)
                    assert tensor.grad is not None
                    ours = float((tensor.grad * d).sum())
                    rounding = 1e-13 / (shrink * size)  # of two losses whose states are exact to 1e-13
                    assert abs((high - low) / (2 * shrink * size) - ours) < 1e-4 * abs(ours) + rounding
                    kept += 1
                    break
    # A hundred steps of stick and slip at 400 points cross a branch within nearly any stencil: differences see what is
    # left of 15, dual numbers all of it.
    assert kept >= 8
    for output in OUTPUTS:
        case = gradient_check.Case.random(sim, controls.detach().numpy()[:, 0], output, rng)
        assert gradient_check.against_dual(case, rng, directions=1).error < 1e-6


def test_steps_one_by_one_are_the_rollout() -> None:
    sim, u = in_contact("insertion", "elastic", np.random.default_rng(3))
    controls = torch.tensor(np.repeat(u[:, None], 4, axis=0), requires_grad=True)
    state = torch_layer.state_of(sim)
    whole = torch_layer.rollout(sim, state, controls, read_after=(len(controls),))
    gradient_whole = torch.autograd.grad((whole.tactile**2).sum(), controls)[0]
    for row in controls:
        state, tactile = torch_layer.step(sim, state, row)
    gradient_steps = torch.autograd.grad((tactile**2).sum(), controls)[0]
    assert torch.equal(whole.tactile[0], tactile)
    assert torch.allclose(gradient_whole, gradient_steps, rtol=1e-9, atol=1e-9)


def test_wrong_tensors_are_refused() -> None:
    sim = exact_simulator("rolling", "viscous", "bdf1")
    state = torch_layer.state_of(sim)
    with pytest.raises(UsageError, match=r"u must be a CPU tensor of torch\.float64"):
        torch_layer.rollout(sim, state, torch.zeros((1, 1, 3), dtype=torch.float32))
    with pytest.raises(UsageError, match="u must have shape"):
        torch_layer.rollout(sim, state, torch.zeros((1, 1, 5), dtype=torch.float64))
    with pytest.raises(UsageError, match="not finite"):
        torch_layer.rollout(sim, state, torch.full((1, 1, 3), float("nan"), dtype=torch.float64))
