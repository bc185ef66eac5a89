"""Every registered environment: Gymnasium's checker, and results that are determined by the seed bit for bit."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gelflow.errors import UsageError
from gelflow.gymnasium_registration import ENVIRONMENTS
from gelflow.sim.tasks.registry import make_task, task_names

ids = pytest.mark.parametrize("name", ENVIRONMENTS)


@ids
def test_environment_passes_gymnasium_check(name: str) -> None:
    env = gymnasium.make(name, threads=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*observation space (minimum|maximum) value is.*infinity")
        check_env(env.unwrapped)


@ids
def test_a_randomization_is_chosen_by_its_name(name: str) -> None:
    gymnasium.make(name, randomization="default", threads=1)
    with pytest.raises(UsageError, match="randomization"):
        gymnasium.make(name, randomization="broad", threads=1)


@ids
def test_render_gives_a_picture(name: str) -> None:
    env = gymnasium.make(name, render_mode="rgb_array", threads=1)
    env.reset(seed=0)
    picture: Any = env.render()
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert picture.std() > 5


@ids
def test_a_seed_determines_every_bit(name: str) -> None:
    def run(threads: int) -> list[Any]:
        envs: Any = gymnasium.make_vec(name, num_envs=3, vectorization_mode="vector_entry_point", threads=threads)
        rng = np.random.default_rng(0)
        results: list[Any] = [envs.reset(seed=11)[0]]
        for _ in range(12):
            actions = rng.uniform(-1, 1, (3, *envs.single_action_space.shape))
            observation, reward, terminated, truncated, info = envs.step(actions.astype(np.float32))
            results += [observation, reward, terminated, truncated, info["privileged"]]
        return results

    first = run(1)
    for threads in (1, 2):
        for one, other in zip(first, run(threads), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("task", task_names())
def test_every_task_has_its_tables_and_an_oracle_or_none(task: str) -> None:
    for table in ("default", "full"):
        batch = make_task(task, 2, randomization=table, threads=1)
        rng = np.random.default_rng(0)
        batch.reset(batch.all, rng, keep_ended=True)
        batch.step(np.zeros((2, *batch.action_space.shape)), rng)
        assert np.isfinite(batch.observation).all() and batch.info["privileged"].shape[0] == 2
        assert batch.description.digest() == type(batch.description).from_json(batch.description.to_json()).digest()
