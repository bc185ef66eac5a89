"""PPO of the insertion: a perceptron learns from the history of attempts, on features instead of flow maps.

The training reward is the improvement by a correction: the reward of the pose after it minus that of the pose before.
It is immediate, so the discount is small, and its variance does not depend on the initial misalignment.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gelflow.policies.networks.flow_map_policy import insertion_task
from gelflow.policies.networks.mlp import MLP, VARIANCE_FLOOR
from gelflow.policies.networks.polynomial_features import polynomial_basis
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.policies.ppo import PPO, PPOSettings
from gelflow.sim.tasks.task_batch import Array, Mask, TaskBatch


class HistoryTask(TaskBatch):
    """The insertion as the perceptron of `PolynomialMLP` sees it, with the improvement as reward.

    Observations are canonical inputs of the perceptron, actions of ±1 correspond to `PolynomialMLP.reach`.
    `info["privileged"]` of `task` are the poses of the gripper in the hole's frame.
    """

    length_unit = "corrections"

    def __init__(self, task: TaskBatch, architecture: PolynomialMLP) -> None:
        self._description = insertion_task(task.description, architecture.kind)
        super().__init__(
            task.description,
            task.num_envs,
            observation_space=Box(-np.inf, np.inf, (architecture.inputs(self._description),), np.float32),
            action_space=Box(-1, 1, (3,), np.float32),
            privileged=3,
        )
        self._task = task
        # The results of the task, which it overwrites in place.
        self.info, self.terminated, self.truncated = task.info, task.terminated, task.truncated
        shapes = architecture.tensor_shapes(self._description)
        zero = {name: np.zeros(shape) for name, shape in shapes.items()}
        self._network = architecture.network(self._description, zero | fixed_tensors(architecture, task))
        self._history = self._network.history(task.num_envs)
        self._reach = np.asarray(architecture.reach) * self._description.corrected_axes
        self._signs: Array = np.ones((task.num_envs, 3))
        self._pose_reward: Array = np.zeros(task.num_envs)

    def _reset(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self._task.reset(which, rng, options=options)
        self._history.reset(which)
        self._observe(which)
        self.reward[which] = 0

    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        corrections = actions * self._signs * self._reach
        self._history.record(corrections, active)
        self._task.step(corrections / np.asarray(self._description.action_scale), rng, active=active)
        before = self._pose_reward.copy()
        self._observe(active)
        self.reward[active] = (self._pose_reward - before)[active]

    def _observe(self, which: Mask) -> None:
        if not which.any():
            return
        inputs = self._history.observe(self._network.encode(self._task.observation[which]), which)
        self.observation[which], self._signs[which] = self._network.canonical(inputs)
        self._pose_reward[which] = self._description.reward(self.info["privileged"][which])

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """The picture of the task."""
        return self._task.render(index)


class UnclippedMLP(MLP):
    """A perceptron whose normalization is linear, so that the first layer of a `PolynomialMLP` can contain it."""

    clip: ClassVar[float] = np.inf


class InsertionPPO(PPO):
    """PPO that trains a `PolynomialMLP` on the insertion."""

    def __init__(
        self, task: TaskBatch, architecture: PolynomialMLP, settings: PPOSettings, *, seed: int, steps: int
    ) -> None:
        """As `PPO`; `task` observes flow maps."""
        history = HistoryTask(task, architecture)
        shape = history.observation_space.shape
        perceptron = UnclippedMLP(observation_shape=shape, actions=3, hidden=architecture.hidden)
        super().__init__(history, perceptron, settings, seed=seed, steps=steps)
        self.architecture = architecture
        self._hidden, self._fixed = architecture.hidden, fixed_tensors(architecture, task)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The tensors of a `PolynomialMLP`, whose first layer contains the normalization of the actor."""
        actor = super().tensors()
        layers = [f"encoder.layers.{i}" for i in range(len(self._hidden))]
        named = [(actor[f"{name}.weight"], actor[f"{name}.bias"]) for name in (*layers, "head")]
        weight, bias = named[0]
        weight = weight / np.sqrt(actor["encoder.variance"] + np.float32(VARIANCE_FLOOR))
        named[0] = weight, bias - weight @ actor["encoder.mean"]
        tensors = {name: values.astype(np.float32) for name, values in self._fixed.items()}
        for i, (weight, bias) in enumerate(named):
            tensors |= {f"{i}.weight": weight, f"{i}.bias": bias}
        return tensors


def fixed_tensors(architecture: PolynomialMLP, task: TaskBatch) -> dict[str, Array]:
    """The tensors that are not trained: the polynomials, and a scale of 1, because the actor normalizes its inputs."""
    description = insertion_task(task.description, architecture.kind)
    scale = np.ones(architecture.features(description))
    return {"basis": polynomial_basis(description.grid, architecture.degree), "scale": scale}
