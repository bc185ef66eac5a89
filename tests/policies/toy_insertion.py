"""An analytic insertion that replaces the simulator, and flow maps for tests of policies."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gelflow.sim.tasks.gripper.attempt_task import AttemptTask
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.task import INSERTION


class ToyInsertion(AttemptTask):
    """Insertions whose flow maps follow from the pose error, with noise; see `flow_maps` and `inserted`."""

    length_unit = "corrections"

    def __init__(self, count: int) -> None:
        image, correction = Box(-1, 1, INSERTION.observation_shape, np.float32), Box(-1, 1, (3,), np.float32)
        super().__init__(
            INSERTION,
            count,
            observation_space=image,
            action_space=correction,
            privileged=3,
            attempts=INSERTION.attempts,
        )
        self._noise = FlowMapNoise()
        self._part_noise = np.zeros((count, 5))
        self.error = np.zeros((count, 3))

    def _draw(self, which: NDArray[np.bool_], rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self.error[which] = rng.uniform(-1, 1, (int(which.sum()), 3)) * np.array(INSERTION.misalignment)
        self._part_noise[which] = self._noise.sample(int(which.sum()), 2, rng)

    def _move(self, actions: NDArray[np.float64], active: NDArray[np.bool_]) -> None:
        self.error[active] += (actions * np.array(INSERTION.action_scale))[active]

    def _attempt(self, active: NDArray[np.bool_], rng: np.random.Generator) -> None:
        flow = flow_maps(self.error[active])
        self.observation[active] = self._noise.apply(flow, self._part_noise[active], rng)
        self.info["privileged"][active] = self.error[active]
        self.info["success"][active] = inserted(self.error[active])
        self.reward[active] = INSERTION.reward(self.error[active])

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A white picture."""
        return np.full((8, 8, 3), 255, np.uint8)


def inserted(error: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether parts with pose errors (n, 3) are inserted: every error is below a third of the misalignment."""
    return np.asarray((np.abs(error) < np.array(INSERTION.misalignment) / 3).all(1))


def flow_maps(error: NDArray[np.float64]) -> NDArray[np.float32]:
    """Flow maps of parts with pose errors (n, 3).

    Both pads measure an upward force; the differences of the pads encode x and y, their sum along y encodes yaw.
    """
    x, y, yaw = (error / np.array(INSERTION.misalignment)).T / 2
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
