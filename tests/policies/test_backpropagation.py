"""Back-propagation through time, on a point that moves to a target, and on the pushing task."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tests.policies.toy_tasks import PointTask

from gelflow.errors import UsageError
from gelflow.policies.backpropagation import Backpropagation, BackpropagationSettings, limited, run_episodes
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.training.state import load_state, save_state
from gelflow.sim.tasks.differentiable_pushing import DifferentiablePushing
from gelflow.sim.tasks.pushing import Pushing, PushingTask


class Point:
    """A point on a line; an action of ±1 moves it by 0.2. The reward is minus its squared distance to 0."""

    max_steps = 10

    def __init__(self, count: int) -> None:
        self.task = PointTask(count)
        self.errors = np.zeros((count, 1))
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        self.observation = torch.from_numpy(rng.uniform(-1, 1, (self.task.num_envs, 1)))
        self.failed = np.zeros(self.task.num_envs, dtype=bool)

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        self.observation = self.observation + 0.2 * actions
        self.errors[:] = np.abs(self.observation.detach().numpy())
        return -(self.observation**2).sum(1)

    def detach(self) -> None:
        self.observation = self.observation.detach()


def learner(updates: int = 60, *, seed: int = 0, window: int = 100, rate: float = 0.005) -> Backpropagation:
    settings = BackpropagationSettings(window=window, learning_rate=rate)
    return Backpropagation(Point(16), MLP((1,), 1, hidden=(16,)), settings, seed=seed, steps=updates * 160)


def error(actor_of: Backpropagation) -> float:
    """Mean distance at the end of 200 episodes that are not those of the training."""
    point = Point(200)
    run_episodes(point, actor_of.actor, np.random.default_rng(9), window=None)
    return float(point.errors.mean())


@pytest.mark.parametrize("window", [10, 3])
def test_training_finds_the_target(window: int) -> None:
    training = learner(window=window, rate=0.02)
    before = error(training)
    numbers = [training.update() for _ in range(60)]
    assert before > 0.3 and error(training) < 0.03
    assert numbers[-1]["return"] > numbers[0]["return"] and training.steps == 60 * 160
    assert set(numbers[0]) == set(Backpropagation.columns)


def test_resumed_training_continues_bit_for_bit(tmp_path: Path) -> None:
    whole, first, second = learner(6), learner(6), learner(6, seed=1)
    for _ in range(6):
        whole.update()
    for _ in range(3):
        first.update()
    save_state(tmp_path / "state.safetensors", first.state())
    second.load(load_state(tmp_path / "state.safetensors"))
    for _ in range(3):
        second.update()
    for name, values in whole.tensors().items():
        np.testing.assert_array_equal(values, second.tensors()[name])


def test_limit_has_the_gradient_of_its_input() -> None:
    outputs = torch.tensor([[-3.0, 0.5, 2.0]], requires_grad=True)
    actions = limited(outputs)
    assert actions.tolist() == [[-1, 0.5, 1]]
    actions.sum().backward()
    assert outputs.grad is not None and outputs.grad.tolist() == [[1, 1, 1]]


def test_gradient_of_an_episode_is_that_of_its_return() -> None:
    """Finite differences of the return of pushing, by a weight of a recurrent policy."""
    episodes = DifferentiablePushing(Pushing(2, task=PushingTask(max_steps=6), threads=1))
    architecture = MLP((393,), 3, 8, hidden=(8,))
    training = Backpropagation(episodes, architecture, BackpropagationSettings(), seed=0, steps=1)
    bias = training.actor.head.bias
    with torch.no_grad():
        bias[0] = 0.8
    run_episodes(episodes, training.actor, np.random.default_rng(0), window=100)
    assert bias.grad is not None
    gradient, returns = float(bias.grad[0]), []
    for change in (1e-3, -1e-3):
        with torch.no_grad():
            bias[0] = 0.8 + change
        returns.append(run_episodes(episodes, training.actor, np.random.default_rng(0), window=None).mean())
    assert gradient == pytest.approx(-(returns[0] - returns[1]) / 2e-3 / 6, rel=2e-2)


def test_observations_of_another_shape_are_refused() -> None:
    with pytest.raises(UsageError, match=r"the task observes \(1,\); the network takes \(2,\)"):
        Backpropagation(Point(2), MLP((2,), 1), BackpropagationSettings(), seed=0, steps=1)
