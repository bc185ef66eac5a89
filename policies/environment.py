"""The vector environment that policies are trained and evaluated in: noisy flow maps in, pose corrections out."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.tasks.environments import InsertionVectorEnv
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlowMapNoise:
    """What a real pad adds to a flow map and the simulator does not; drawn anew for every part unless said.

    Scales are those of a map whose longest vector has length 1.
    """

    marker: float = 0.05  # largest standard deviation of one marker's vector, drawn anew for every attempt
    offset: float = 0.03  # standard deviation of a whole pad's shift in an attempt (the reference drifted)
    gain: float = 0.05  # standard deviation of a pad's gain (one gel softer than the other)
    turn: float = 0.03  # standard deviation of a camera's turn against its pad [rad]

    def part(self, count: int, sensors: int, rng: np.random.Generator) -> Array:
        """Per part: level of the marker noise, then gain and turn of every sensor; shape (count, 1 + 2 sensors)."""
        level = rng.uniform(0, self.marker, (count, 1))
        gain = np.exp(rng.normal(0, self.gain, (count, sensors)))
        turn = rng.normal(0, self.turn, (count, sensors))
        return np.concatenate([level, gain, turn], axis=1)

    def apply(self, images: NDArray[Any], part: Array, rng: np.random.Generator) -> NDArray[np.float32]:
        """Noisy flow maps (n, frames * sensors * 2, rows, cols), normalized again to the length they had."""
        n, channels, rows, cols = images.shape
        sensors = (part.shape[1] - 1) // 2
        flow = images.reshape(n, channels // (2 * sensors), sensors, 2, rows, cols).astype(np.float32)
        longest = _longest(flow)
        level, gain, turn = np.split(part.astype(np.float32), [1, 1 + sensors], axis=1)
        scale = gain[:, None, :, None, None]
        cos, sin = np.cos(turn)[:, None, :, None, None], np.sin(turn)[:, None, :, None, None]
        x, y = flow[:, :, :, 0], flow[:, :, :, 1]
        noisy = np.stack([scale * (cos * x - sin * y), scale * (sin * x + cos * y)], axis=3)
        noisy += level[:, :, None, None, None, None] * rng.standard_normal(noisy.shape, dtype=np.float32)
        drift = rng.standard_normal((n, 1, sensors, 2, 1, 1), dtype=np.float32)
        noisy += np.float32(self.offset) * drift
        noisy *= (longest / np.maximum(_longest(noisy), 1e-6))[:, None, None, None, None, None]
        return np.asarray(noisy.reshape(images.shape))


def _longest(flow: NDArray[Any]) -> NDArray[np.float32]:
    return np.asarray(np.sqrt((flow * flow).sum(3).max(axis=(1, 2, 3, 4))))


@dataclass(frozen=True)
class StepResult:
    """What one step brought: arrays over the environments."""

    images: NDArray[np.float32]  # the newest flow maps, of the next part where `done`
    reward: Array  # of the pose after the correction
    better: Array  # reward gained over the pose before the correction
    done: NDArray[np.bool_]  # inserted, or all attempts used up
    success: NDArray[np.bool_]  # inserted


class PolicyEnv:
    """A gymnasium vector environment of insertions, with noise on its flow maps."""

    def __init__(self, env: VectorEnv[Any, Any, Any], task: InsertionTask, noise: FlowMapNoise | None = None) -> None:
        """Raises UsageError when the environment's observations are not the task's, or it resets a step late."""
        shape = env.single_observation_space.shape
        if shape != task.observation_shape:
            raise UsageError(f"environment observes {shape}; the task describes {task.observation_shape}")
        self._same_step = env.metadata.get("autoreset_mode") == AutoresetMode.SAME_STEP
        if not self._same_step and env.metadata.get("autoreset_mode") != AutoresetMode.DISABLED:
            raise UsageError("environment must reset in the same step or when told (metadata['autoreset_mode'])")
        self.env = env
        self.task = task
        self.count = env.num_envs
        self.noise = noise
        self._rng = np.random.default_rng(0)
        self._before: Array = np.zeros(self.count)
        self._part: Array = np.zeros((self.count, 1 + 2 * task.sensors))

    def reset(self, seed: int) -> NDArray[np.float32]:
        """New parts everywhere; returns the flow maps of their first attempts."""
        self._rng = np.random.default_rng(seed)
        images, info = self.env.reset(seed=seed)
        self._before = self.task.reward(info["pose"])
        return self._noisy(images, np.ones(self.count, dtype=bool))

    def step(self, corrections: Array) -> StepResult:
        """Correct every pose by `corrections` (count, 3) [m, m, rad] and make the next attempt."""
        actions = corrections / np.asarray(self.task.action_scale)
        images, reward, terminated, truncated, info = self.env.step(np.clip(actions, -1, 1).astype(np.float32))
        done = np.asarray(terminated | truncated)
        if done.any() and not self._same_step:
            images, info = self.env.reset(options={"reset_mask": done})
        better = reward - self._before
        self._before = self.task.reward(info["pose"])
        return StepResult(
            self._noisy(images, done), np.asarray(reward, dtype=float), better, done, np.asarray(terminated)
        )

    def _noisy(self, images: NDArray[Any], fresh: NDArray[np.bool_]) -> NDArray[np.float32]:
        if self.noise is None:
            return np.asarray(images, dtype=np.float32)
        if fresh.any():
            self._part[fresh] = self.noise.part(int(fresh.sum()), self.task.sensors, self._rng)
        return self.noise.apply(images, self._part, self._rng)


def make_insertion_env(
    count: int, *, noise: FlowMapNoise | None = None, preset: str | None = None, task: InsertionTask = INSERTION
) -> PolicyEnv:
    """`count` simulated insertions side by side, domain randomized, with `noise` on their flow maps.

    `preset` says how exactly they are simulated. Raises UsageError when the insertion scene has no such preset.
    """
    return PolicyEnv(InsertionVectorEnv(count, task=task, preset=preset), task, noise)
