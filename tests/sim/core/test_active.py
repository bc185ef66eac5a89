"""A mask of active environments: the others keep state, status and readings, and the active ones are unaffected."""

import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

ENVS, STEPS = 6, 8
STATE = ("q", "v", "anchors", "anchored", "history", "status", "iterations", "halved")
ACTIVE = np.array([True, False, True, False, False, True])

Array = NDArray[Any]


@pytest.fixture(scope="module", params=[("grasp", "elastic"), ("pushing", "viscous")], ids=str)
def scene(request: pytest.FixtureRequest) -> Scene:
    name, friction = request.param
    return load_scene(name, friction=friction, preset="fast" if name == "grasp" else None)


def in_contact(scene: Scene, *, threads: int = 1, precision: Any = None) -> tuple[Simulator, Array]:
    """Environments with different masses, 0.2 s into the reference motion, and controls of the next steps."""
    motion = reference_motion(scene)
    u = motion.step_controls(scene.step)
    start = round(0.2 / scene.step)
    sim = Simulator(scene, num_envs=ENVS, threads=threads, precision=precision)
    sim.q[:] = motion.q0
    sim.param(f"{scene.bodies[-1].name}.mass")[:] *= 1 + 0.1 * np.arange(ENVS)
    for now in u[:start]:
        sim.step(now)
    sim.check()
    return sim, np.repeat(u[start : start + STEPS, None], ENVS, axis=1)


def state(sim: Simulator) -> list[Array]:
    return [getattr(sim, name).copy() for name in STATE]


@pytest.mark.parametrize("threads", (1, 2))
@pytest.mark.parametrize("precision", ("double", "single"))
def test_active_environments_step_and_the_others_rest(scene: Scene, threads: int, precision: str) -> None:
    masked, u = in_contact(scene, threads=threads, precision=precision)
    full, _ = in_contact(scene, precision=precision)
    before = state(masked)
    for now in u:
        full.step(now)
        masked.step(now, active=ACTIVE)
    for name, first, resting, stepped in zip(STATE, before, state(masked), state(full), strict=True):
        np.testing.assert_array_equal(resting[~ACTIVE], first[~ACTIVE], err_msg=name)
        np.testing.assert_array_equal(resting[ACTIVE], stepped[ACTIVE], err_msg=name)
    assert not np.array_equal(full.q[~ACTIVE], masked.q[~ACTIVE])


def test_readings_of_resting_environments_stay(scene: Scene) -> None:
    sim, u = in_contact(scene)
    first = sim.tactile().copy()
    assert np.abs(first).max((1, 2)).min() > 0
    sim.step(u[0], 3)
    masked = sim.tactile(active=ACTIVE).copy()
    np.testing.assert_array_equal(masked[~ACTIVE], first[~ACTIVE])
    out = np.full_like(first, 7.0)
    sim.tactile(out, active=ACTIVE)
    assert (out[~ACTIVE] == 7).all()
    full = sim.tactile()
    np.testing.assert_array_equal(masked[ACTIVE], full[ACTIVE])
    np.testing.assert_array_equal(out[ACTIVE], full[ACTIVE])
    assert not np.array_equal(full, masked)


@pytest.mark.parametrize("threads", (1, 2))
def test_rollout_with_resting_environments(scene: Scene, threads: int) -> None:
    sim, u = in_contact(scene, threads=threads)
    reads = (0, 3, STEPS)
    full = sim.rollout(u, read_after=reads)
    part = sim.rollout(u, read_after=reads, active=ACTIVE)
    assert (part.active == ACTIVE).all() and (full.active == 1).all() and (part.stopped_at == -1).all()
    for name in ("q", "v", "anchors", "anchored", "history"):
        rows, given = getattr(part, name), getattr(full, name)
        np.testing.assert_array_equal(rows[:, ACTIVE][part.anchored[:, ACTIVE] > 0] if name == "anchors" else
                                      rows[:, ACTIVE],
                                      given[:, ACTIVE][full.anchored[:, ACTIVE] > 0] if name == "anchors" else
                                      given[:, ACTIVE])  # fmt: skip
        set_now = part.anchored[0, ~ACTIVE] > 0
        for later in rows[:, ~ACTIVE]:
            kept = (later[set_now], rows[0, ~ACTIVE][set_now]) if name == "anchors" else (later, rows[0, ~ACTIVE])
            np.testing.assert_array_equal(*kept, err_msg=name)
    np.testing.assert_array_equal(part.tactile[:, ACTIVE], full.tactile[:, ACTIVE])
    assert not part.tactile[:, ~ACTIVE].any()
    again = sim.rollout(u, read_after=reads, active=~ACTIVE, out=part)
    np.testing.assert_array_equal(again.tactile, full.tactile)  # those of the active ones are left from `part`


def test_resting_environments_may_hold_values_that_are_not_finite(scene: Scene) -> None:
    sim, u = in_contact(scene)
    sim.q[1, 0] = np.nan
    u[2, 3, 0] = np.nan
    sim.step(u[2], active=ACTIVE)
    assert sim.rollout(u, active=ACTIVE).status.tolist() == [0] * ENVS
    with pytest.raises(UsageError, match=re.escape("q[1, 0] is not finite")):
        sim.step(u[0])


def test_no_active_environment(scene: Scene) -> None:
    sim, u = in_contact(scene, threads=2)
    before = state(sim)
    sim.step(u[0], active=np.zeros(ENVS, bool))
    for first, now in zip(before, state(sim), strict=True):
        np.testing.assert_array_equal(now, first)


def test_masks_of_wrong_shape_raise(scene: Scene) -> None:
    sim, u = in_contact(scene)
    expected = re.escape(f"active must have shape ({ENVS},), got (2,)")
    for call in (
        lambda: sim.step(u[0], active=[True, False]),
        lambda: sim.rollout(u, active=[True, False]),
        lambda: sim.tactile(active=[True, False]),
    ):
        with pytest.raises(UsageError, match=expected):
            call()
    with pytest.raises(UsageError, match=re.escape(f"which must have shape ({ENVS},), got (2,)")):
        sim.reset([True, False])


def test_gradient_of_resting_environments_is_that_of_their_initial_state(scene: Scene) -> None:
    sim, u = in_contact(scene)
    rng = np.random.default_rng(1)
    full, part = (sim.rollout(u, read_after=(2, STEPS), active=mask) for mask in (None, ACTIVE))
    by = {name: rng.normal(size=getattr(full, name).shape) for name in ("q", "v", "tactile")}
    whole, resting = (sim.rollout_gradient(run, params=True, **by) for run in (full, part))
    for name in ("q", "v", "anchors", "history", "params"):
        np.testing.assert_array_equal(getattr(resting, name)[ACTIVE], getattr(whole, name)[ACTIVE], err_msg=name)
    np.testing.assert_allclose(resting.v[~ACTIVE], by["v"].sum(0)[~ACTIVE], rtol=1e-12)
    assert not resting.u[:, ~ACTIVE].any() and not resting.params[~ACTIVE].any()
