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
from gelflow.sim.tasks.insertion import RANDOMIZATIONS
from gelflow.sim.tasks.randomization import Randomization
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlowMapNoise:
    """Noise of real pads and cameras that the simulator does not model, sampled per part unless stated otherwise.

    Lengths are relative to the longest vector of the flow map.
    """

    marker: float = 0.05  # largest standard deviation of marker vectors, sampled per attempt
    offset: float = 0.03  # standard deviation of the common shift of a pad, sampled per attempt (reference drift)
    gain: float = 0.05  # standard deviation of the logarithmic gain of a pad (gel stiffness)
    turn: float = 0.03  # standard deviation of the rotation of a camera relative to its pad [rad]

    def sample(self, count: int, sensors: int, rng: np.random.Generator) -> Array:
        """Noise of `count` parts: marker level, gain and rotation of each sensor; shape (count, 1 + 2 sensors)."""
        level = rng.uniform(0, self.marker, (count, 1))
        gain = np.exp(rng.normal(0, self.gain, (count, sensors)))
        turn = rng.normal(0, self.turn, (count, sensors))
        return np.concatenate([level, gain, turn], axis=1)

    def apply(self, images: NDArray[Any], part_noise: Array, rng: np.random.Generator) -> NDArray[np.float32]:
        """Adds noise to flow maps (n, frames * sensors * 2, rows, cols); preserves the length of the longest vector."""
        n, channels, rows, cols = images.shape
        sensors = (part_noise.shape[1] - 1) // 2
        flow = images.reshape(n, channels // (2 * sensors), sensors, 2, rows, cols).astype(np.float32)
        max_length = _max_length(flow)
        level, gain, turn = np.split(part_noise.astype(np.float32), [1, 1 + sensors], axis=1)
        scale = gain[:, None, :, None, None]
        cos, sin = np.cos(turn)[:, None, :, None, None], np.sin(turn)[:, None, :, None, None]
        x, y = flow[:, :, :, 0], flow[:, :, :, 1]
        noisy = np.stack([scale * (cos * x - sin * y), scale * (sin * x + cos * y)], axis=3)
        noisy += level[:, :, None, None, None, None] * rng.standard_normal(noisy.shape, dtype=np.float32)
        drift = rng.standard_normal((n, 1, sensors, 2, 1, 1), dtype=np.float32)
        noisy += np.float32(self.offset) * drift
        noisy *= (max_length / np.maximum(_max_length(noisy), 1e-6))[:, None, None, None, None, None]
        return np.asarray(noisy.reshape(images.shape))


def _max_length(flow: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(np.sqrt((flow * flow).sum(3).max(axis=(1, 2, 3, 4))))


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


def insertion_randomization(name: str, task: InsertionTask) -> Randomization:
    """The table `name` of `RANDOMIZATIONS`, with the grasp height of the task's part. Raises UsageError if unknown."""
    if name not in RANDOMIZATIONS:
        raise UsageError(f"randomization must be one of {', '.join(RANDOMIZATIONS)}, got {name!r}")
    table = RANDOMIZATIONS[name]
    return table if name == "nominal" else table.replace(grasp_height=task.part.grasp_height)


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
