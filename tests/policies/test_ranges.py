"""Settings outside their range are refused with the name of the field and the range."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.policies.backpropagation import BackpropagationSettings
from gelflow.policies.imitation import ImitationSettings
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.policies.ppo import PPOSettings

NAN, INF = float("nan"), float("inf")
PPO_REFUSED = {
    "rollout": (0, 1.5, NAN, "a", True, None),
    "batch": (0, "a"),
    "epochs": (0, True),
    "learning_rate": (0.0, -1e-3, NAN, INF, "a"),
    "last_learning_rate": (-0.1, NAN),
    "discount": (2.0, -0.1, NAN),
    "trace": (1.1, NAN),
    "clip": (-1.0, 0.0),
    "value": (-0.5, INF),
    "entropy": (-0.01, NAN),
    "gradient_norm": (0.0, -1.0, NAN),
    "deviation": (0.0, INF),
}
BACKPROPAGATION_REFUSED = {
    "learning_rate": (NAN, 0.0),
    "betas": ((1.0, 2.0), (0.9, 1.0), (0.9,), 0.9),
    "gradient_norm": (0.0,),
    "window": (1.5, 0),
}
IMITATION_REFUSED = {
    "rollout": (0,),
    "updates": (0,),
    "batch": (0,),
    "memory": (0, 2.5),
    "learning_rate": (0.0, NAN),
    "gradient_norm": (0,),
    "tolerance": ((0, 0, 0), (1e-3, 1e-3), (1e-3, NAN, 0.1)),
    "bounded": (5.0, -0.1),
    "bounded_after": (-1.0, NAN),
    "exploration": ((-1, 0), (0.4, NAN), (0.4,)),
}
MLP_REFUSED = {"degree": (-1, 1.5), "history": (0,), "reach": ((8e-3, 8e-3), (8e-3, NAN, 0.2))}
REFUSED: list[tuple[Callable[..., Any], dict[str, tuple[Any, ...]]]] = [
    (PPOSettings, PPO_REFUSED),
    (BackpropagationSettings, BACKPROPAGATION_REFUSED),
    (ImitationSettings, IMITATION_REFUSED),
    (PolynomialMLP, MLP_REFUSED),
]


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [(make, name, value) for make, fields in REFUSED for name, values in fields.items() for value in values],
)
def test_a_value_out_of_range_is_refused(make: Callable[..., Any], name: str, value: Any) -> None:
    with pytest.raises(UsageError, match=rf"^{make.__name__}: {name} must be .*, got "):
        make(**{name: value})


def test_the_message_states_the_range() -> None:
    with pytest.raises(UsageError, match=r"^PPOSettings: discount must be a number from 0 to 1, got 2\.0$"):
        PPOSettings(discount=2.0)
    with pytest.raises(UsageError, match="exploration must be 2 values, each a finite number of at least 0, got"):
        ImitationSettings(exploration=(-1.0, 0.0))


def test_limits_and_numbers_of_numpy_are_valid() -> None:
    PPOSettings(rollout=1, discount=1, trace=0, entropy=0, learning_rate=np.float32(1e-3))  # type: ignore[arg-type]
    PPOSettings(batch=np.int64(10), epochs=10**400)  # type: ignore[arg-type]
    ImitationSettings(tolerance=None, bounded=0, bounded_after=1, exploration=(0, 0))
    BackpropagationSettings(betas=(0.0, 0.999))
