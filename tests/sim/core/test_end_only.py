"""Rollouts that keep their last state only: equal to the end of complete ones."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.trajectory import TouchStop, Trajectory
from gelflow.sim.validation.reference_motions import reference_motion

ENVS, STEPS = 4, 60
READS = (0, 17, STEPS)
ACTIVE = np.array([True, False, True, True])

Array = NDArray[Any]


def moving(scene_name: str, *, precision: Any = "double", **options: Any) -> tuple[Simulator, Array]:
    """Environments of a scene with controls of different size, and one that fails."""
    scene = load_scene(scene_name, friction="elastic", **options)
    sim, motion = Simulator(scene, num_envs=ENVS, threads=2, precision=precision), reference_motion(scene)
    sim.q[:] = motion.q0
    u = np.repeat(motion.step_controls(scene.step)[:STEPS, None], ENVS, axis=1)
    u *= np.linspace(0.7, 1.2, ENVS)[:, None]
    u[STEPS // 2, -1] = 1e200 if precision == "double" else 1e37
    return sim, u.astype(sim.dtype)


@pytest.mark.parametrize("precision", ("double", "single"))
@pytest.mark.parametrize("preset", (None, "balanced"))  # BDF1, and BDF2 with its history
@pytest.mark.parametrize("name", ("insertion", "rolling", "pushing"))
def test_the_end_is_that_of_a_complete_rollout(name: str, preset: str | None, precision: str) -> None:
    sim, u = moving(name, preset=preset, precision=precision)
    stops = (None, TouchStop(np.array([1e-4, 1e-3, np.inf, np.inf]))) if sim.model.num_markers else (None,)
    for stop in stops:
        for active in (None, ACTIVE):
            options: dict[str, Any] = {"read_after": READS, "active": active, "stop": stop}
            whole, end = sim.rollout(u, **options), sim.rollout(u, **options, end_only=True)
            assert whole.status[-1] != 0, "one of them fails"
            assert len(end.q) == len(end.anchors) == 1 and len(whole.q) == STEPS + 1
            for array in ("q", "v", "anchored", "history"):
                np.testing.assert_array_equal(getattr(end, array)[0], getattr(whole, array)[-1], err_msg=array)
            is_set = whole.anchored[-1] > 0
            np.testing.assert_array_equal(end.anchors[0][is_set], whole.anchors[-1][is_set])
            for array in ("tactile", "halvings", "status", "stopped_at", "active", "u"):
                np.testing.assert_array_equal(getattr(end, array), getattr(whole, array), err_msg=array)


def test_it_continues_from_the_end_of_the_arrays_that_it_reuses() -> None:
    sim, u = moving("insertion")
    u[STEPS // 2, -1] = u[0, -1]  # none fails
    whole = sim.rollout(np.concatenate([u, u]))
    run = sim.rollout(u, end_only=True)
    states = {name: getattr(run, name)[-1] for name in ("q", "v", "anchors", "anchored", "history")}
    again = sim.rollout(u, **states, end_only=True, out=run)
    for name in ("q", "v", "anchored", "history"):
        np.testing.assert_array_equal(getattr(again, name)[-1], getattr(whole, name)[-1], err_msg=name)


def test_a_rollout_without_steps_is_complete() -> None:
    sim, u = moving("insertion")
    run = sim.rollout(u[:0], read_after=(0,), end_only=True)
    np.testing.assert_array_equal(run.q[0], sim.q)
    assert sim.rollout_gradient(run, q=1.0).q.shape == sim.q.shape


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda sim, run, u: sim.rollout_gradient(run, q=1.0), "has its last state only"),
        (lambda sim, run, u: sim.contact_modes(run), "has its last state only"),
        (lambda sim, run, u: sim.rollout(u, out=run), f"out must have {STEPS + 1} states .see end_only., got 1"),
        (lambda sim, run, u: sim.rollout(u, end_only=True, out=sim.rollout(u)), "out must have 1 states"),
        (lambda sim, run, u: sim.rollout(u, end_only=1), "end_only must be True or False, got 1"),
    ],
)
def test_wrong_use_raises(call: Callable[[Simulator, Trajectory, Array], Any], message: str) -> None:
    sim, u = moving("pushing")
    run = sim.rollout(u, end_only=True)
    before = run.q.copy()
    with pytest.raises(UsageError, match=message):
        call(sim, run, u)
    np.testing.assert_array_equal(run.q, before)
