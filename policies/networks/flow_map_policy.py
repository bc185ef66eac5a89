"""Policies that map flow maps to corrections of the gripper's pose, for one part and for many."""

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotated
from gelflow.observation import FlowMap
from gelflow.policies.networks.base import Array, BatchPolicy, Network, check_observations
from gelflow.task import InsertionTask, TaskDescription


def in_frame_of_gripper(displacement: Array) -> Array:
    """Displacements (n, 3: x, y, yaw) of the gripper from its first pose, turned to its present frame."""
    return np.column_stack([rotated(displacement[:, :2], -displacement[:, 2]), displacement[:, 2]])


def in_frame_of_start(corrections: Array, displacement: Array) -> Array:
    """Corrections (n, 3: x, y, yaw) in the frame of a gripper at `displacement` (n, 3), turned to its first frame."""
    return np.column_stack([rotated(corrections[:, :2], displacement[:, 2]), corrections[:, 2]])


class CorrectionPolicy(BatchPolicy):
    """A network that corrects the poses of several parts and remembers their attempts."""

    def __init__(self, task: InsertionTask, count: int) -> None:
        self._task, self._count = task, count

    @abstractmethod
    def corrections(self, images: NDArray[Any]) -> Array:
        """Corrections (n, 3) [m, m, rad] in the gripper frame for the latest flow maps; deterministic."""

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, 3) for the latest flow maps; ±1 is `InsertionTask.action_scale`.

        Raises UsageError for flow maps of another shape or with values that are not finite.
        """
        check_observations(observations, (self._count, *self._task.observation_shape))
        return np.asarray(self.corrections(observations) / np.asarray(self._task.action_scale))


class FlowMapNetwork(Network):
    """A network whose observations are the flow maps of the insertion."""

    task: InsertionTask
    reach: tuple[float, float, float]  # largest correction [m, m, rad]

    @abstractmethod
    def batch_policy(self, count: int) -> CorrectionPolicy:
        """A policy for `count` parallel parts."""


def insertion_task(task: TaskDescription, kind: str) -> InsertionTask:
    """`task`, for a network of `kind` that is for the insertion. Raises UsageError for another task."""
    if not isinstance(task, InsertionTask):
        raise UsageError(f"network {kind} is for the insertion, not for {task.name}")
    return task


class NetworkPolicy:
    """A network with the memory of one part. Implements `gelflow.protocols.Policy`."""

    def __init__(self, network: FlowMapNetwork) -> None:
        self.network = network
        self._policy = network.batch_policy(1)

    def reset(self) -> None:
        """Clears the memory before a new part."""
        self._policy.reset(np.ones(1, dtype=bool))

    def act(self, observation: FlowMap) -> Array:
        """The correction (dx [m], dy [m], dyaw [rad]) in the gripper frame; deterministic.

        Raises UsageError when the observation is no flow map, does not have the shape of the task, or has values that
        are not finite.
        """
        if not isinstance(observation, FlowMap):
            raise UsageError(
                f"the policy takes a FlowMap, got {type(observation).__name__}; for observations of environments use "
                "load_network(…).batch_policy(n)"
            )
        image, shape = observation.image, self.network.task.observation_shape
        if image.shape != shape:
            raise UsageError(f"flow map has shape {image.shape}; the policy takes {shape}")
        if not np.isfinite(image).all():
            raise UsageError("flow map has values that are not finite")
        return np.asarray(self._policy.corrections(image[None])[0])
