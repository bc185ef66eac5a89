"""Gymnasium environments of the insertion task, and the limits of corrections."""

import dataclasses
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from gelflow.errors import UsageError
from gelflow.sim.tasks.insertion import InsertionAttempts
from gelflow.sim.tasks.insertion_environments import InsertionEnv, InsertionVectorEnv
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.task import INSERTION

STAY = np.zeros(3, dtype=np.float32)


def vector(count: int, **options: Any) -> InsertionVectorEnv:
    return InsertionVectorEnv(count, **options)


def test_environment_passes_gymnasium_check() -> None:
    env = gymnasium.make("gelflow/Insertion-v0")
    assert env.observation_space.shape == (4, 13, 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_vector_environment_is_registered() -> None:
    envs = gymnasium.make_vec("gelflow/Insertion-v0", num_envs=3, vectorization_mode="vector_entry_point")
    images, _ = envs.reset(seed=0)
    assert images.shape == (3, 4, 13, 10) and images.dtype == np.float32
    assert images in envs.observation_space
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    envs.close()


def test_exact_correction_inserts_the_part() -> None:
    env = InsertionEnv(randomization=NOMINAL)
    _, info = env.reset(options={"misalignment": (4e-3, -3e-3, np.radians(6))})
    assert not info["inserted"] and info["attempts"] == 1
    cos, sin = np.cos(info["pose"][2]), np.sin(info["pose"][2])
    dx = -(cos * info["pose"][0] + sin * info["pose"][1])  # in the gripper's frame
    dy = -(-sin * info["pose"][0] + cos * info["pose"][1])
    action = np.array([dx, dy, -info["pose"][2]]) / INSERTION.action_scale
    _, reward, terminated, truncated, info = env.step(action.astype(np.float32))
    assert terminated and not truncated and info["inserted"]
    assert reward == pytest.approx(0, abs=1e-4)
    np.testing.assert_allclose(info["pose"], 0, atol=1e-8)
    assert info["height"] < 24.7e-3


def test_reward_equals_published_formula() -> None:
    env = InsertionEnv(randomization=NOMINAL)
    env.reset(options={"misalignment": (6e-3, 0, 0.1)})
    reward = env.step(STAY)[1]
    assert reward == pytest.approx(-1e4 * 36e-6 - 20 * 0.01, rel=1e-6)


def test_episode_is_truncated_after_the_last_attempt() -> None:
    env = InsertionEnv(randomization=NOMINAL, task=dataclasses.replace(INSERTION, attempts=3))
    env.reset(options={"misalignment": (6e-3, 6e-3, 0)})
    assert env.step(STAY)[2:4] == (False, False)
    _, _, terminated, truncated, info = env.step(STAY)
    assert (terminated, truncated, info["attempts"]) == (False, True, 3)


def test_simulation_failure_truncates_the_episode() -> None:
    env = InsertionEnv(randomization=NOMINAL.replace(hole_kn=(1e300, 1e300)))
    observation, info = env.reset(seed=0, options={"misalignment": (6e-3, 6e-3, 0)})
    assert info["failed"] and not info["inserted"]
    assert np.isfinite(observation).all()
    assert env.step(STAY)[2:4] == (False, True)


def test_starts_inserted_at_the_first_attempt_are_sampled_again() -> None:
    near = dataclasses.replace(INSERTION, misalignment=(4e-3, 4e-3, 0.0))  # a third of these are inserted at once
    envs = vector(24, task=near, randomization=NOMINAL)
    _, info = envs.reset(seed=3)
    assert not info["inserted"].any()
    assert (np.abs(info["pose"]) <= np.array(near.misalignment) + 1e-12).all()
    env = InsertionEnv(task=near, randomization=NOMINAL)
    assert not any(env.reset(seed=seed)[1]["inserted"] for seed in range(6))


def test_finished_environments_reset_in_the_same_step() -> None:
    envs = vector(4, randomization=NOMINAL)
    images, info = envs.reset(seed=1)
    np.testing.assert_array_equal(info["attempts"], 1)
    perfect = np.zeros((4, 3))
    pose = info["pose"][2]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    perfect[2] = [-(cos * pose[0] + sin * pose[1]), sin * pose[0] - cos * pose[1], -pose[2]]
    before = info["pose"].copy()
    images, reward, terminated, truncated, info = envs.step(perfect / INSERTION.action_scale)
    assert terminated.tolist() == [False, False, True, False] and not truncated.any()
    assert reward[2] == pytest.approx(0, abs=1e-3)
    np.testing.assert_array_equal(info["attempts"], [2, 2, 1, 2])
    np.testing.assert_array_equal(info["_final_obs"], terminated)
    assert info["final_obs"][2].shape == (4, 13, 10) and info["final_obs"][0] is None
    assert info["final_info"]["attempts"][2] == 2 and info["final_info"]["inserted"][2]
    np.testing.assert_allclose(info["final_info"]["pose"][2], 0, atol=1e-8)
    assert np.abs(info["pose"][2]).max() > 0  # a new part at another pose
    assert (info["pose"][[0, 1, 3]] == before[[0, 1, 3]]).all()
    assert np.abs(images[2] - info["final_obs"][2]).max() > 0.1
    # The new part keeps its pose; a second attempt gives the same observation.
    again = envs.step(np.zeros((4, 3)))[0]
    assert np.linalg.norm(again[2] - images[2]) < 0.2 * np.linalg.norm(images[2])


def test_a_seed_determines_all_results() -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.4, 0.4, (6, 5, 3))
    runs = []
    for threads in (1, 2):
        envs = vector(5, threads=threads, task=dataclasses.replace(INSERTION, attempts=4))
        images = [envs.reset(seed=11)[0]]
        images += [envs.step(action)[0] for action in actions]
        runs.append(np.array(images))
        assert (runs[-1][0] == envs.reset(seed=11)[0]).all()
        assert not (runs[-1][0] == envs.reset(seed=12)[0]).all()
    assert (runs[0] == runs[1]).all()


def test_vector_environment_equals_single_environments() -> None:
    cases = np.array([[4e-3, 1e-3, 0.1], [-2e-3, 5e-3, -0.1]])
    silent = NOMINAL.replace(noise=(1e-30, 1e-30))
    actions = np.array([[0.1, -0.05, 0.2], [0.0, -0.1, 0.3]], dtype=np.float32)
    envs = vector(2, randomization=silent)
    first, _ = envs.reset(options={"misalignment": cases})
    then, reward, terminated, _, _ = envs.step(actions)
    for i, case in enumerate(cases):
        env = InsertionEnv(randomization=silent)
        image, _ = env.reset(options={"misalignment": case})
        np.testing.assert_array_equal(image, first[i])
        image, single, inserted, _, _ = env.step(actions[i])
        np.testing.assert_array_equal(image, then[i])
        assert (single, inserted) == (reward[i], terminated[i])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"misaligned": (0, 0, 0)}, "insertion: reset has no option 'misaligned'"),
        ({"misalignment": (0, 0)}, r"reset: misalignment must be finite, of shape \(3,\) or"),
        ({"misalignment": (0, 0, np.nan)}, "reset: misalignment must be finite"),
    ],
)
def test_invalid_reset_options_raise(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        InsertionEnv().reset(options=options)
    with pytest.raises(UsageError, match=message):
        vector(2).reset(options=options)


def test_invalid_actions_and_seeds_raise() -> None:
    envs = vector(2)
    with pytest.raises(UsageError, match="one random generator"):
        envs.reset(seed=[1, 2])
    envs.reset(seed=0)
    with pytest.raises(UsageError, match=r"actions must have shape \(2, 3\)"):
        envs.step(np.zeros(3))
    with pytest.raises(UsageError, match="steps must be at least 1"):
        InsertionAttempts(1, steps=0)


def test_corrections_rotate_with_the_gripper_and_are_limited_to_the_workspace() -> None:
    quarter = np.array([1e-3, 2e-3, np.pi / 2])
    wide = dataclasses.replace(INSERTION, workspace=(1.0, 1.0, 4.0))
    np.testing.assert_allclose(
        wide.corrected(quarter, np.array([1e-3, 0, 0.1])), [1e-3, 3e-3, np.pi / 2 + 0.1], atol=1e-15
    )
    np.testing.assert_allclose(wide.corrected(quarter, np.array([0, 1e-3, 0])), [0, 2e-3, np.pi / 2], atol=1e-15)
    far = INSERTION.corrected(np.array([[10e-3, -10e-3, 0.2]] * 2), np.array([[20e-3, 0, 0.2], [0, -1e-3, -0.1]]))
    np.testing.assert_allclose(far[0, [0, 2]], [15e-3, np.pi / 12])
    assert (np.abs(far) <= INSERTION.workspace).all()


def test_misalignment_is_sampled_from_the_range_of_the_task() -> None:
    drawn = INSERTION.draw_misalignment(np.random.default_rng(0), 1000)
    assert drawn.shape == (1000, 3)
    limit = np.array(INSERTION.misalignment)
    assert (np.abs(drawn) <= limit).all()
    np.testing.assert_allclose(np.abs(drawn).max(0), limit, rtol=0.02)


def test_observations_for_comparisons_show_forces_or_nothing() -> None:
    images, divisors = {}, {}
    for observation in ("flow map", "forces", "nothing"):
        envs = vector(8, task=dataclasses.replace(INSERTION, observation=observation))
        images[observation], info = envs.reset(seed=0)
        divisors[observation] = info["divisor"]
        assert images[observation] in envs.observation_space
    force = images["flow map"] * divisors["flow map"][:, None, None, None]  # [N]
    np.testing.assert_allclose(images["forces"], np.clip(force / 0.03, -1, 1), atol=1e-6)
    assert not images["nothing"].any()
    np.testing.assert_array_equal(divisors["forces"], divisors["flow map"])
    with pytest.raises(UsageError, match="observation must be one of flow map, forces, nothing, got 'sound'"):
        dataclasses.replace(INSERTION, observation="sound")
