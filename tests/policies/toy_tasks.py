"""Analytic tasks that replace the simulator in the tests of algorithms."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.task_batch import Array, Mask, TaskBatch
from gelflow.task import TaskDescription


@dataclass(frozen=True)
class ToyDescription(TaskDescription):
    """A point to be moved to a target."""

    name: str = "toy"
    steps: int = 8
    reach: float = 0.5


class PointTask(TaskBatch):
    """Move a point to a target in the plane; the observation is their difference, as vector or as image.

    With `remember` only the first observation shows the target, and the first action has no effect.
    """

    def __init__(self, num_envs: int, *, image: bool = False, remember: bool = False, steps: int = 8) -> None:
        shape: tuple[int, ...] = (2, 8, 8) if image else (4,)
        super().__init__(
            ToyDescription(steps=steps),
            num_envs,
            observation_space=Box(-np.inf, np.inf, shape, np.float32),
            action_space=Box(-1, 1, (2,), np.float32),
            privileged=4,
        )
        self._image, self._remember, self._max_steps = image, remember, steps
        self._point: Array = np.zeros((num_envs, 2))
        self._target: Array = np.zeros((num_envs, 2))
        self._steps = np.zeros(num_envs, dtype=np.int64)

    def _reset(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self._target[which] = rng.uniform(-1, 1, (int(which.sum()), 2))
        drawn = {"target_x": self._target[which, 0], "target_y": self._target[which, 1]}
        self._record(which, drawn, Randomization(), target_x="m", target_y="m")
        self._point[which] = 0
        self._steps[which] = 0
        self._observe(which)
        self.reward[which] = 0

    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        moving = active & (self._steps > 0) if self._remember else active
        self._point[moving] += 0.5 * actions[moving]
        self._steps[active] += 1
        self._observe(active)

    def _observe(self, which: Mask) -> None:
        error = self._target - self._point
        visible = (self._steps == 0)[:, None] | (not self._remember)
        seen = np.where(visible, error, 0.0)
        if self._image:
            self.observation[which] = seen[which][:, :, None, None]
        else:
            self.observation[which] = np.concatenate([seen, np.where(visible, self._point, 0.0)], axis=1)[which]
        distance = np.linalg.norm(error, axis=1)
        self.info["success"][which] = (distance < 0.15)[which]
        self.info["privileged"][which] = np.concatenate([self._target, self._point], axis=1)[which]
        self.reward[which] = (-distance + self.info["success"])[which]
        self.terminated[which] = self.info["success"][which]
        self.truncated[which] = ((self._steps >= self._max_steps) & ~self.info["success"])[which]

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A picture with the point and the target."""
        picture = np.full((32, 32, 3), 255, np.uint8)
        for position, colour in ((self._target[index], (0, 160, 0)), (self._point[index], (200, 0, 0))):
            row, col = np.clip(np.round(16 + 12 * position), 0, 31).astype(int)
            picture[row, col] = colour
        return picture
