"""Multilayer perceptron for vectors, which it normalizes by their mean and variance in training."""

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.base import Array
from gelflow.policies.networks.layers import linear

if TYPE_CHECKING:
    import torch

VARIANCE_FLOOR = 1e-6  # keeps constant components small


@dataclass(frozen=True)
class MLP(ActorArchitecture):
    """Normalization and hidden layers with tanh."""

    kind: ClassVar[str] = "mlp"
    clip: ClassVar[float] = 8.0  # largest normalized component
    hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.observation_shape) != 1 or not self.hidden or min(self.hidden) < 1:
            raise UsageError(f"a perceptron requires vectors as observations and hidden layers, got {self}")

    @property
    def features(self) -> int:
        """Units of the last hidden layer."""
        return self.hidden[-1]

    def encoder_shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of the encoder."""
        size = self.observation_shape[0]
        shapes: dict[str, tuple[int, ...]] = {"mean": (size,), "variance": (size,), "count": (1,)}
        for i, (wide, narrow) in enumerate(itertools.pairwise((size, *self.hidden))):
            shapes |= {f"layers.{i}.weight": (narrow, wide), f"layers.{i}.bias": (narrow,)}
        return shapes

    def encode(self, observations: NDArray[Any], tensors: dict[str, Array]) -> Array:
        """Features (n, features) of observations (n, size)."""
        values = (observations - tensors["mean"]) / np.sqrt(tensors["variance"] + VARIANCE_FLOOR)
        values = np.clip(values, -self.clip, self.clip)
        for i in range(len(self.hidden)):
            values = np.tanh(linear(values, tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]))
        return values

    def torch_encoder(self) -> "torch.nn.Module":
        """The encoder for training."""
        from gelflow.policies.networks.torch_actor import VectorEncoder  # deferred: torch is slow to import

        sizes = (self.observation_shape[0], *self.hidden)
        return VectorEncoder(sizes, variance_floor=VARIANCE_FLOOR, clip=self.clip)
