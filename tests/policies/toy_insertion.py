"""An analytic insertion that replaces the simulator, and flow maps for tests of policies."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gelflow.task import INSERTION


class Toy(VectorEnv[Any, Any, Any]):
    """Analytic insertion: the part is inserted when every error is below a third of the largest misalignment.

    Both pads measure an upward force; the differences of the pads encode x and y, their sum along y encodes yaw.
    """

    def __init__(self, count: int, *, same_step: bool = True) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP if same_step else AutoresetMode.DISABLED}
        self.num_envs = count
        self.single_observation_space = gymnasium.spaces.Box(-1, 1, INSERTION.observation_shape, np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self.error = np.zeros((count, 3))
        self.attempts = np.zeros(count, dtype=int)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        mask = np.ones(self.num_envs, dtype=bool) if options is None else options["reset_mask"]
        self._restart(mask)
        return self._observe(), {"pose": self.error.copy()}

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.error += actions * np.array(INSERTION.action_scale)
        self.attempts += 1
        reward = INSERTION.reward(self.error)
        inserted = (np.abs(self.error) < np.array(INSERTION.misalignment) / 3).all(1)
        ended = ~inserted & (self.attempts >= INSERTION.attempts)
        if self.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP:
            self._restart(inserted | ended)
        return self._observe(), reward, inserted, ended, {"pose": self.error.copy()}

    def _restart(self, mask: NDArray[np.bool_]) -> None:
        self.error[mask] = self.np_random.uniform(-1, 1, (int(mask.sum()), 3)) * np.array(INSERTION.misalignment)
        self.attempts[mask] = 0

    def _observe(self) -> NDArray[np.float32]:
        x, y, yaw = (self.error / np.array(INSERTION.misalignment)).T / 2
        flow = np.stack([1 + x, yaw + y, 1 - x, yaw - y], axis=1)[:, :, None, None] * np.ones((1, 1, 13, 10))
        return np.asarray(flow / np.abs(flow).max(axis=(1, 2, 3), keepdims=True), dtype=np.float32)


def images(count: int, seed: int = 0) -> NDArray[np.float32]:
    shape = (count, *INSERTION.observation_shape)
    return np.random.default_rng(seed).uniform(-0.5, 0.5, shape).astype(np.float32)


def mirrored(image: NDArray[Any], in_x: bool, in_y: bool) -> NDArray[Any]:
    """The flow map of a scene mirrored in x, y or both of the gripper frame, computed pad by pad."""
    pads = image.reshape(2, 2, 13, 10)
    if in_x:
        pads = pads[::-1]
    if in_x != in_y:  # a reflection reverses the y axis of each pad; mirroring both axes is a rotation by 180°
        pads = pads[:, :, :, ::-1] * np.array([1, -1])[None, :, None, None]
    return np.asarray(pads.reshape(image.shape))
