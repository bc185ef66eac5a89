"""Actors in torch, for training; `actor.ActorNetwork` computes the same in NumPy."""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gelflow.policies.networks.actor import ActorArchitecture

HEAD_GAIN = 0.1  # of the initial head: the first actions are near 0


class TorchActor(nn.Module):
    """An actor, or a critic with one output."""

    def __init__(self, architecture: ActorArchitecture) -> None:
        super().__init__()
        self.encoder = architecture.torch_encoder()
        h = architecture.recurrent
        self.memory = nn.GRUCell(architecture.features, h) if h else None
        self.head = nn.Linear(h or architecture.features, architecture.actions)
        self.recurrent = h
        with torch.no_grad():
            self.head.weight *= HEAD_GAIN
            self.head.bias.zero_()

    def initial_memory(self, count: int) -> Tensor:
        """The memory (count, recurrent) at the start of an episode."""
        return torch.zeros(count, self.recurrent)

    def forward(self, observations: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (n, actions) and next memory (n, recurrent) for observations (n, …)."""
        features = self.encoder(observations)
        if self.memory is not None:
            features = memory = self.memory(features, memory)
        return self.head(features), memory

    def absorb(self, observations: Tensor) -> None:
        """Updates the statistics of a normalizing encoder by observations (n, …)."""
        if isinstance(self.encoder, VectorEncoder):
            self.encoder.absorb(observations)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The tensors for a checkpoint."""
        return {name: values.detach().numpy().astype(np.float32) for name, values in self.state_dict().items()}


class VectorEncoder(nn.Module):
    """Encoder of `mlp.MLP`, with running mean and variance of the observations."""

    def __init__(self, sizes: tuple[int, ...], *, variance_floor: float, clip: float) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(sizes[0]))
        self.register_buffer("variance", torch.ones(sizes[0]))
        self.register_buffer("count", torch.zeros(1))
        self.mean: Tensor
        self.variance: Tensor
        self.count: Tensor
        self.layers = nn.ModuleList(nn.Linear(wide, narrow) for wide, narrow in itertools.pairwise(sizes))
        self._variance_floor, self._clip = variance_floor, clip

    def forward(self, observations: Tensor) -> Tensor:
        """Features of observations (n, size)."""
        values = (observations - self.mean) / torch.sqrt(self.variance + self._variance_floor)
        values = values.clamp(-self._clip, self._clip)
        for layer in self.layers:
            values = torch.tanh(layer(values))
        return values

    @torch.no_grad()
    def absorb(self, observations: Tensor) -> None:
        """Adds observations (n, size) to mean and variance (Chan et al., parallel variance)."""
        n = len(observations)
        total = self.count + n
        change = observations.mean(0) - self.mean
        squares = self.variance * self.count + observations.var(0, correction=0) * n
        self.variance.copy_((squares + change**2 * self.count * n / total) / total)
        self.mean.add_(change * n / total)
        self.count.copy_(total)


class ImageEncoder(nn.Module):
    """Encoder of `cnn.CNN`."""

    def __init__(self, inputs: int, channels: tuple[int, int], linear: tuple[int, ...]) -> None:
        super().__init__()
        self.convolution1 = nn.Conv2d(inputs, channels[0], 3)
        self.convolution2 = nn.Conv2d(channels[0], channels[1], 3)
        self.linear = nn.Linear(linear[1], linear[0])

    def forward(self, images: Tensor) -> Tensor:
        """Features of images (n, channels, rows, cols)."""
        images = nn.functional.max_pool2d(torch.relu(self.convolution1(images)), 2)
        images = torch.relu(self.convolution2(images))
        return torch.relu(self.linear(images.flatten(1)))
