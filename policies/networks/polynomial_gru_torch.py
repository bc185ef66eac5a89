"""The trained layers of `PolynomialGRU` in torch, for training; a test compares them with the NumPy network."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.task import InsertionTask


class TorchPolynomialGRU(torch.nn.Module):
    """Outputs for sequences of inputs from `PolynomialGRUPolicy.observe`."""

    def __init__(self, architecture: PolynomialGRU, task: InsertionTask) -> None:
        super().__init__()
        self.first = torch.nn.Linear(architecture.inputs(task), architecture.units)
        self.gru = torch.nn.GRUCell(architecture.units, architecture.units)
        self.head = torch.nn.Linear(architecture.units, architecture.head)
        self.output = torch.nn.Linear(architecture.head, 3)

    def forward(self, inputs: torch.Tensor, starts: torch.Tensor) -> torch.Tensor:
        """Outputs (steps, n, 3) of `n` sequences.

        inputs: shape (steps, n, inputs)
        starts: bool, shape (steps, n): True at the first attempt of a part, where the memory is cleared
        """
        first = torch.tanh(self.first(inputs))
        state = first.new_zeros(first.shape[1:])
        states = []
        for values, start in zip(first, starts, strict=True):
            state = self.gru(values, torch.where(start[:, None], 0.0, state))
            states.append(state)
        output: torch.Tensor = self.output(torch.tanh(self.head(torch.stack(states))))
        return output

    def tensors(self) -> dict[str, NDArray[Any]]:
        """The trained tensors of a `PolynomialGRUNetwork`, float32."""
        return {name: values.detach().numpy().astype(np.float32) for name, values in self.state_dict().items()}
