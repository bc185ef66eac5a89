"""Insertion attempts on a vector environment, seen one way by training and by evaluation.

An episode is one part. Its first observation is the flow map of a first attempt; each step corrects the pose and
makes another. Finished environments start the next part within the same step. The environment's info tells the true
pose (key "pose"), which training takes its reward from and the policy never sees.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks import Network
from gelflow.task import InsertionTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
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
class Outcome:
    """What one step brought: arrays over the environments."""

    images: NDArray[np.float32]  # the newest flow maps, of the next part where `done`
    reward: Array  # of the pose after the correction
    better: Array  # reward gained over the pose before the correction
    done: NDArray[np.bool_]  # inserted, or all attempts used up
    success: NDArray[np.bool_]  # inserted


class Attempts:
    """A gymnasium vector environment of insertions, with noise on its flow maps."""

    def __init__(self, env: VectorEnv[Any, Any, Any], task: InsertionTask, noise: Noise | None = None) -> None:
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

    def step(self, corrections: Array) -> Outcome:
        """Correct every pose by `corrections` (count, 3) [m, m, rad] and make the next attempt."""
        actions = corrections / np.asarray(self.task.action_scale)
        images, reward, terminated, truncated, info = self.env.step(np.clip(actions, -1, 1).astype(np.float32))
        done = np.asarray(terminated | truncated)
        if done.any() and not self._same_step:
            images, info = self.env.reset(options={"reset_mask": done})
        better = reward - self._before
        self._before = self.task.reward(info["pose"])
        return Outcome(self._noisy(images, done), np.asarray(reward, dtype=float), better, done, np.asarray(terminated))

    def _noisy(self, images: NDArray[Any], fresh: NDArray[np.bool_]) -> NDArray[np.float32]:
        if self.noise is None:
            return np.asarray(images, dtype=np.float32)
        if fresh.any():
            self._part[fresh] = self.noise.part(int(fresh.sum()), self.task.sensors, self._rng)
        return self.noise.apply(images, self._part, self._rng)


@dataclass(frozen=True)
class Evaluation:
    """Figures of one way to act over complete episodes."""

    name: str
    episodes: int
    successes: int
    attempts: float  # mean over the successful episodes; nan when there is none
    reward: float  # mean over episodes of the summed reward

    @property
    def success(self) -> float:
        """Share of the episodes that ended inserted."""
        return self.successes / self.episodes

    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share (Wilson)."""
        n, z = self.episodes, 1.96
        middle = (self.success + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(self.success * (1 - self.success) / n + z * z / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)


class NetworkActor:
    """A network acting on all environments at once."""

    def __init__(self, network: Network, count: int) -> None:
        self._network = network
        self._history = network.history(count)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3) for the newest flow maps."""
        corrections = self._network.corrections(self._history.observe(self._network.encode(images)))
        self._history.record(corrections)
        return corrections

    def forget(self, done: NDArray[np.bool_]) -> None:
        """New parts where `done`."""
        self._history.reset(done)


class RandomActor:
    """Corrections drawn uniformly within ± `reach`."""

    def __init__(self, reach: tuple[float, float, float], count: int, seed: int) -> None:
        self._reach = np.asarray(reach)
        self._count = count
        self._rng = np.random.default_rng(seed)

    def act(self, images: NDArray[np.float32]) -> Array:
        """Corrections (count, 3), whatever was felt."""
        return self._rng.uniform(-self._reach, self._reach, (self._count, 3))

    def forget(self, done: NDArray[np.bool_]) -> None:
        """Nothing is remembered."""


def evaluate(
    name: str, actor: NetworkActor | RandomActor, attempts: Attempts, *, episodes: int, seed: int
) -> Evaluation:
    """Let `actor` insert at least `episodes` parts, equally many in every environment (short ones are not favoured).

    Returns figures of exactly `episodes` episodes. Raises UsageError when episodes < 1.
    """
    if episodes < 1:
        raise UsageError(f"episodes must be at least 1, got {episodes}")
    count = attempts.count
    quota = np.full(count, episodes // count) + (np.arange(count) < episodes % count)
    finished, tries, reward = np.zeros(count, dtype=int), np.zeros(count), np.zeros(count)
    lengths: list[float] = []
    rewards: list[float] = []
    actor.forget(np.ones(count, dtype=bool))
    images = attempts.reset(seed)
    while (finished < quota).any():
        outcome = attempts.step(actor.act(images))
        tries += 1
        reward += outcome.reward
        counted = outcome.done & (finished < quota)
        lengths += list(tries[counted & outcome.success])
        rewards += list(reward[counted])
        finished += outcome.done
        tries[outcome.done] = reward[outcome.done] = 0
        actor.forget(outcome.done)
        images = outcome.images
    mean = float(np.mean(lengths)) if lengths else float("nan")
    return Evaluation(name, episodes, len(lengths), mean, float(np.mean(rewards)))
