"""The interface that all architectures share: settings stored as JSON, and networks that act in many environments."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.task import TaskDescription

Array = NDArray[np.float64]
Tensors = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Architecture(ABC):
    """Settings of a network, stored in its checkpoint. Each subclass is a frozen dataclass with a `kind` of its own."""

    kind: ClassVar[str]

    def to_json(self) -> dict[str, Any]:
        """JSON data for the header of a checkpoint."""
        values = {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}
        return {"kind": self.kind, **values}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Inverse of `to_json`. Raises UsageError for unknown keys."""
        given = {key: value for key, value in data.items() if key != "kind"}
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := set(given) - known:
            raise UsageError(f"network has unknown keys {sorted(unknown)}; known are {sorted(known)}")
        return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in given.items()})

    @abstractmethod
    def tensor_shapes(self, task: TaskDescription) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of a network for `task`."""

    @abstractmethod
    def network(self, task: TaskDescription, tensors: Tensors) -> "Network":
        """The network with the given tensors. Raises UsageError when they do not fit, see `check_tensors`."""


class BatchPolicy(ABC):
    """A policy that acts in several environments at once and keeps a state for each of them."""

    @abstractmethod
    def reset(self, which: NDArray[np.bool_]) -> None:
        """Clears the state of the environments marked in `which`, shape (n,), before their new episodes."""

    @abstractmethod
    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, k) in ±1 for the latest observations (n, …)."""


class Network(ABC):
    """A network for inference in NumPy. Its results are bit-identical for any number of threads, as replay requires."""

    architecture: Architecture
    task: TaskDescription

    @abstractmethod
    def batch_policy(self, count: int) -> BatchPolicy:
        """A policy for `count` parallel environments of the task."""


def check_tensors(tensors: Tensors, expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raises UsageError for missing tensors, wrong shapes and values that are not finite."""
    if set(tensors) != set(expected):
        raise UsageError(f"network has tensors {sorted(tensors)}; expected {sorted(expected)}")
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise UsageError(f"tensor {name} has shape {tensors[name].shape}; expected {shape}")
        if not np.isfinite(tensors[name]).all():
            raise UsageError(f"tensor {name} has values that are not finite")


def check_observations(observations: NDArray[Any], shape: tuple[int, ...]) -> None:
    """Raises UsageError for observations of another shape, or with values that are not finite."""
    if observations.shape != shape:
        raise UsageError(f"observations have shape {observations.shape}; the policy takes {shape}")
    if not np.isfinite(observations).all():
        wrong = np.flatnonzero(~np.isfinite(observations.reshape(len(observations), -1)).all(1))
        raise UsageError(f"observation {wrong[0]} has values that are not finite")
