"""Rollouts into the arrays of an earlier one."""

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

STATE = ("q", "v", "anchors", "anchored", "history")


def test_a_rollout_continues_from_the_end_of_the_arrays_that_it_reuses() -> None:
    scene = load_scene("pushing", friction="elastic")
    sim, moves = Simulator(scene), reference_motion(scene)
    sim.q[0] = moves.q0
    u = moves.step_controls(scene.step)[:80, None]
    run = sim.rollout(u)
    assert run.anchored[-1].any()
    right = sim.rollout(u, **{name: getattr(run, name)[-1].copy() for name in STATE})
    again = sim.rollout(u, **{name: getattr(run, name)[-1] for name in STATE}, out=run)
    for name in STATE:
        np.testing.assert_array_equal(getattr(again, name), getattr(right, name))


def test_a_trajectory_of_another_model_is_not_reused() -> None:
    viscous, elastic = (Simulator(load_scene("insertion", friction=law), num_envs=2) for law in ("viscous", "elastic"))
    u = np.zeros((3, 2, viscous.model.nu))
    with pytest.raises(UsageError, match="out is of another model: its anchors is float64"):
        elastic.rollout(u, out=viscous.rollout(u))
