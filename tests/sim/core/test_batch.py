"""Batches: results independent of the batch, errors for values that are not finite, and isolated failures."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim import _core
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import STATUS_MESSAGES, Simulator
from gelflow.sim.validation.reference_motions import SCENES, reference_motion

Array = NDArray[np.float64]

ENVS, STEPS = 5, 12


@pytest.fixture(scope="module", params=["viscous", "elastic"])
def insertion(request: pytest.FixtureRequest) -> Scene:
    return load_scene("insertion", friction=request.param)


def controls(scene: Scene) -> Array:
    """Controls that hold the part and lower it onto the rim, slightly different per environment; (steps, envs, nu)."""
    rng = np.random.default_rng(3)
    u = np.zeros((STEPS, ENVS, scene.nu))
    u[..., [scene.u("finger_left"), scene.u("finger_right")]] = 5.0 + rng.normal(size=(ENVS, 2))
    u[..., [scene.u("hold_left"), scene.u("hold_right")]] = -0.0175
    u[..., scene.u("arm_x")] = rng.normal(size=ENVS) * 3e-3
    u[..., scene.u("arm_z")] = 0.0585 - np.linspace(0, 3e-3, STEPS)[:, None] + rng.normal(size=ENVS) * 1e-4
    return u


def started(scene: Any, envs: list[int], *, threads: int = 1, precision: Any = "double") -> Simulator:
    """A batch of the given environments, with individual starts and friction."""
    sim = Simulator(scene, num_envs=len(envs), threads=threads, precision=precision)
    sim.q[:, scene.q("arm_x")] += 1e-4 * np.array(envs)[:, None]
    sim.param("pad_left.mu")[:] = 1.0 + 0.1 * np.array(envs)
    return sim


def trace(sim: Simulator, u: Array) -> list[Array]:
    """State, anchors and marker forces after every step, environments along the first axis."""
    rows = []
    for now in u:
        sim.step(now)
        rows.append(
            [x.reshape(sim.num_envs, -1).copy() for x in (sim.q, sim.v, sim.anchors, sim.tactile(), sim.wrenches())]
        )
    return [np.concatenate([part for row in rows for part in row], axis=1)[e] for e in range(sim.num_envs)]


def test_results_are_bitwise_independent_of_threads_and_batch(insertion: Scene) -> None:
    u = controls(insertion)
    reference = trace(started(insertion, list(range(ENVS))), u)
    assert len({row.tobytes() for row in reference}) == ENVS  # the environments differ
    for threads in (2, 3):
        again = trace(started(insertion, list(range(ENVS)), threads=threads), u)
        assert [row.tobytes() for row in again] == [row.tobytes() for row in reference]
    for env in range(ENVS):
        (alone,) = trace(started(insertion, [env]), u[:, [env]])
        assert alone.tobytes() == reference[env].tobytes()
    order = [3, 0, 4]
    others = trace(started(insertion, order, threads=2), u[:, order])
    assert [row.tobytes() for row in others] == [reference[env].tobytes() for env in order]


@pytest.mark.parametrize("name", SCENES)
def test_other_environments_of_a_thread_do_not_affect_results(name: str) -> None:
    """Both run on one thread and share its workspace, in which only the first needs some values, such as the offset of
    the centre of mass."""
    scene = load_scene(name)
    moves = reference_motion(scene)
    u = moves.step_controls(scene.step)[:3, None]
    runs = []
    for envs in (1, 2):
        sim = Simulator(scene, num_envs=envs, threads=1)
        sim._batch.checks_params = False  # the values of the first environment need not be physical
        params = sim.params[0]
        scale = np.where(np.isfinite(params), np.where(params == 0, 1.0, params), 0.0)
        sim.params[: envs - 1] += 1e-3 * scale * np.random.default_rng(1).normal(size=params.shape)
        sim.q[:] = moves.q0
        run = sim.rollout(np.repeat(u, envs, axis=1), read_after=(1, 3))
        back = sim.rollout_gradient(run, q=np.ones(()), tactile=np.ones(()), params=True)
        runs.append((run.q, run.v, run.tactile, back.u, back.v, back.params))
    for alone, beside in zip(*runs, strict=True):
        axis = 0 if alone.ndim < 3 else 1
        np.testing.assert_array_equal(alone.take(-1, axis), beside.take(-1, axis))


def test_rollout_equals_steps(insertion: Scene) -> None:
    u = controls(insertion)
    sim = started(insertion, list(range(ENVS)), threads=2)
    run = sim.rollout(u, read_after=[0, STEPS])
    np.testing.assert_array_equal(sim.tactile(), run.tactile[0])  # the simulator's own state is unchanged
    for step in range(STEPS):
        np.testing.assert_array_equal(sim.q, run.q[step])
        sim.step(u[step])
    np.testing.assert_array_equal(sim.v, run.v[-1])
    np.testing.assert_array_equal(sim.anchors[sim.anchored > 0], run.anchors[-1][sim.anchored > 0])
    np.testing.assert_array_equal(sim.tactile(), run.tactile[1])


def test_several_steps_in_one_call_equal_single_steps(insertion: Scene) -> None:
    u = controls(insertion)[0]
    at_once, one_by_one = (started(insertion, list(range(ENVS))) for _ in range(2))
    at_once.step(u, steps=7)
    for _ in range(7):
        one_by_one.step(u)
    assert at_once.q.tobytes() == one_by_one.q.tobytes()
    assert at_once.v.tobytes() == one_by_one.v.tobytes()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_raise_with_their_name(insertion: Scene, bad: float) -> None:
    u = controls(insertion)
    sim = started(insertion, list(range(ENVS)))
    before = sim.q.copy()
    wrong = u[0].copy()
    wrong[3, insertion.u("arm_yaw")] = bad
    with pytest.raises(UsageError, match="'arm_yaw' in environment 3 is not finite"):
        sim.step(wrong)
    whole = u.copy()
    whole[4, 2, insertion.u("hold_left")] = bad
    with pytest.raises(UsageError, match="'hold_left' in environment 2 is not finite"):
        sim.rollout(whole)
    sim.v[1, 6] = bad
    with pytest.raises(UsageError, match=re.escape("v[1, 6] is not finite")):
        sim.step(u[0])
    with pytest.raises(UsageError, match=re.escape("v[1, 6] is not finite")):
        sim.rollout(u)
    sim.v[1, 6], sim.q[4, 2] = 0, bad
    with pytest.raises(UsageError, match=re.escape("q[4, 2] is not finite")):
        sim.step(u[0])
    sim.q[4, 2] = before[4, 2]
    np.testing.assert_array_equal(sim.q, before)  # no step was taken
    assert not sim.status.any()
    sim.step(u[0])
    sim.check()


def test_wrong_shapes_and_types_raise(insertion: Scene) -> None:
    sim = started(insertion, [0, 1])
    nu = insertion.nu
    with pytest.raises(UsageError, match=rf"u must have shape \(2, {nu}\) or \({nu},\), got \(3, {nu}\)"):
        sim.step(np.zeros((3, nu)))
    for refusing in (sim.step, sim.error_estimate):
        for wrong in ("fast", None, print):
            with pytest.raises(UsageError, match="u must"):
                refusing(wrong)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match=rf"u must have shape \(2, {nu}\) or \({nu},\), got \(2,\)"):
            refusing([1.0, 2.0])
    with pytest.raises(UsageError, match="num_envs must be at least 1, got 0"):
        Simulator(insertion, num_envs=0)
    with pytest.raises(UsageError, match="precision must be 'double' or 'single', got 'half'"):
        Simulator(insertion, precision="half")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="no pad 'middle'; there are left, right"):
        sim.marker_slice("middle")


def test_zero_steps_do_nothing_and_negative_steps_raise(insertion: Scene) -> None:
    sim = started(insertion, [0])
    before = sim.q.copy()
    sim.step(controls(insertion)[0, :1], steps=0)
    np.testing.assert_array_equal(sim.q, before)


ABSURD = {"stiffness without measure": ("pad_left.kn", 1e305), "center of mass out of range": ("part.com.x", 1e200)}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("absurd", ABSURD)
def test_failed_environment_keeps_its_last_state_and_does_not_affect_others(
    insertion: Scene, absurd: str, threads: int
) -> None:
    u = controls(insertion)
    everyone = list(range(ENVS))
    reference, sim = started(insertion, everyone), started(insertion, everyone, threads=threads)
    for now in u[:6]:
        reference.step(now)
        sim.step(now)
    good = [x[2].copy() for x in (sim.q, sim.v, sim.anchors, sim.anchored)]
    name, value = ABSURD[absurd]
    sim.param(name)[2] = value
    for now in u[6:]:
        reference.step(now)
        sim.step(now)
    assert sim.status[2] != 0
    assert not np.delete(sim.status, 2).any()
    with pytest.raises(SimulationError, match="environment 2: " + STATUS_MESSAGES[int(sim.status[2])].split(",")[0]):
        sim.check()
    for kept, now in zip(good, (sim.q, sim.v, sim.anchors, sim.anchored), strict=True):
        np.testing.assert_array_equal(now[2], kept)
    for ours, theirs in ((sim.q, reference.q), (sim.v, reference.v), (sim.anchors, reference.anchors)):
        assert np.delete(ours, 2, axis=0).tobytes() == np.delete(theirs, 2, axis=0).tobytes()
    others = np.delete(sim.tactile(), 2, axis=0)
    assert others.tobytes() == np.delete(reference.tactile(), 2, axis=0).tobytes()
    # A corrected and reset environment continues.
    sim.param(name)[2] = reference.param(name)[2]
    sim.reset(np.arange(ENVS) == 2)
    sim.step(u[0])
    sim.check()


def test_iteration_limit_gives_a_failure_status(insertion: Scene) -> None:
    sim = Simulator(replace(insertion, max_step_iterations=1))
    start = insertion.q0
    sim.step(controls(insertion)[0, :1])
    assert sim.status[0] == 1
    np.testing.assert_array_equal(sim.q[0], start)
    with pytest.raises(SimulationError, match="environment 0: Newton's method did not converge"):
        sim.check()


def test_failed_environment_has_gradient_zero(insertion: Scene) -> None:
    u = controls(insertion)
    sim = started(insertion, list(range(ENVS)))
    sim.param("part.com.x")[1] = 1e200
    run = sim.rollout(u, read_after=[STEPS])
    assert run.status[1] != 0
    assert not np.delete(run.status, 1).any()
    np.testing.assert_array_equal(run.q[:, 1], np.broadcast_to(run.q[0, 1], run.q[:, 1].shape))
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0)
    for part in (gradient.u[:, 1], gradient.q[1], gradient.v[1], gradient.anchors[1]):
        np.testing.assert_array_equal(part, 0)
    assert all(np.isfinite(part).all() for part in (gradient.u, gradient.q, gradient.v, gradient.anchors))
    assert gradient.u[:, 0].any()


# Controls and number of steps, which include contact.
PUSHES = {
    "rolling": [([0.0, 0.0, 0.2], 100), ([0.1, 0.05, 0.2], 40)],
    "pushing": [([0.4, 0.0, 0.0, 0.0, 0.0, 0.0], 60), ([0.4, 0.05, 0.0, 0.0, 0.0, 0.0], 40)],
}


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
@pytest.mark.parametrize("name", PUSHES)
def test_single_precision_agrees_with_double(name: str, friction: str) -> None:
    scene = load_scene(name, friction=friction, overrides={"pads.pad.rows": 13, "pads.pad.cols": 13})
    double, single = (Simulator(scene, precision=p) for p in ("double", "single"))
    assert single.q.dtype == single.tactile().dtype == np.float32
    for sim in (double, single):
        sim.q[:] = scene.q0
        for u, steps in PUSHES[name]:
            sim.step(u, steps)
        sim.check()
    np.testing.assert_allclose(single.q, double.q, atol=1e-5)
    np.testing.assert_allclose(single.v, double.v, atol=1e-4)
    reading = double.tactile()
    np.testing.assert_allclose(single.tactile(), reading, atol=1e-3 * np.abs(reading).max())
    assert reading.any()


def test_single_precision_agrees_with_double_in_a_grasp(insertion: Scene) -> None:
    double, single = (started(insertion, list(range(ENVS)), precision=p) for p in ("double", "single"))
    for u in controls(insertion):
        for sim in (double, single):
            sim.step(u)
            sim.check()
    np.testing.assert_allclose(single.q, double.q, atol=1e-5)
    np.testing.assert_allclose(single.v, double.v, atol=2e-3)
    reading = double.tactile()
    np.testing.assert_allclose(single.tactile(), reading, atol=5e-3 * np.abs(reading).max())


def test_small_increments_accumulate_in_single_precision() -> None:
    """A step moves the body by 1e-9 m, 1/60 of the resolution of single precision at 0.5 m."""
    spec = _core.ModelSpec()
    spec.gravity, spec.step = (0.0, 0.0, 0.0), 1e-6
    body = spec.add_body(_core.BodyDef(name="body", mass=1.0, inertia=(1, 1, 1, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="body", body=body, type="free"))
    model = _core.Model(spec)
    stepped, rolled = Simulator(model, precision="single"), Simulator(model, precision="single")
    for sim in (stepped, rolled):
        sim.q[0, 0], sim.v[0, 0], sim.v[0, 5] = 0.5, 1e-3, 1e-3
    none = np.zeros((1000, 1, 0))
    stepped.step(none[0], 1000)
    end = rolled.rollout(none).q[-1, 0]
    for q in (stepped.q[0], end):
        assert q[0] - np.float32(0.5) == pytest.approx(1e-6, rel=0.1)
        assert q[6] == pytest.approx(0.5e-6, rel=1e-3)
    stepped.q[0, 0] = 1e-7  # the rounding residual belongs to the previous position
    stepped.step(none[0])
    assert stepped.q[0, 0] == pytest.approx(1.01e-7, rel=1e-5)


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
@pytest.mark.parametrize("name", SCENES)
def test_gradients_of_single_precision_agree_with_double(name: str, friction: str) -> None:
    scene = load_scene(name, friction=friction)
    moves = reference_motion(scene)
    u = moves.step_controls(scene.step)[:40, None]
    found = []
    for precision in ("double", "single"):
        sim = Simulator(scene, precision=precision)
        sim.q[:] = moves.q0
        run = sim.rollout(u, read_after=(20, 40))
        weights = np.random.default_rng(0).normal(size=run.tactile.shape)
        back = sim.rollout_gradient(run, v=np.ones(()), tactile=weights, params=True)
        alone = sim.rollout_gradient(
            run, v=np.ones(()), tactile=weights
        )  # reverse pass of viscous forces in single precision
        found.append((back.u, back.q, back.v, back.params, alone.u, alone.q, alone.v))
    for exact, single in zip(*found, strict=True):
        assert np.linalg.norm(single - exact) <= 1e-3 * np.linalg.norm(exact)


BUILDS = """
import sys
import numpy as np
from gelflow.sim import _core
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

assert _core.LEVEL == "base"
scene = load_scene("insertion", friction=sys.argv[1])
sim = Simulator(scene)
for u in np.load(sys.argv[2]):
    sim.step(u)
np.savez(sys.argv[3], q=sim.q, tactile=sim.tactile())
"""


def test_portable_build_agrees_with_the_native_build(insertion: Scene, tmp_path: Path) -> None:
    u = controls(insertion)[:, 0]
    np.save(tmp_path / "u.npy", u)
    command = [sys.executable, "-c", BUILDS, insertion.friction, str(tmp_path / "u.npy"), str(tmp_path / "end.npz")]
    subprocess.run(command, env={**os.environ, "GELFLOW_CORE": "base"}, check=True)
    sim = Simulator(insertion)
    for now in u:
        sim.step(now)
    other = np.load(tmp_path / "end.npz")
    np.testing.assert_allclose(sim.q, other["q"], atol=1e-9)
    np.testing.assert_allclose(sim.tactile(), other["tactile"], atol=1e-6)


@pytest.mark.parametrize(("wanted", "message"), [("fast", "must be base or v3"), ("", "")])
def test_requested_build_is_loaded_or_raises(wanted: str, message: str) -> None:
    command = [sys.executable, "-c", "import gelflow.sim._core"]
    run = subprocess.run(command, env={**os.environ, "GELFLOW_CORE": wanted}, capture_output=True, text=True)
    assert (run.returncode == 0) == (not message)
    assert message in run.stderr


def test_results_are_written_to_given_arrays(insertion: Scene) -> None:
    """Rollouts, poses and wrenches into existing arrays give the same values without copies."""
    u, sim = controls(insertion), started(insertion, list(range(ENVS)))
    reads = (0, 5, STEPS)
    right = sim.rollout(u, read_after=reads)
    other = sim.rollout(0.9 * u, read_after=(1, 2, 3))
    other.anchors[:] = 1.0
    again = sim.rollout(u, read_after=reads, out=other)
    for name in ("q", "v", "anchors", "anchored", "history", "tactile"):
        assert getattr(again, name) is getattr(other, name)
    for name in ("q", "v", "anchors", "anchored", "history", "u", "tactile", "read_after", "halvings", "status"):
        np.testing.assert_array_equal(getattr(again, name), getattr(right, name))
    for results in (sim.poses, sim.wrenches):
        own = np.zeros_like(results())
        assert results(own) is own
        np.testing.assert_array_equal(own, results())
    with pytest.raises(
        UsageError,
        match=re.escape("out must be a trajectory with u of shape (12, 5, 8) and 1 tactile readings, got"),
    ):
        sim.rollout(u, read_after=(3,), out=other)


def test_controls_of_any_memory_layout(insertion: Scene) -> None:
    u = controls(insertion)[0]
    one, two, three = (started(insertion, list(range(ENVS))) for _ in range(3))
    one.step(u, 3)
    two.step(np.asfortranarray(u), 3)
    three.step(np.repeat(u, 2, axis=1)[:, ::2].tolist(), 3)
    np.testing.assert_array_equal(one.q, two.q)
    np.testing.assert_array_equal(one.q, three.q)
    one.step(u[0], 3)
    two.step(np.repeat(u[:1], ENVS, axis=0), 3)
    np.testing.assert_array_equal(one.q, two.q)
