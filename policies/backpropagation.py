"""Back-propagation through time: gradient ascent on the return of episodes that are differentiable.

Each update simulates one episode in every environment with the policy in the loop, takes the gradient of the mean
return with respect to the policy's weights, through simulator, observation and policy, and makes one step of Adam
(paper, B.3).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.torch_actor import TorchActor
from gelflow.policies.ranges import COUNT, POSITIVE, SHARE_BELOW_1, check_settings
from gelflow.policies.training.learner import Learner
from gelflow.policies.training.state import (
    RunState,
    generator_from,
    generator_value,
    load_optimizer_tensors,
    optimizer_tensors,
)
from gelflow.sim.tasks.task_batch import TaskBatch


class DifferentiableEpisodes(Protocol):
    """Episodes of a task's environments that start and end together, such as `DifferentiablePushing`."""

    max_steps: int
    observation: torch.Tensor  # (N, size), differentiable
    errors: NDArray[np.float64]  # distances to the goal after the last step, (N, k)
    failed: NDArray[np.bool_]  # (N,), the simulation stopped

    @property
    def task(self) -> TaskBatch:
        """The environments."""

    def reset(self, rng: np.random.Generator) -> None:
        """Start new episodes."""

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        """One step with actions (N, k) in ±1; returns the rewards (N,)."""

    def detach(self) -> None:
        """Cut the graph."""


@dataclass(frozen=True)
class BackpropagationSettings:
    """Settings of a training; the defaults are published (paper, B.3), except for the window."""

    learning_rate: float = 0.005  # at the start; decays linearly to 0
    betas: tuple[float, float] = (0.7, 0.95)  # of Adam
    gradient_norm: float = 1.0  # largest norm of a gradient
    window: int = 100  # steps through which a gradient passes; shorter windows miss late consequences of an action

    def __post_init__(self) -> None:
        check_settings(self, learning_rate=POSITIVE, betas=(SHARE_BELOW_1, 2), gradient_norm=POSITIVE, window=COUNT)


class Backpropagation(Learner):
    """Back-propagation through the episodes of a task.

    Parameters
    ----------
    episodes: the number of its environments is the number of episodes of an update, 16 in the paper
    architecture: of the actor; `recurrent` units remember earlier observations
    seed: of the initial weights and of the episodes
    steps: environment steps until the learning rate is 0; 480 000 in the paper, 300 updates of 16 episodes of 100 steps
    """

    columns = ("return", "error", "gradient", "failed")

    def __init__(
        self,
        episodes: DifferentiableEpisodes,
        architecture: ActorArchitecture,
        settings: BackpropagationSettings,
        *,
        seed: int,
        steps: int,
    ) -> None:
        super().__init__(episodes.task, architecture)
        size = tuple(episodes.observation.shape[1:])
        if size != architecture.observation_shape:
            raise UsageError(f"the task observes {size}; the network takes {architecture.observation_shape}")
        torch.manual_seed(seed)  # initial weights
        self.actor = TorchActor(architecture)
        self._episodes, self._settings, self._total = episodes, settings, steps
        self._optimizer = torch.optim.Adam(self.actor.parameters(), settings.learning_rate, betas=settings.betas)
        self._rng = np.random.default_rng([seed, 0])

    def update(self) -> dict[str, float]:
        """One episode in every environment and one step of Adam, which a gradient that is not finite skips.

        Returns means over the episodes: return, first of the errors at the end, norm of the gradient before clipping,
        and share of failed simulations.
        """
        settings, episodes = self._settings, self._episodes
        for group in self._optimizer.param_groups:
            group["lr"] = settings.learning_rate * max(0.0, 1 - self.steps / self._total)
        self._optimizer.zero_grad()
        with self.clock.timed("simulation"):
            returns = run_episodes(episodes, self.actor, self._rng, window=settings.window)
        with self.clock.timed("learning"):
            norm = float(torch.nn.utils.clip_grad_norm_(self.actor.parameters(), settings.gradient_norm))
            if np.isfinite(norm):
                self._optimizer.step()
        self.steps += len(returns) * episodes.max_steps
        return {
            "return": float(returns.mean()),
            "error": float(episodes.errors[:, 0].mean()),
            "gradient": norm,
            "failed": float(episodes.failed.mean()),
        }

    def restart_episodes(self) -> None:
        """Does nothing: every update starts new episodes."""

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The tensors of the actor."""
        return self.actor.tensors()

    def state(self) -> RunState:
        """Everything that determines the next updates."""
        state = RunState(values={"rng": generator_value(self._rng), "steps": self.steps})
        state.add("actor", self.actor.state_dict())
        state.add("optimizer", optimizer_tensors(self._optimizer))
        return state

    def load(self, state: RunState) -> None:
        """Restores `state`."""
        self.actor.load_state_dict(state.part("actor"))
        load_optimizer_tensors(self._optimizer, state.part("optimizer"))
        self._rng = generator_from(state.values["rng"])
        self.steps = state.values["steps"]


def run_episodes(
    episodes: DifferentiableEpisodes, actor: TorchActor, rng: np.random.Generator, *, window: int | None
) -> NDArray[np.float64]:
    """Returns (N,) of one episode in each environment.

    The gradient of minus the mean return per step is added to the gradients of the actor, with the graph cut after
    every `window` steps; None computes no gradient.
    """
    episodes.reset(rng)
    memory = actor.initial_memory(len(episodes.observation))
    returns = np.zeros(len(episodes.observation))
    loss = torch.zeros(())
    with torch.set_grad_enabled(window is not None):
        for step in range(1, episodes.max_steps + 1):
            outputs, memory = actor(episodes.observation.to(torch.float32), memory)
            rewards = episodes.step(limited(outputs).to(episodes.observation.dtype))
            returns += rewards.detach().numpy()
            loss = loss - (rewards.mean() - excess(outputs).mean()) / episodes.max_steps
            if window is not None and (step % window == 0 or step == episodes.max_steps):
                loss.backward()
                loss, memory = torch.zeros(()), memory.detach()
                episodes.detach()
    return returns


def limited(outputs: torch.Tensor) -> torch.Tensor:
    """Outputs limited to ±1. The gradient is that of the outputs, because the gradient of a limit is 0 beyond it."""
    return outputs + (outputs.clamp(-1, 1) - outputs).detach()


def excess(outputs: torch.Tensor) -> torch.Tensor:
    """Cost (N,) of outputs beyond ±1, which keeps them near the limit."""
    return (outputs.abs() - 1).clamp(min=0).square().sum(1)
