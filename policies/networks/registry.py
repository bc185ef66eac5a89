"""The architectures that checkpoints may hold, by their `kind`."""

from collections.abc import Mapping
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.networks.base import Architecture
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP

_KINDS: tuple[type[Architecture], ...] = (CNN, MLP, PolynomialGRU, PolynomialMLP)
_ARCHITECTURES = {architecture.kind: architecture for architecture in _KINDS}


def architecture_from_json(data: Mapping[str, Any]) -> Architecture:
    """The architecture in the header of a checkpoint. Raises UsageError for an unknown kind and unknown keys."""
    if not isinstance(data, Mapping):
        raise UsageError(f"the architecture of the network must be a table, got {type(data).__name__}")
    kind = data.get("kind")
    if kind not in _ARCHITECTURES:
        raise UsageError(f"network is of kind {kind!r}; this gelflow supports {', '.join(sorted(_ARCHITECTURES))}")
    return _ARCHITECTURES[kind].from_json(data)
