"""Actors: an encoder of the observation, an optional recurrent layer (GRU), and a linear layer to the actions.

The tensors of a checkpoint are the `state_dict` of the network in training, `torch_actor.TorchActor`.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.base import (
    Architecture,
    Array,
    BatchPolicy,
    Network,
    Tensors,
    check_observations,
    check_tensors,
)
from gelflow.policies.networks.layers import gru_cell, linear
from gelflow.sim.arguments import check_mask
from gelflow.task import TaskDescription

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class ActorArchitecture(Architecture):
    """Settings of an actor. A subclass defines the encoder."""

    observation_shape: tuple[int, ...]
    actions: int  # number of actions; also of other outputs, such as the one of a critic
    recurrent: int = 0  # units of the recurrent layer; 0: none

    def __post_init__(self) -> None:
        if self.actions < 1 or self.recurrent < 0 or min(self.observation_shape, default=0) < 1:
            raise UsageError(f"an actor requires observations, actions ≥ 1 and recurrent ≥ 0, got {self}")

    @property
    @abstractmethod
    def features(self) -> int:
        """Number of outputs of the encoder."""

    @abstractmethod
    def encoder_shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of the encoder."""

    @abstractmethod
    def encode(self, observations: NDArray[Any], tensors: dict[str, Array]) -> Array:
        """Features (n, features) of observations (n, *observation_shape)."""

    @abstractmethod
    def torch_encoder(self) -> "torch.nn.Module":
        """The encoder for training, with the same tensors."""

    def tensor_shapes(self, task: TaskDescription) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of a network; the same for all tasks."""
        shapes = {f"encoder.{name}": shape for name, shape in self.encoder_shapes().items()}
        if h := self.recurrent:
            shapes |= {"memory.weight_ih": (3 * h, self.features), "memory.bias_ih": (3 * h,)}
            shapes |= {"memory.weight_hh": (3 * h, h), "memory.bias_hh": (3 * h,)}
        return shapes | {"head.weight": (self.actions, h or self.features), "head.bias": (self.actions,)}

    def network(self, task: TaskDescription, tensors: Tensors) -> "ActorNetwork":
        """The network with the given tensors. Raises UsageError when they do not fit."""
        return ActorNetwork(self, task, tensors)


class ActorNetwork(Network):
    """An actor for inference in NumPy."""

    def __init__(self, architecture: ActorArchitecture, task: TaskDescription, tensors: Tensors) -> None:
        """Raises UsageError for missing tensors, wrong shapes and values that are not finite."""
        check_tensors(tensors, architecture.tensor_shapes(task))
        self.architecture: ActorArchitecture = architecture
        self.task = task
        self._encoder = _part(tensors, "encoder")
        self._memory = _part(tensors, "memory")
        self._head = _part(tensors, "head")

    def forward(self, observations: NDArray[Any], memory: Array) -> tuple[Array, Array]:
        """Outputs (n, actions) and next memory for observations (n, …) and memory (n, recurrent)."""
        features = self.architecture.encode(observations, self._encoder)
        if self._memory:
            features = memory = gru_cell(features, memory, self._memory)
        return linear(features, self._head["weight"], self._head["bias"]), memory

    def batch_policy(self, count: int) -> "ActorPolicy":
        """A policy for `count` parallel environments."""
        return ActorPolicy(self, count)


class ActorPolicy(BatchPolicy):
    """An actor with a memory for each of `count` environments."""

    def __init__(self, network: ActorNetwork, count: int) -> None:
        self._network = network
        self._memory: Array = np.zeros((count, network.architecture.recurrent))

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Clears the memory of the environments marked in `which`."""
        check_mask(np.asarray(which), len(self._memory))
        self._memory[which] = 0

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, k) in ±1. Raises UsageError for observations of another shape or that are not finite."""
        check_observations(observations, (len(self._memory), *self._network.architecture.observation_shape))
        actions, self._memory = self._network.forward(observations, self._memory)
        return np.clip(actions, -1, 1)


def _part(tensors: Tensors, name: str) -> dict[str, Array]:
    """The tensors whose names start with `name`, without it."""
    names = [key for key in tensors if key.startswith(f"{name}.")]
    return {key.removeprefix(f"{name}."): np.asarray(tensors[key], dtype=float) for key in names}
