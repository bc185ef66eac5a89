"""Copies and pickles of scenes and simulators are independent and continue with the same numbers."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.reductions import pad_forces
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("rolling", friction="elastic", overrides={"integrator": "bdf2"})


@pytest.mark.parametrize("how", COPIES)
def test_copy_of_a_simulator_continues_like_the_original(how: str, scene: Scene) -> None:
    sim = Simulator(scene, num_envs=2)
    sim.params[1] *= 1.01
    u = np.full((2, scene.nu), 0.01)
    sim.step(u, 20)
    other = COPIES[how](sim)
    assert other.num_envs == 2 and other.dtype == sim.dtype
    start = sim.q.copy()
    other.step(u, 20)
    np.testing.assert_array_equal(sim.q, start)
    sim.step(u, 20)
    for name in ("q", "v", "params", "anchors", "anchored", "history", "status", "iterations", "halved"):
        np.testing.assert_array_equal(getattr(other, name), getattr(sim, name))


@pytest.mark.parametrize("how", COPIES)
def test_copy_of_a_scene_builds_the_same_model(how: str, scene: Scene) -> None:
    other = COPIES[how](scene)
    np.testing.assert_array_equal(Simulator(other).params, Simulator(scene).params)


@pytest.mark.parametrize("how", COPIES)
def test_copy_of_a_rollout_with_a_reduction_has_its_gradient(how: str, scene: Scene) -> None:
    sim = Simulator(scene)
    run = sim.rollout(np.full((20, 1, scene.nu), 0.1), read_after=(20,), reduction=pad_forces(scene))
    gradient, other = (sim.rollout_gradient(r, tactile=1.0).u for r in (run, COPIES[how](run)))
    np.testing.assert_array_equal(other, gradient)


@pytest.mark.parametrize("how", COPIES)
def test_simulator_of_a_core_model_is_refused(how: str, scene: Scene) -> None:
    with pytest.raises(UsageError, match="build it from a Scene"):
        COPIES[how](Simulator(scene.build()))
