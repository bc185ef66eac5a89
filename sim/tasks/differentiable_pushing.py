"""Box pushing with gradients: the steps of `Pushing` as differentiable functions of torch tensors."""

import numpy as np
import torch

from gelflow.sim.tasks.pushing import Pushing, stacked
from gelflow.sim.torch_layer import TorchState, torch_rollout, torch_state


class DifferentiablePushing:
    """Episodes of `Pushing` whose rewards and observations are differentiable with respect to all earlier actions.

    The episodes of all environments start and end together. Tensors have the simulator's precision.

    Attributes
    ----------
    task: the environments; their parameters and goals are those of the last `reset`, their state is not used
    observation: (N, size); differentiable
    errors: distance of the box to the goal [m] and of the yaw angles [rad] after the last step, (N, 2)
    failed: (N,) bool, the simulation stopped in this episode; the environment then rests, with rewards of 0, and its
        readings and its state after the failed period have no gradient
    """

    def __init__(self, task: Pushing) -> None:
        self.task = task
        self.max_steps = task.description.max_steps
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Start new episodes in all environments."""
        task = self.task
        task.reset(task.all, rng)
        self._rng = rng
        self._state: TorchState = torch_state(task.sim)
        self._steps = np.zeros(task.num_envs, dtype=np.int64)
        self._frames = torch.from_numpy(task.frames.copy())
        self.observation = self._frames.flatten(1)
        self.failed = np.zeros(task.num_envs, dtype=bool)

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        """One control period with actions (N, 3) in ±1; returns the rewards (N,)."""
        task, periods = self.task, self.task.steps_per_period
        controls = task.controls(actions, self._steps).expand(periods, -1, -1).contiguous()
        active = ~self.failed
        result = torch_rollout(task.sim, self._state, controls, read_after=(periods,), active=active)
        self._state = result.end
        self._steps += 1
        self.failed |= ~result.ok.numpy()
        state = task.state(result.end.q, self._read(result.tactile[0]))
        self._frames = stacked(self._frames, state.frame(task.description))
        self.observation = self._frames.flatten(1)
        squared, yaw = state.goal_error()
        self.errors = np.stack([squared.detach().numpy() ** 0.5, np.abs(yaw.detach().numpy())], axis=1)
        rewards: torch.Tensor = task.description.reward(state, actions)
        return torch.where(torch.from_numpy(active), rewards, 0.0)

    def _read(self, forces: torch.Tensor) -> torch.Tensor:
        """Readings of the pads; the deviations of real pads are constants for the gradient."""
        values = forces.detach().numpy()
        return forces + torch.from_numpy(self.task.read(values, self.task.all, self._rng) - values)

    def detach(self) -> None:
        """Cut the graph: later rewards have no gradient with respect to earlier actions."""
        self._state = self._state.detach()
        self._frames = self._frames.detach()
        self.observation = self.observation.detach()
