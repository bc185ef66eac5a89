"""The pushing task: observation, reward, disturbance, and the same episode with gradients."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.sim.tasks.differentiable_pushing import DifferentiablePushing
from gelflow.sim.tasks.pushing import (
    BOXES,
    DEFAULT_RANDOMIZATION,
    FULL_RANDOMIZATION,
    Pushing,
    PushingState,
    PushingTask,
)


def started(count: int = 2, *, task: PushingTask | None = None, **options: object) -> Pushing:
    batch = Pushing(count, task=task or PushingTask(), threads=1)
    batch.reset(batch.all, np.random.default_rng(0), options=options)
    return batch


def test_episodes_start_as_published() -> None:
    batch = started(2000, task=PushingTask(observation="privileged"))
    x, y, yaw = batch.goal.T
    assert x.min() == pytest.approx(0.15, abs=1e-3) and x.max() == pytest.approx(0.25, abs=1e-3)
    assert np.abs(y).max() <= 0.2 and np.abs(yaw - np.pi * y).max() <= np.pi / 16
    state = batch.state(batch.sim.q, batch.sim.tactile())
    along = state.box[:, 1] - state.finger[:, 1]
    assert np.abs(along).max() <= 0.02 and along.std() == pytest.approx(0.02 / 3**0.5, rel=0.05)
    np.testing.assert_allclose(state.box[:, 0] - 0.025 - state.finger[:, 0], 0.5e-3, atol=1e-9)


def test_pad_position_is_that_of_the_simulator() -> None:
    batch = started(3)
    batch.sim.q[:, :3] = np.random.default_rng(1).uniform(-0.3, 0.3, (3, 3))
    pose = batch.sim.poses()[:, batch.scene.body("gripper")]
    expected = pose[:, :2] + 0.0055 * np.stack([1 - 2 * pose[:, 6] ** 2, 2 * pose[:, 3] * pose[:, 6]], axis=1)
    np.testing.assert_allclose(batch.state(batch.sim.q, batch.sim.tactile()).finger[:, :2], expected, atol=1e-12)


def test_reward_is_eq_25() -> None:
    """The finger is 3 mm beyond the closest side of the box, 4 mm beside the centre of that side."""
    turned = np.pi / 6
    ahead, left = np.array([np.cos(turned), np.sin(turned)]), np.array([-np.sin(turned), np.cos(turned)])
    box = np.array([[0.1, 0.05, turned]])
    finger = box[:, :2] - (0.025 + 0.003) * ahead + 0.004 * left
    state = PushingState(
        finger=np.column_stack([finger, [turned]]),
        box=box,
        goal=box + np.array([[0.03, 0.04, np.pi / 18]]),
        half_size=np.array([[0.025, 0.025]]),
        mass=np.array([0.075]),
        forces=np.zeros((1, 130, 3)),
    )
    expected = -0.01 * 25 - 0.1 * 4 - (0.005 / 0.02) ** 2 - 0.1 * 0.75
    np.testing.assert_allclose(PushingTask().reward(state, np.full((1, 3), 0.5)), [expected])


def test_observation_depends_on_the_mode_only_in_its_last_part() -> None:
    goal = (0.2, 0.1, 0.3)
    frames = {
        mode: started(task=PushingTask(observation=mode), goal=goal, offset=0.01).observation
        for mode in ("tactile", "privileged", "none")
    }
    assert [frames[mode].shape[1] for mode in frames] == [393, 9, 3]
    for mode in frames:
        np.testing.assert_array_equal(frames[mode][:, :3], frames["none"])
    assert not frames["tactile"][:, 3:].any()
    np.testing.assert_allclose(frames["privileged"][0, 3:], [0.0255 / 0.02, 0.5, 0, 1.25, 1.25, 0.75], rtol=1e-6)


def test_history_holds_the_latest_frames() -> None:
    batch, rng = started(task=PushingTask(observation="none", history=3)), np.random.default_rng(0)
    frames = [batch.observation[:, :3].copy()]
    np.testing.assert_array_equal(batch.observation, np.tile(frames[0], (1, 3)))
    for _ in range(3):
        batch.step(np.tile([0.5, 0.2, 0.1], (2, 1)), rng)
        frames.insert(0, batch.observation[:, :3].copy())
    np.testing.assert_array_equal(batch.observation, np.concatenate(frames[:3], axis=1))
    kept = batch.observation[1].copy()
    batch.reset(np.array([True, False]), rng)
    np.testing.assert_array_equal(batch.observation[1], kept)
    np.testing.assert_array_equal(batch.observation[0], np.tile(batch.observation[0, :3], 3))


def test_external_force_changes_every_ten_periods() -> None:
    batch = started(500)
    steps = np.arange(100)
    forces = np.stack([batch.controls(np.zeros((500, 3)), np.full(500, step))[:, 3:5] for step in steps], axis=1)
    np.testing.assert_array_equal(forces, np.repeat(forces[:, ::10], 10, axis=1))
    idle = (forces == 0).all(2)
    assert idle.mean() == pytest.approx(0.5, abs=0.03) and np.abs(forces).max() == pytest.approx(0.2, abs=1e-3)
    assert abs(forces[~idle]).mean() == pytest.approx(0.1, rel=0.05)


def test_friction_holds_the_box_against_the_external_force() -> None:
    """Under the elastic law the force of the released data leaves the box where it is; the printed ±1 N moves it."""
    moved = []
    for force in (0.2, 1.0):
        batch = Pushing(64, task=PushingTask(force=force, no_force=0.0), friction="elastic", threads=1)
        rng = np.random.default_rng(0)
        batch.reset(batch.all, rng)
        start = batch.sim.q[:, [3, 4]].copy()
        for _ in range(40):
            batch.step(np.tile([-1.0, 0, 0], (64, 1)), rng)  # the finger retreats
        moved.append(np.linalg.norm(batch.sim.q[:, [3, 4]] - start, axis=1))
    assert moved[0].max() < 6e-3 and np.median(moved[1]) > 0.02


def test_boxes_of_other_sizes_and_masses() -> None:
    batch, rng = Pushing(200, randomization=BOXES, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    assert batch.half_size.min() < 0.021 and batch.half_size.max() > 0.034
    np.testing.assert_allclose(batch.sim.param("box.points.scale.x") * 0.025, batch.half_size[:, 0])
    inertia = batch.mass * (batch.half_size**2).sum(1) / 3
    np.testing.assert_allclose(batch.sim.param("box.inertia.zz"), inertia)
    for _ in range(20):
        batch.step(np.tile([0.8, 0, 0], (200, 1)), rng)
    assert not batch.info["failed"].any() and (batch.sim.q[:, 3] > batch.half_size[:, 0] - 0.025 + 1e-3).all()


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_gradient_agrees_with_finite_differences(friction: str) -> None:
    """Derivative of the return along a random change of all actions."""
    task = PushingTask(max_steps=12, history=2)
    env = DifferentiablePushing(Pushing(3, task=task, friction=friction, threads=1))
    generator = torch.Generator().manual_seed(0)
    actions = torch.tensor([0.7, 0.05, 0.02], dtype=torch.float64).repeat(12, 3, 1).requires_grad_()
    change = torch.randn(12, 3, 3, generator=generator, dtype=torch.float64) * 0.2

    def returns(values: torch.Tensor) -> torch.Tensor:
        env.reset(np.random.default_rng(3))
        total = torch.zeros(3, dtype=torch.float64)
        for action in values:
            seen = env.observation.mean(1)  # the gradient also passes through the observation
            total = total + env.step(action + 0.01 * seen[:, None])
        return total

    gradient = torch.autograd.grad(returns(actions).sum(), actions)[0]
    with torch.no_grad():
        difference = (returns(actions + 1e-6 * change) - returns(actions - 1e-6 * change)) / 2e-6
    np.testing.assert_allclose((gradient * change).sum((0, 2)).numpy(), difference.numpy(), rtol=2e-4)


def test_differentiable_episode_equals_that_of_the_batch() -> None:
    task = PushingTask(history=2)
    env = DifferentiablePushing(Pushing(2, task=task, randomization=FULL_RANDOMIZATION, threads=1))
    batch = Pushing(2, task=task, randomization=FULL_RANDOMIZATION, threads=1)
    rng, actions = np.random.default_rng(4), np.array([[0.9, 0.1, 0.05], [0.8, -0.1, -0.05]])
    batch.reset(batch.all, rng)
    env.reset(np.random.default_rng(4))
    for step in range(15):
        batch.step(actions, rng)
        reward = env.step(torch.from_numpy(actions))
        np.testing.assert_allclose(reward.numpy(), batch.reward, rtol=1e-12)
        np.testing.assert_allclose(env.observation.numpy(), batch.observation, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(env.errors[:, 0], batch.info["position_error"], rtol=1e-12, err_msg=str(step))


def test_a_failed_environment_rests_with_rewards_and_gradients_of_zero() -> None:
    env = DifferentiablePushing(Pushing(2, threads=1))
    action = torch.tensor([[0.9, 0.1, 0.0], [0.9, 0.1, 0.0]], dtype=torch.float64)
    env.step(action)
    env.failed[0] = True
    rests = env._state.q[0].clone()
    actions = action.clone().requires_grad_()
    rewards = env.step(actions) + env.step(actions)
    gradient = torch.autograd.grad(rewards.sum(), actions)[0]
    assert rewards[0] == 0 and rewards[1] != 0 and not gradient[0].any() and gradient[1].any()
    assert torch.equal(env._state.q[0], rests) and env.failed.tolist() == [True, False]


@pytest.mark.parametrize("options", [{"mass": -1.0}, {"half_size": (0.02, 0.0)}, {"goal": (0.1, 0.2)}, {"size": 1.0}])
def test_a_refused_reset_changes_nothing(options: dict[str, object]) -> None:
    batch, rng = Pushing(4, randomization=FULL_RANDOMIZATION, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    before = {name: values.copy() for name, values in batch.quantities.items()}
    params, gain, state = batch.sim.params.copy(), batch._sensors.gain.copy(), rng.bit_generator.state
    with pytest.raises(UsageError, match="reset"):
        batch.reset(batch.all, rng, options=options)
    assert all(np.array_equal(batch.quantities[name], values) for name, values in before.items())
    assert np.array_equal(batch.sim.params, params) and np.array_equal(batch._sensors.gain, gain)
    assert rng.bit_generator.state == state


def test_detached_steps_have_no_gradient_to_earlier_actions() -> None:
    env = DifferentiablePushing(Pushing(1, threads=1))
    first = torch.tensor([[0.9, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    env.step(first)
    env.detach()
    second = torch.tensor([[0.9, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    gradients = torch.autograd.grad(env.step(second).sum(), (first, second), allow_unused=True)
    assert gradients[0] is None and gradients[1].abs().sum() > 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PushingTask(observation="touch"), "observation must be one of tactile, privileged, none, got 'touch'"),
        (lambda: PushingTask(history=0), "history must be at least 1, got 0"),
        (lambda: DEFAULT_RANDOMIZATION.replace(size=0.03), "no quantity 'size'"),
        (lambda: started(goal=(0.2, 0.1)), r"goal must be finite, of shape \(3,\) or \(2, 3\)"),
    ],
)
def test_bad_settings_are_named(make: Callable[[], object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()


def test_picture_of_the_box_and_its_goal() -> None:
    picture = started(1).render(0)
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_actions_beyond_the_limits_of_the_actuators_are_refused() -> None:
    with pytest.raises(UsageError, match="action_scale must be within the limits of the actuators"):
        Pushing(1, task=PushingTask(action_scale=(2.0, 1.0, 3.0)), threads=1)
