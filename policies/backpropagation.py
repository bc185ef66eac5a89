"""Back-propagation through time: gradient ascent on the return of episodes that are differentiable.

Each epoch simulates episodes with the policy in the loop, takes the gradient of the mean return with respect to the
policy's weights through simulator, observation and policy, and makes one step of Adam (paper, B.3).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.torch_actor import TorchActor


class DifferentiableTask(Protocol):
    """Parallel episodes that start and end together, such as `DifferentiablePushing`."""

    max_steps: int
    observation: torch.Tensor  # (N, size), differentiable
    errors: NDArray[np.float64]  # distances to the goal after the last step, (N, k), in the units of the task
    failed: NDArray[np.bool_]  # (N,), the simulation stopped

    def reset(self, rng: np.random.Generator) -> None:
        """Start new episodes."""

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        """One step with actions (N, k) in ±1; returns the rewards (N,)."""

    def detach(self) -> None:
        """Cut the graph."""


@dataclass(frozen=True)
class BackpropagationSettings:
    """Settings of a training; the defaults are published (paper, B.3), except for the window."""

    epochs: int = 300
    learning_rate: float = 0.005  # at the start; decays linearly to 0
    betas: tuple[float, float] = (0.7, 0.95)  # of Adam
    max_gradient_norm: float = 1.0
    window: int = 100  # steps through which a gradient passes; shorter windows miss late consequences of an action
    seed: int = 0

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.window < 1 or not self.learning_rate > 0 or not self.max_gradient_norm > 0:
            raise UsageError(f"back-propagation requires epochs, window, rate and norm above 0, got {self}")


@dataclass(frozen=True)
class EpochResult:
    """Results of one epoch of training, or of an evaluation; means over its episodes."""

    epoch: int
    returns: float
    errors: tuple[float, ...]  # distances to the goal at the end of the episode
    gradient_norm: float  # before clipping; nan if the epoch was skipped, 0 in an evaluation
    failed: int  # episodes whose simulation stopped


class BackpropagationTrainer:
    """Training of an actor on a differentiable task.

    Parameters
    ----------
    task: the number of its environments is the number of episodes of an epoch, 16 in the paper
    architecture: of the actor; `recurrent` units remember earlier observations
    settings: of the training
    """

    def __init__(
        self, task: DifferentiableTask, architecture: ActorArchitecture, settings: BackpropagationSettings
    ) -> None:
        size = tuple(task.observation.shape[1:])
        if size != architecture.observation_shape:
            raise UsageError(f"the task observes {size}; the network takes {architecture.observation_shape}")
        self.task = task
        self.settings = settings
        self.epoch = 0
        self._rng = np.random.default_rng(settings.seed)
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)
            self.actor = TorchActor(architecture)
        self._optimizer = torch.optim.Adam(self.actor.parameters(), settings.learning_rate, betas=settings.betas)

    def run(self, report: Callable[[EpochResult], None] | None = None) -> None:
        """All epochs that remain; `report` receives the result of each."""
        while self.epoch < self.settings.epochs:
            result = self.run_epoch()
            if report:
                report(result)

    def run_epoch(self) -> EpochResult:
        """One epoch: episodes, gradient, and a step of Adam. A gradient that is not finite is skipped."""
        settings = self.settings
        for group in self._optimizer.param_groups:
            group["lr"] = settings.learning_rate * (1 - self.epoch / settings.epochs)
        self._optimizer.zero_grad()
        returns = run_episodes(self.task, self.actor, self._rng, window=settings.window)
        norm = float(torch.nn.utils.clip_grad_norm_(self.actor.parameters(), settings.max_gradient_norm))
        if np.isfinite(norm):
            self._optimizer.step()
        self.epoch += 1
        return _result(self.epoch, self.task, returns, norm if np.isfinite(norm) else float("nan"))

    def state_dict(self) -> dict[str, Any]:
        """The state of the training, for `torch.save`; a resumed training continues bit for bit."""
        return {
            "epoch": self.epoch,
            "actor": self.actor.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue a training from its `state_dict`."""
        self.epoch = state["epoch"]
        self.actor.load_state_dict(state["actor"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._rng.bit_generator.state = state["rng"]


def run_episodes(
    task: DifferentiableTask, actor: TorchActor, rng: np.random.Generator, *, window: int | None
) -> NDArray[np.float64]:
    """Returns (N,) of one episode in each environment.

    The gradient of minus the mean return per step is added to the gradients of the actor, with the graph cut after
    every `window` steps; None computes no gradient.
    """
    task.reset(rng)
    memory = actor.initial_memory(len(task.observation))
    returns = np.zeros(len(task.observation))
    loss = torch.zeros(())
    with torch.set_grad_enabled(window is not None):
        for step in range(1, task.max_steps + 1):
            outputs, memory = actor(task.observation.to(torch.float32), memory)
            rewards = task.step(limited(outputs).to(task.observation.dtype))
            returns += rewards.detach().numpy()
            loss = loss - (rewards.mean() - excess(outputs).mean()) / task.max_steps
            if window is not None and (step % window == 0 or step == task.max_steps):
                loss.backward()
                loss, memory = torch.zeros(()), memory.detach()
                task.detach()
    return returns


def evaluate(task: DifferentiableTask, actor: TorchActor, rng: np.random.Generator) -> EpochResult:
    """Mean results of one episode in each environment, without training."""
    return _result(0, task, run_episodes(task, actor, rng, window=None), 0.0)


def limited(outputs: torch.Tensor) -> torch.Tensor:
    """Outputs limited to ±1. The gradient is that of the outputs, because the gradient of a limit is 0 beyond it."""
    return outputs + (outputs.clamp(-1, 1) - outputs).detach()


def excess(outputs: torch.Tensor) -> torch.Tensor:
    """Cost (N,) of outputs beyond ±1, which keeps them near the limit."""
    return (outputs.abs() - 1).clamp(min=0).square().sum(1)


def _result(epoch: int, task: DifferentiableTask, returns: NDArray[np.float64], norm: float) -> EpochResult:
    return EpochResult(epoch, float(returns.mean()), tuple(task.errors.mean(0).tolist()), norm, int(task.failed.sum()))
