"""PPO on tasks whose simulation can fail."""

import numpy as np
import pytest
from tests.policies.toy_tasks import PointTask

from gelflow.errors import UsageError
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.ppo import PPO, PPOSettings
from gelflow.sim.tasks.task_batch import Array, Mask


class FailingTask(PointTask):
    """Each step costs 1, and the simulation fails in a step whose first action is positive."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.failures = 0

    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        super()._step(actions, rng, active)
        failed = active & (actions[:, 0] > 0)
        self.failures += int(failed.sum())
        self.info["failed"][active] = failed[active]
        self.info["success"][active], self.terminated[active], self.reward[active] = False, False, -1.0
        self.truncated[failed] = True


def test_a_policy_does_not_learn_to_make_the_simulation_fail() -> None:
    settings = PPOSettings(rollout=16, batch=128, epochs=5, learning_rate=5e-3, discount=0.95, entropy=0.0)
    task = FailingTask(32)
    learner = PPO(task, MLP(observation_shape=(4,), actions=2, hidden=(16,)), settings, seed=0, steps=6_000)
    while learner.steps < 5_000:
        before = task.failures
        learner.update()
    assert (task.failures - before) / (32 * 16) < 0.9


def make_learner(envs: int, *, rollout: int, batch: int, recurrent: int = 0) -> PPO:
    settings = PPOSettings(rollout=rollout, batch=batch, epochs=2)
    architecture = MLP(observation_shape=(4,), actions=2, hidden=(8,), recurrent=recurrent)
    return PPO(PointTask(envs), architecture, settings, seed=0, steps=1_000)


@pytest.mark.parametrize(
    ("envs", "rollout", "batch", "recurrent"),
    [(3, 1, 2, 4), (2, 4, 1, 4), (3, 3, 4, 0), (1, 2, 2, 0), (1, 2, 1, 4)],
)
def test_a_minibatch_of_one_step_does_not_stop_the_learning(
    envs: int, rollout: int, batch: int, recurrent: int
) -> None:
    learner = make_learner(envs, rollout=rollout, batch=batch, recurrent=recurrent)
    before = learner.tensors()["head.weight"].copy()
    for _ in range(3):
        assert np.isfinite(learner.update()["value_loss"])
    after = learner.tensors()
    assert all(np.isfinite(values).all() for values in after.values())
    assert (after["head.weight"] != before).any()


@pytest.mark.parametrize(
    ("envs", "rollout", "batch", "recurrent"),
    [(2, 4, 1, 0), (1, 1, 4, 0), (1, 1, 2, 4), (3, 1, 1, 4)],
)
def test_settings_with_which_nothing_is_learned_are_refused(
    envs: int, rollout: int, batch: int, recurrent: int
) -> None:
    with pytest.raises(UsageError, match=f"minibatches of one step: rollout {rollout}, batch {batch} and {envs} env"):
        make_learner(envs, rollout=rollout, batch=batch, recurrent=recurrent)
