"""Policies of many insertions refuse impossible observations and masks before they change their memory."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.policies.toy_insertion import images

from gelflow.errors import UsageError
from gelflow.policies.networks.polynomial_features import polynomial_basis
from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.task import INSERTION

NETWORKS = [PolynomialGRU(units=4, head=3), PolynomialMLP(hidden=(5,))]


def network(architecture: PolynomialGRU | PolynomialMLP) -> Any:
    """A network with random weights."""
    rng = np.random.default_rng(0)
    shapes = architecture.tensor_shapes(INSERTION)
    values = {name: rng.normal(0, 0.3, shape) for name, shape in shapes.items()}
    fixed = {"basis": polynomial_basis(INSERTION.grid, architecture.degree), "scale": np.ones(shapes["scale"])}
    return architecture.network(INSERTION, values | fixed)


@pytest.mark.parametrize("architecture", NETWORKS)
@pytest.mark.parametrize(
    ("observations", "message"),
    [
        (images(3).transpose(0, 1, 3, 2), r"shape \(3, 4, 10, 13\); the policy takes \(3, 4, 13, 10\)"),
        (images(2), r"shape \(2, 4, 13, 10\); the policy takes \(3"),
        (np.where(np.arange(3)[:, None, None, None] == 2, np.nan, images(3)), "observation 2 has values that are not"),
        (images(3) * np.inf, "observation 0 has values"),
    ],
)
def test_impossible_observations_do_not_change_the_memory(
    architecture: PolynomialGRU | PolynomialMLP, observations: NDArray[Any], message: str
) -> None:
    policy, other = (network(architecture).batch_policy(3) for _ in range(2))
    assert (policy.act(images(3)) == other.act(images(3))).all()
    with pytest.raises(UsageError, match=message):
        policy.act(observations)
    assert (policy.act(images(3, seed=1)) == other.act(images(3, seed=1))).all()


@pytest.mark.parametrize("architecture", NETWORKS)
def test_a_reset_takes_a_mask_and_no_indices(architecture: PolynomialGRU | PolynomialMLP) -> None:
    policy = network(architecture).batch_policy(3)
    first = policy.act(images(3))
    for mask in (np.array([1, 0, 1]), np.ones(2, dtype=bool)):
        with pytest.raises(UsageError, match=r"a mask of environments must be \(3,\) bool, got"):
            policy.reset(mask)
    policy.reset(np.array([True, False, True]))
    assert ((policy.act(images(3)) == first).all(1) == [True, False, True]).all()
