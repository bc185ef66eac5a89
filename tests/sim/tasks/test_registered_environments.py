"""Every registered environment: Gymnasium's checker, and results that are determined by the seed bit for bit."""

import copy
import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gelflow.errors import UsageError
from gelflow.gymnasium_registration import ENVIRONMENTS
from gelflow.sim.tasks.registry import make_task, randomizations, task_names

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
def test_wrong_options_are_errors(name: str) -> None:
    with pytest.raises((UsageError, TypeError), match="prest"):
        gymnasium.make(name, prest="fast")
    for option in ({"randomization": {"mass": 0.1}}, {"task": "grasp"}):
        with pytest.raises(UsageError, match=f"{next(iter(option))} must be"):
            gymnasium.make(name, **option)


@ids
def test_a_changed_table_is_kept_in_the_specification_of_the_environment(name: str) -> None:
    task = ENVIRONMENTS[name][2].get("batch", "insertion")
    table = randomizations(task)["default"].replace(noise=1e-4)
    env = gymnasium.make(name, randomization=table, threads=1)
    assert env.spec is not None and env.spec.kwargs["randomization"]["noise"] == table["noise"]
    sampled = table.drawn_from({"noise": [1e-5, 1e-4]})
    assert pickle.loads(pickle.dumps(sampled)).samples["noise"].tolist() == [1e-5, 1e-4]


@ids
def test_a_copy_continues_as_the_environment_does(name: str) -> None:
    env = gymnasium.make(name, randomization="full", threads=1, preset="fast")
    env.reset(seed=4)
    env.action_space.seed(0)
    env.step(env.action_space.sample())
    others = [copy.deepcopy(env.unwrapped), pickle.loads(pickle.dumps(env.unwrapped))]
    for _ in range(3):
        action = env.action_space.sample()
        observation, reward, *_ = env.unwrapped.step(action)
        for other in others:
            observed = other.step(action)
            np.testing.assert_array_equal(observed[0], observation)
            assert observed[1] == reward


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("gelflow/Grasp-v0", {"mass": "heavy"}, "mass must be numeric"),
        ("gelflow/Pushing-v0", {"mass": 0.0}, "half_size and mass must be above 0"),
        ("gelflow/Pushing-v0", {"half_size": (0.025, -0.025)}, "half_size and mass must be above 0"),
        ("gelflow/CapRotation-v0", {"radius": -0.05}, "radius must be above 0"),
        ("gelflow/Insertion-v0", {"misalignment": (2.0, 1.0, 5.0)}, "misalignment must be within the workspace"),
    ],
)
def test_an_impossible_start_is_an_error(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        gymnasium.make(name, threads=1).reset(seed=0, options=options)


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


def test_wrong_tables_and_negative_levels_are_errors() -> None:
    for options, message in (
        ({"ranges": "x"}, "ranges must be a mapping"),
        ({"samples": [1]}, "samples must be a mapping"),
        ({"foo": 1}, "no option 'foo'"),
    ):
        for name in ("grasp", "insertion"):
            with pytest.raises(UsageError, match=message):
                make_task(name, 1, **options)
    batch = make_task("insertion", 1, preset="fast", threads=1, ranges={"gel_creep": (-1, -0.5)})
    with pytest.raises(UsageError, match="gel_creep must not be negative"):
        batch.reset(batch.all, np.random.default_rng(0))


def test_gel_without_delay_creeps_at_once() -> None:
    batch = make_task("insertion", 1, preset="fast", threads=1, ranges={"gel_time": 0, "gel_creep": 0.2})
    batch.reset(batch.all, np.random.default_rng(0))
    assert np.isfinite(batch.observation).all()
