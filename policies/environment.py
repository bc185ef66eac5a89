"""The environment of insertion policies: a Gymnasium vector environment with noise on its flow maps.

An episode is the insertion of one part. The first observation is the flow map of a first attempt; each step corrects
the pose and makes another attempt. The true pose, from which the reward follows, is in the info of the environment
under "pose"; policies do not receive it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.tasks.environments import InsertionVectorEnv
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise as FlowMapNoise  # public here
from gelflow.sim.tasks.insertion import insertion_randomization
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepResult:
    """Result of one step; arrays over the environments."""

    images: NDArray[np.float32]  # flow maps of the latest attempt, of the next part where `done`
    reward: Array  # of the pose after the correction
    improvement: Array  # reward minus the reward of the pose before the correction
    done: NDArray[np.bool_]  # inserted, or no attempts left
    success: NDArray[np.bool_]  # inserted


class PolicyEnv:
    """A Gymnasium vector environment of insertions with noise on its flow maps."""

    def __init__(self, env: VectorEnv[Any, Any, Any], task: InsertionTask, noise: FlowMapNoise | None = None) -> None:
        """Raises UsageError when `env` does not have the observations of `task`, or resets in the next step."""
        shape = env.single_observation_space.shape
        if shape != task.observation_shape:
            raise UsageError(f"environment observes {shape}; the task describes {task.observation_shape}")
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        if not self._same_step and env.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
            raise UsageError("environment must reset in the same step or on request (metadata['autoreset_mode'])")
        self.env = env
        self.task = task
        self.count = env.num_envs
        self.noise = noise
        self._rng = np.random.default_rng(0)
        self.pose: Array = np.zeros((self.count, 3))  # true gripper poses of the latest attempts, for teachers
        self._last_reward: Array = np.zeros(self.count)
        self._part_noise: Array = np.zeros((self.count, 1 + 2 * task.sensors))

    def reset(self, seed: int) -> NDArray[np.float32]:
        """Resets all environments; returns the flow maps of the first attempts."""
        self._rng = np.random.default_rng(seed)
        images, info = self.env.reset(seed=seed)
        self._set_pose(info["pose"])
        return self._add_noise(images, np.ones(self.count, dtype=bool))

    def step(self, corrections: Array) -> StepResult:
        """Corrects all poses by `corrections` (count, 3) [m, m, rad] and makes the next attempt."""
        actions = corrections / np.asarray(self.task.action_scale)
        images, reward, terminated, truncated, info = self.env.step(np.clip(actions, -1, 1).astype(np.float32))
        done = np.asarray(terminated | truncated)
        if done.any() and not self._same_step:
            images, info = self.env.reset(options={"reset_mask": done})
        improvement = reward - self._last_reward
        self._set_pose(info["pose"])
        return StepResult(
            self._add_noise(images, done), np.asarray(reward, dtype=float), improvement, done, np.asarray(terminated)
        )

    def _set_pose(self, pose: Array) -> None:
        self.pose = np.array(pose, dtype=float)
        self._last_reward = self.task.reward(self.pose)

    def _add_noise(self, images: NDArray[Any], new_parts: NDArray[np.bool_]) -> NDArray[np.float32]:
        if self.noise is None:
            return np.asarray(images, dtype=np.float32)
        if new_parts.any():
            self._part_noise[new_parts] = self.noise.sample(int(new_parts.sum()), self.task.sensors, self._rng)
        return self.noise.apply(images, self._part_noise, self._rng)


def make_insertion_env(
    count: int,
    *,
    noise: FlowMapNoise | None = None,
    preset: str | None = None,
    task: InsertionTask = INSERTION,
    randomization: str = "default",
) -> PolicyEnv:
    """`count` parallel simulated insertions with domain randomization and `noise` on the flow maps.

    `preset` is a preset of the insertion scene; for `randomization` see `insertion_randomization`. Raises UsageError
    for unknown names.
    """
    table = insertion_randomization(randomization, task)
    return PolicyEnv(InsertionVectorEnv(count, task=task, preset=preset, randomization=table), task, noise)
