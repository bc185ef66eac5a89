"""The touch stop of a rollout: equal to single steps with a check in between, per environment and for any threads."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import TouchStop, insertion_scene
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator

ENVS, STEPS = 6, 30
REFERENCE = 4
READS = (0, 3, 9, 15, 22, STEPS)
# [N] under the elastic law; the shear forces of the viscous law are smaller. The last environment does not stop.
THRESHOLD = np.array([1e-3, 1e-3, 3e-3, 1e-3, 6e-3, np.inf])

Array = NDArray[Any]


@pytest.fixture(scope="module", params=["viscous", "elastic"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return insertion_scene(preset="fast", friction=request.param)


def threshold(scene: Scene) -> Array:
    return THRESHOLD if scene.friction == "elastic" else 0.03 * THRESHOLD


def lowered(scene: Scene, *, threads: int = 1, precision: Any = "double") -> tuple[Simulator, Array]:
    """Parts in closed grippers, each at another offset, and the controls that lower them onto the rim."""
    sim = Simulator(scene, num_envs=ENVS, threads=threads, precision=precision)
    u = np.zeros((ENVS, scene.nu))
    u[:, [scene.u("finger_left"), scene.u("finger_right")]] = 8.0
    u[:, [scene.u("hold_left"), scene.u("hold_right")]] = -0.0175
    u[:, scene.u("arm_z")] = 0.0585
    u[:, scene.u("arm_x")] = 4e-3
    sim.step(u.astype(sim.dtype), 20)
    sim.check()
    # A rollout starts from the state arrays alone, without the rounding residual of single precision.
    start = {name: getattr(sim, name).copy() for name in ("q", "v", "anchors", "anchored", "history")}
    sim.reset()
    for name, values in start.items():
        getattr(sim, name)[:] = values
    descent = np.linspace(0, 1, STEPS + 1)[1:, None] * np.linspace(1e-3, 6e-3, ENVS)
    controls = np.repeat(u[None], STEPS, axis=0)
    controls[:, :, scene.u("arm_z")] -= descent
    return sim, controls.astype(sim.dtype)


def step_by_step(sim: Simulator, u: Array, stop: TouchStop) -> dict[str, Array]:
    """The same with single steps: environments that have stopped rest."""
    first = stop.after_step or stop.reference_step + 1
    pads = [sim.marker_slice(pad.name) for pad in sim.scene.pads]
    moving = np.ones(ENVS, bool)
    stopped_at = np.full(ENVS, -1)
    readings, states = [sim.tactile().copy()], [sim.q.copy()]
    for step, now in enumerate(u, 1):
        sim.step(now, active=moving)
        readings.append(sim.tactile(active=moving).copy())
        states.append(sim.q.copy())
        change = readings[-1].astype(float) - readings[min(step, stop.reference_step)]
        shear = np.max([np.abs(change[:, pad, 0].mean(1)) for pad in pads], axis=0)
        stops = moving & (shear > stop.threshold) & (step >= first)
        stopped_at[stops] = step
        moving &= ~stops
    return {"tactile": np.stack(readings), "q": np.stack(states), "stopped_at": stopped_at}


@pytest.mark.parametrize("precision", ("double", "single"))
@pytest.mark.parametrize("after_step", (None, 12))
def test_a_rollout_stops_like_single_steps(scene: Scene, precision: str, after_step: int | None) -> None:
    stop = TouchStop(threshold(scene), reference_step=REFERENCE, after_step=after_step)
    sim, u = lowered(scene, precision=precision)
    run = sim.rollout(u, read_after=READS, stop=stop)
    expected = step_by_step(sim, u, stop)
    np.testing.assert_array_equal(run.stopped_at, expected["stopped_at"])
    np.testing.assert_array_equal(run.tactile, expected["tactile"][list(READS)])
    np.testing.assert_array_equal(run.q, expected["q"])
    stopped = run.stopped_at >= 0
    assert 2 <= stopped.sum() < ENVS and len(set(run.stopped_at[stopped])) > 1, "the case covers both"
    assert not stopped[-1] and run.stopped_at[stopped].min() >= (after_step or REFERENCE + 1)
    if after_step:
        assert (run.stopped_at == after_step).any(), "a touch before that step counts from there on"
    for env in np.flatnonzero(stopped):
        later = run.q[run.stopped_at[env] :, env]
        assert (later == later[0]).all()


def test_results_do_not_depend_on_threads_or_batch(scene: Scene) -> None:
    stop = TouchStop(threshold(scene), reference_step=REFERENCE)
    sim, u = lowered(scene)
    one = sim.rollout(u, read_after=READS, stop=stop)
    two = lowered(scene, threads=2)[0].rollout(u, read_after=READS, stop=stop)
    for name in ("q", "v", "tactile", "stopped_at", "halvings", "status"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes(), name
    active = np.arange(ENVS) % 2 == 0
    some = sim.rollout(u, read_after=READS, stop=stop, active=active)
    np.testing.assert_array_equal(some.tactile[:, active], one.tactile[:, active])
    np.testing.assert_array_equal(some.stopped_at, np.where(active, one.stopped_at, -1))


def test_without_a_touch_nothing_changes(scene: Scene) -> None:
    sim, u = lowered(scene)
    plain = sim.rollout(u, read_after=READS)
    for stop in (TouchStop(np.inf), TouchStop(1e6, reference_step=3)):
        run = sim.rollout(u, read_after=READS, stop=stop)
        for name in ("q", "v", "tactile", "stopped_at", "halvings"):
            assert getattr(run, name).tobytes() == getattr(plain, name).tobytes(), name
    assert (plain.stopped_at == -1).all()


def test_a_failed_environment_does_not_stop(scene: Scene) -> None:
    sim, u = lowered(scene)
    stop = TouchStop(threshold(scene), reference_step=REFERENCE)
    whole = sim.rollout(u, stop=stop)
    env = int(whole.stopped_at.argmax())
    u[whole.stopped_at[env] - 1 :, env] = 1e200  # a force overflows in the step of the stop
    run = sim.rollout(u, stop=stop)
    others = np.arange(ENVS) != env
    assert run.status[env] != 0 and run.stopped_at[env] == -1
    np.testing.assert_array_equal(run.stopped_at[others], whole.stopped_at[others])


@pytest.mark.parametrize(
    ("stop", "message"),
    [
        (TouchStop(np.ones(2)), f"threshold must have shape ({ENVS},) or (), got (2,)"),
        (TouchStop(-1.0), "threshold must be at least 0 N everywhere"),
        (TouchStop(np.nan), "threshold must be at least 0 N everywhere"),
        (TouchStop(1.0, after_step=STEPS + 1), f"after_step ≤ {STEPS} steps of the rollout, got 0 and {STEPS + 1}"),
        (TouchStop(1.0, reference_step=5, after_step=5), "0 ≤ reference_step < after_step"),
        (TouchStop(1.0, reference_step=-1), "0 ≤ reference_step < after_step"),
    ],
)
def test_invalid_stops_raise(scene: Scene, stop: TouchStop, message: str) -> None:
    sim, u = lowered(scene)
    with pytest.raises(UsageError, match=re.escape(message)):
        sim.rollout(u, stop=stop)


def test_a_scene_without_pads_has_no_touch_stop() -> None:
    sim = Simulator(dataclasses.replace(load_scene("pushing"), pads=()))
    with pytest.raises(UsageError, match="a touch stop needs a scene with pads"):
        sim.rollout(np.zeros((3, 1, sim.model.nu)), stop=TouchStop(1.0))


def test_contact_modes_of_a_part_of_a_trajectory(scene: Scene) -> None:
    """It may end before the environments stopped."""
    sim, u = lowered(scene)
    run = sim.rollout(u, read_after=READS, stop=TouchStop(threshold(scene), reference_step=REFERENCE))
    steps = int(run.stopped_at.max()) - 2
    part = dataclasses.replace(
        run,
        **{name: getattr(run, name)[: steps + 1].copy() for name in ("q", "v", "anchors", "anchored", "history")},
        u=run.u[:steps].copy(),
        halvings=run.halvings[:steps].copy(),
        tactile=run.tactile[:1].copy(),
        read_after=run.read_after[:1],
    )
    modes = sim.contact_modes(part)
    assert modes.shape == (steps, ENVS)
    before_reading = [k for k in range(steps) if k + 1 not in READS]
    np.testing.assert_array_equal(modes[before_reading], sim.contact_modes(run)[:steps][before_reading])
