"""The state of an unfinished training run: tensors and JSON values in one file that is replaced atomically."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import torch
from safetensors.torch import load_file, save

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import replace_file

_KEY = "gelflow-run"
FORMAT = 1


@dataclass
class RunState:
    """Everything that a learner needs to continue: tensors by name, and JSON values."""

    tensors: dict[str, torch.Tensor] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)

    def add(self, prefix: str, tensors: Mapping[str, torch.Tensor]) -> None:
        """Adds tensors under `prefix`."""
        self.tensors |= {f"{prefix}/{name}": tensor for name, tensor in tensors.items()}

    def part(self, prefix: str) -> dict[str, torch.Tensor]:
        """The tensors that were added under `prefix`."""
        start = f"{prefix}/"
        return {name.removeprefix(start): tensor for name, tensor in self.tensors.items() if name.startswith(start)}


def save_state(path: Path, state: RunState) -> None:
    """Writes the state; a process that is killed meanwhile leaves the previous file intact."""
    tensors = {name: tensor.detach().contiguous().clone() for name, tensor in state.tensors.items()}
    data = save(tensors, metadata={_KEY: json.dumps({"format": FORMAT, **state.values}, sort_keys=True)})
    replace_file(path, data)


def load_state(path: Path) -> RunState:
    """Reads a state. Raises UsageError when the file is damaged or has a newer format."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            values = json.loads(file.metadata()[_KEY])
        if values.pop("format") > FORMAT:
            raise UsageError(f"{path} has a newer format; this gelflow reads format {FORMAT}: update gelflow")
        return RunState(load_file(path), values)
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"{path} is damaged ({type(error).__name__}); delete the run's folder and train again"
        ) from error


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """The moments of an optimizer such as Adam, as tensors by name."""
    states = optimizer.state_dict()["state"]
    return {f"{i}/{key}": torch.as_tensor(value) for i, values in states.items() for key, value in values.items()}


def load_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Restores the moments of `optimizer_tensors`."""
    states: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split("/")
        states.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": states})


def generator_value(rng: np.random.Generator) -> dict[str, Any]:
    """The state of a NumPy generator as JSON data."""
    return dict(rng.bit_generator.state)


def generator_from(value: dict[str, Any]) -> np.random.Generator:
    """The generator with the state of `generator_value`."""
    rng = np.random.default_rng()
    rng.bit_generator.state = value
    return rng
