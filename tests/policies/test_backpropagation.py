"""Back-propagation through time, on a point that moves to a goal, and on the pushing task."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.backpropagation import (
    BackpropagationSettings,
    BackpropagationTrainer,
    EpochResult,
    evaluate,
    limited,
)
from gelflow.policies.networks.mlp import MLP
from gelflow.sim.tasks.differentiable_pushing import DifferentiablePushing
from gelflow.sim.tasks.pushing import Pushing, PushingTask


class Point:
    """A point on a line; an action of ±1 moves it by 0.2. The reward is minus its squared distance to 0."""

    max_steps = 10

    def __init__(self, count: int) -> None:
        self.count = count
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        self.observation = torch.from_numpy(rng.uniform(-1, 1, (self.count, 1)))
        self.failed = np.zeros(self.count, dtype=bool)

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        self.observation = self.observation + 0.2 * actions
        self.errors: NDArray[np.float64] = np.abs(self.observation.detach().numpy()).astype(np.float64)
        return -(self.observation**2).sum(1)

    def detach(self) -> None:
        self.observation = self.observation.detach()


def trainer(epochs: int = 60, **settings: float) -> BackpropagationTrainer:
    chosen = BackpropagationSettings(epochs=epochs, **settings)  # type: ignore[arg-type]
    return BackpropagationTrainer(Point(16), MLP((1,), 1, hidden=(16,)), chosen)


@pytest.mark.parametrize("window", [10, 3])
def test_training_finds_the_goal(window: int) -> None:
    training = trainer(window=window, learning_rate=0.02)
    untrained = evaluate(Point(200), training.actor, np.random.default_rng(9))
    training.run()
    trained = evaluate(Point(200), training.actor, np.random.default_rng(9))
    assert untrained.errors[0] > 0.3 and trained.errors[0] < 0.03
    assert trained.returns > untrained.returns and trained.gradient_norm == 0


def test_resumed_training_continues_bit_for_bit() -> None:
    whole = trainer(epochs=6)
    whole.run()
    first = trainer(epochs=6)
    for _ in range(3):
        first.run_epoch()
    second = trainer(epochs=6, seed=0)
    second.load_state_dict(first.state_dict())
    results: list[EpochResult] = []
    second.run(results.append)
    assert [result.epoch for result in results] == [4, 5, 6]
    for name, values in whole.actor.tensors().items():
        np.testing.assert_array_equal(values, second.actor.tensors()[name])


def test_limit_has_the_gradient_of_its_input() -> None:
    outputs = torch.tensor([[-3.0, 0.5, 2.0]], requires_grad=True)
    actions = limited(outputs)
    assert actions.tolist() == [[-1, 0.5, 1]]
    actions.sum().backward()
    assert outputs.grad is not None and outputs.grad.tolist() == [[1, 1, 1]]


def test_gradient_of_an_episode_is_that_of_its_return() -> None:
    """Finite differences of the return of pushing, by a weight of a recurrent policy."""
    task = DifferentiablePushing(Pushing(2, task=PushingTask(max_steps=6), threads=1))
    settings = BackpropagationSettings(epochs=1, max_gradient_norm=1e9, learning_rate=1e-12)
    training = BackpropagationTrainer(task, MLP((393,), 3, 8, hidden=(8,)), settings)
    bias = training.actor.head.bias
    with torch.no_grad():
        bias[0] = 0.8
    training.run_epoch()
    assert bias.grad is not None
    gradient, returns = float(bias.grad[0]), []
    for change in (1e-3, -1e-3):
        with torch.no_grad():
            bias[0] = 0.8 + change
        returns.append(evaluate(task, training.actor, np.random.default_rng(0)).returns)
    assert gradient == pytest.approx(-(returns[0] - returns[1]) / 2e-3 / 6, rel=2e-2)


def test_settings_and_shapes_are_checked() -> None:
    with pytest.raises(UsageError, match="requires epochs, window, rate and norm above 0"):
        BackpropagationSettings(epochs=0)
    with pytest.raises(UsageError, match=r"the task observes \(1,\); the network takes \(2,\)"):
        BackpropagationTrainer(Point(2), MLP((2,), 1), BackpropagationSettings())
