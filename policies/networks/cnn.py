"""Shallow convolutional network for flow maps: Conv, ReLU, MaxPool, Conv, ReLU and two fully connected layers.

The paper uses this network for the stable grasp (appendix B.2). The second fully connected layer is the actor's head.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.base import Array
from gelflow.policies.networks.layers import convolution, linear, max_pool, relu

if TYPE_CHECKING:
    import torch

KERNEL = 3  # rows and columns


@dataclass(frozen=True)
class CNN(ActorArchitecture):
    """Two convolutions with kernels of 3 × 3 and one hidden layer."""

    kind: ClassVar[str] = "cnn"
    channels: tuple[int, int] = (16, 32)  # of the convolutions
    hidden: int = 64  # units of the fully connected layer

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.observation_shape) != 3 or len(self.channels) != 2 or min(*self.channels, self.hidden) < 1:
            raise UsageError(f"a convolutional network requires images as observations and 2 convolutions, got {self}")
        if min(self._last_image()) < 1:
            raise UsageError(f"images of {self.observation_shape[1:]} are too small for this network; at least 8 × 8")

    def _last_image(self) -> tuple[int, int]:
        """Rows and columns after the second convolution."""
        rows, cols = ((size - KERNEL + 1) // 2 - KERNEL + 1 for size in self.observation_shape[1:])
        return rows, cols

    @property
    def features(self) -> int:
        """Units of the fully connected layer."""
        return self.hidden

    def encoder_shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of the encoder."""
        first, second = self.channels
        return {
            "convolution1.weight": (first, self.observation_shape[0], KERNEL, KERNEL),
            "convolution1.bias": (first,),
            "convolution2.weight": (second, first, KERNEL, KERNEL),
            "convolution2.bias": (second,),
            "linear.weight": (self.hidden, second * int(np.prod(self._last_image()))),
            "linear.bias": (self.hidden,),
        }

    def encode(self, observations: NDArray[Any], tensors: dict[str, Array]) -> Array:
        """Features (n, hidden) of images (n, channels, rows, cols)."""
        images = observations.astype(float)
        images = max_pool(relu(convolution(images, tensors["convolution1.weight"], tensors["convolution1.bias"])))
        images = relu(convolution(images, tensors["convolution2.weight"], tensors["convolution2.bias"]))
        flat = images.reshape(len(images), -1)
        return relu(linear(flat, tensors["linear.weight"], tensors["linear.bias"]))

    def torch_encoder(self) -> "torch.nn.Module":
        """The encoder for training."""
        from gelflow.policies.networks.torch_actor import ImageEncoder  # deferred: torch is slow to import

        shapes = self.encoder_shapes()
        return ImageEncoder(self.observation_shape[0], self.channels, shapes["linear.weight"])
