"""Stress tests: results are finite, failures are rare, and bodies at rest do not move.

The distribution is described in gelflow.sim.validation.stress; benchmarks/stress.py runs two million steps.
"""

import numpy as np
import pytest

from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, load_scene
from gelflow.sim.simulator import STATUS_MESSAGES, Simulator
from gelflow.sim.validation.reference_motions import SCENES
from gelflow.sim.validation.stress import Precision, StepStatistics, StressBatch, StressTest, stress_batches

BOTH: tuple[Precision, ...] = ("double", "single")


@pytest.mark.parametrize("precision", BOTH)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("scene", SCENES)
def test_results_are_finite(scene: str, law: str, integrator: str, precision: Precision) -> None:
    sim, u = StressTest(envs=24, steps=20, threads=1, seed=3).start(
        StressBatch(scene, law, integrator, "all", precision)
    )
    run = sim.rollout(u, read_after=[10, 20])
    for values in (run.q, run.v, run.anchors, run.tactile, run.history):
        assert np.isfinite(values).all()
    assert set(run.status.tolist()) <= set(STATUS_MESSAGES)
    assert (run.status == 0).any()
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0, tactile=1.0)
    for values in (gradient.u, gradient.q, gradient.v, gradient.anchors, gradient.history):
        assert np.isfinite(values).all()
    assert not gradient.v[run.status != 0].any()


@pytest.mark.parametrize("precision", BOTH)
@pytest.mark.parametrize("scene", SCENES)
def test_no_step_of_the_normal_range_fails(scene: str, precision: Precision) -> None:
    stress = StressTest(envs=24, steps=20, threads=1, seed=4)
    for law in FRICTION_LAWS:
        for integrator in INTEGRATORS:
            statistics = stress.run(StressBatch(scene, law, integrator, "normal", precision))
            assert statistics.failed == 0 and statistics.steps == 24 * 20


def test_failures_are_rare_and_iterations_limited() -> None:
    stress, total = StressTest(envs=24, steps=20, threads=1, seed=5), StepStatistics()
    for draw in stress_batches(3):
        total.add(stress.run(draw))
    assert total.steps > 28_000 and total.failed <= 0.01 * total.steps
    assert total.most_iterations <= _core.ModelSpec().max_step_iterations


def test_error_estimate_of_steps_with_substeps() -> None:
    """Substeps are compared with shorter ones, which are split again if needed."""
    sim, u = StressTest(envs=24, steps=20, threads=1, seed=3).start(StressBatch("insertion", "elastic", "bdf1", "all"))
    halved = 0
    for control in u:
        before = sim.halved.copy()
        estimate = sim.error_estimate(control)
        sim.step(control)
        sim.check()
        assert np.isfinite(estimate).all()
        assert estimate[sim.halved > before].any(axis=1).all()
        halved += int((sim.halved > before).sum())
    assert halved > 5


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_resting_box_does_not_move(law: str) -> None:
    """A million steps, 83 minutes."""
    sim = Simulator(load_scene("pushing", friction=law), threads=1)
    sim.q[0] = sim.scene.q0
    u = np.zeros(sim.model.nu)
    sim.step(u, 2_000)
    before = sim.q[0].copy()
    sim.step(u, 1_000_000)
    sim.check()
    np.testing.assert_allclose(sim.q[0], before, atol=1e-9)


@pytest.mark.parametrize("step", [1e-6, 5e-2])
def test_very_short_and_long_steps(step: float) -> None:
    sim = Simulator(load_scene("insertion", friction="elastic", overrides={"step": step}))
    sim.q[0] = sim.scene.q0
    u = np.zeros(sim.model.nu)
    u[[sim.scene.u("finger_left"), sim.scene.u("finger_right")]] = 5.0
    u[[sim.scene.u("hold_left"), sim.scene.u("hold_right")]] = -0.0175
    u[sim.scene.u("arm_z")] = 0.0585
    sim.step(u, 50)
    sim.check()
    assert np.isfinite(sim.q).all()
    part = sim.scene.q("part").start
    np.testing.assert_allclose(sim.q[0, part : part + 2], 0, atol=1e-6)


def free_body(spec: _core.ModelSpec, name: str, mass: float, height: float, half: float = 0.01) -> int:
    body: int = spec.add_body(
        _core.BodyDef(name=name, pos=[0, 0, height], mass=mass, inertia=[mass * half**2] * 3 + [0] * 3)
    )
    spec.add_joint(_core.JointDef(name=name, body=body, type="free"))
    return body


def test_heavy_block_on_a_light_one() -> None:
    """100 kg on 1 mg, a ratio of 1e8, with a deflection of 0.1 mm."""
    spec, half = _core.ModelSpec(), 0.01
    bodies = [free_body(spec, "light", 1e-6, half), free_body(spec, "heavy", 100.0, 3 * half)]
    ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane"))
    top = spec.add_shape(_core.ShapeDef(name="top", body=bodies[0], kind="plane", pos=[0, 0, half]))
    corners = np.array([[x, y, -half] for x in (-half, half) for y in (-half, half)])
    for name, body, below in (("light", 0, ground), ("heavy", 1, top)):
        points = spec.add_points(_core.PointsDef(name=f"{name} corners", body=bodies[body], points=corners))
        spec.add_contact(
            _core.ContactDef(
                name=f"{name} contact",
                points=points,
                shape=below,
                law="elastic",
                kn=2.5e6,
                kt=1e3,
                mu=0.5,
                kd=1e5,
                ks=1e6,
            )
        )
    sim = Simulator(_core.Model(spec))
    sim.step(np.zeros(0), 2_000)
    sim.check()
    sag = 100.000001 * 9.8 / 1e7
    np.testing.assert_allclose(sim.q[0, [2, 9]], [half - sag, 3 * half - 2 * sag], atol=1e-6)


@pytest.mark.parametrize("precision", BOTH)
def test_spin_through_many_revolutions(precision: Precision) -> None:
    """1000 rad/s about the axis of symmetry, 5 rad per step, 80 000 rad in total."""
    spec = _core.ModelSpec()
    spec.gravity = (0.0, 0.0, 0.0)
    free_body(spec, "top", 0.1, 0.0)
    sim = Simulator(_core.Model(spec), precision=precision)
    sim.v[0, 5] = 1000.0
    sim.step(np.zeros(0), 16_000)
    sim.check()
    assert np.linalg.norm(sim.q[0, 3:]) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(sim.v[0], [0, 0, 0, 0, 0, 1000], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("precision", BOTH)
@pytest.mark.parametrize("size", [1e-310, 1e-40, 1e12, 1e30, 1e150, 1e300])
def test_denormal_and_huge_values(size: float, precision: Precision) -> None:
    """As velocity, control, stiffness and position: a finite result or a failure status, never NaN."""
    if precision == "single" and size > 1e38:
        pytest.skip("not representable in single precision")
    scene = load_scene("pushing", friction="elastic")
    sim = Simulator(scene, num_envs=4, precision=precision)
    sim.v[0, 3:] = size
    sim.param("box_ground.kn")[1] = size
    sim.q[2, scene.q("box_x")] = size
    u = np.zeros((4, scene.nu))
    u[3] = size
    run = sim.rollout(np.repeat(u[None], 20, axis=0), read_after=[20])
    for values in (run.q, run.v, run.anchors, run.tactile):
        assert np.isfinite(values).all()
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0, tactile=1.0)
    for values in (gradient.u, gradient.q, gradient.v):
        assert np.isfinite(values).all()
