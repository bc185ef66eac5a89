"""Actors compute the same in NumPy and in torch, and keep a memory for each environment."""

import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.registry import architecture_from_json
from gelflow.policies.networks.torch_actor import TorchActor, VectorEncoder
from gelflow.task import INSERTION

ACTORS = [
    MLP(observation_shape=(7,), actions=3, hidden=(16, 8)),
    MLP(observation_shape=(7,), actions=3, hidden=(16,), recurrent=5),
    CNN(observation_shape=(4, 13, 10), actions=1),
    CNN(observation_shape=(4, 9, 8), actions=2, channels=(3, 5), hidden=6, recurrent=4),
]


def trained(architecture: ActorArchitecture) -> TorchActor:
    """An actor with random weights and statistics of observations."""
    torch.manual_seed(0)
    actor = TorchActor(architecture)
    with torch.no_grad():
        actor.head.weight *= 20
        actor.absorb(3 + 2 * torch.randn(50, *architecture.observation_shape))
    return actor


@pytest.mark.parametrize("architecture", ACTORS)
def test_numpy_and_torch_compute_the_same(architecture: ActorArchitecture) -> None:
    actor = trained(architecture)
    policy = architecture.network(INSERTION, actor.tensors()).batch_policy(6)
    rng, memory = np.random.default_rng(0), actor.initial_memory(6)
    for step in range(4):
        observations = rng.normal(1, 1, (6, *architecture.observation_shape)).astype(np.float32)
        if step == 2:
            ended = np.array([True, False] * 3)
            policy.reset(ended)
            memory = memory * torch.from_numpy(~ended)[:, None]
        with torch.no_grad():
            wanted, memory = actor(torch.from_numpy(observations), memory)
        assert np.allclose(policy.act(observations), wanted.clamp(-1, 1).numpy(), atol=2e-5)


@pytest.mark.parametrize("architecture", ACTORS)
def test_the_settings_of_an_actor_survive_json(architecture: ActorArchitecture) -> None:
    assert architecture_from_json(architecture.to_json()) == architecture


def test_the_statistics_of_observations_accumulate() -> None:
    encoder = VectorEncoder((3, 4), variance_floor=1e-6, clip=8.0)
    values = torch.randn(90, 3) * 3 + 1
    for part in values.split([20, 30, 40]):
        encoder.absorb(part)
    assert torch.allclose(encoder.mean, values.mean(0), atol=1e-5)
    assert torch.allclose(encoder.variance, values.var(0, correction=0), atol=1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MLP(observation_shape=(4, 13, 10), actions=1), "vectors"),
        (lambda: CNN(observation_shape=(5,), actions=1), "images"),
        (lambda: CNN(observation_shape=(4, 5, 5), actions=1), "too small"),
        (lambda: MLP(observation_shape=(5,), actions=0), "actions ≥ 1"),
    ],
)
def test_impossible_settings_are_rejected(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(UsageError, match=message):
        make()


def test_impossible_observations_and_masks_are_refused_without_a_change_of_the_memory() -> None:
    network = ACTORS[1].network(INSERTION, trained(ACTORS[1]).tensors())
    policy, other = network.batch_policy(2), network.batch_policy(2)
    observations = np.random.default_rng(0).normal(size=(2, 7))
    assert (policy.act(observations) == other.act(observations)).all()
    with pytest.raises(UsageError, match=r"shape \(2, 6\); the policy takes \(2, 7\)"):
        policy.act(np.zeros((2, 6)))
    with pytest.raises(UsageError, match="observation 1 has values that are not finite"):
        policy.act(np.where(np.arange(2)[:, None] == 1, np.nan, observations))
    for mask in (np.array([1, 0]), np.ones(3, dtype=bool)):
        with pytest.raises(UsageError, match=r"a mask of environments must be \(2,\) bool, got"):
            policy.reset(mask)
    assert (policy.act(observations) == other.act(observations)).all()
