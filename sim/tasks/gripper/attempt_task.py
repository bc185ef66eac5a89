"""Base of the tasks of attempts: an episode is one object, each step moves the gripper and makes another attempt."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from gelflow.sim.tasks.task_batch import Array, Mask, TaskBatch
from gelflow.task import TaskDescription


class AttemptTask(TaskBatch):
    """A task of attempts: `reset` draws an object and makes the first attempt, `step` corrects and makes the next.

    An episode terminates with success, and is truncated when all attempts (the first included) are used or the
    simulation failed. `info["attempts"]` (N,) counts attempts. A subclass draws objects (`_draw`), moves the gripper
    (`_move`) and simulates an attempt (`_attempt`).
    """

    length_unit = "attempts"  # the first one included

    def __init__(
        self,
        description: TaskDescription,
        num_envs: int,
        *,
        observation_space: Box,
        action_space: Box,
        privileged: int,
        attempts: int,
    ) -> None:
        super().__init__(
            description, num_envs, observation_space=observation_space, action_space=action_space, privileged=privileged
        )
        self._max_attempts = attempts
        self.info["attempts"] = np.zeros(num_envs, dtype=np.int64)

    @abstractmethod
    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        """Draw the objects and start poses of the environments `which`."""

    @abstractmethod
    def _move(self, actions: Array, active: Mask) -> None:
        """Correct the gripper's pose of the environments `active` by actions (N, k) in ±1."""

    @abstractmethod
    def _attempt(self, active: Mask, rng: np.random.Generator) -> None:
        """Simulate one attempt of the environments `active`; writes their rows of observation, reward and info."""

    def _reset(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self._draw(which, rng, options)
        self.info["attempts"][which] = 1
        self._attempt(which, rng)
        self.reward[which] = 0
        self._end_episodes(which)

    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        self._move(actions, active)
        self.info["attempts"][active] += 1
        self._attempt(active, rng)
        self._end_episodes(active)

    def _end_episodes(self, active: Mask) -> None:
        success = self.info["success"]
        over = self.info["failed"] | (self.info["attempts"] >= self._max_attempts)
        self.terminated[active] = success[active]
        self.truncated[active] = (over & ~success)[active]
