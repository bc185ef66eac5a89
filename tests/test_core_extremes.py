"""At the extremes nothing but numbers comes out: stiffness, damping, friction, mass and speed over many decades.

What is drawn: per environment and parameter, k_n and k_s from 1e-2 to 1e9, k_t from 1e-3 to 1e6, k_d 0 or from 1e-3 to
1e6, µ 0, 1e6, or from 1e-2 to 10, masses from 1e-4 to 1e4 times the scene's (all but 0 and 1e6 uniformly in the
logarithm); start velocities up to 100 m/s and rad/s; controls of random size up to about 20.
"""

from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import STATUS, Simulator

ENVS, STEPS = 48, 30
OVERRIDES = {"rolling": {"pads.pad.rows": 20, "pads.pad.cols": 20}}


def drawn(scene: str, friction: str, integrator: str, precision: Literal["double", "single"]) -> Simulator:
    overrides = {**OVERRIDES.get(scene, {}), "integrator": integrator}
    sim = Simulator(
        load_scene(scene, friction=friction, overrides=overrides), num_envs=ENVS, precision=precision, threads=1
    )
    rng = np.random.default_rng(11)

    def log(low: float, high: float) -> NDArray[np.float64]:
        return np.exp(rng.uniform(np.log(low), np.log(high), ENVS))

    for i, name in enumerate(sim.model.param_names):
        values = sim.params[:, i]
        kind = name.rsplit(".", 1)[-1]
        if kind in ("kn", "ks") and values[0] > 0:
            values[:] = log(1e-2, 1e9)
        elif kind == "kt":
            values[:] = log(1e-3, 1e6)
        elif kind == "kd":
            values[:] = np.where(rng.random(ENVS) < 0.2, 0, log(1e-3, 1e6))
        elif kind == "mu":
            values[:] = rng.choice([0.0, 1e6, 1.0], ENVS, p=[0.1, 0.1, 0.8]) * log(1e-2, 10)
        elif kind == "mass":
            values *= log(1e-4, 1e4)
    sim.q[:] = sim.scene.q0
    sim.v[:] = rng.normal(size=sim.v.shape) * log(1e-3, 100)[:, None]
    return sim


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
@pytest.mark.parametrize("friction", ["viscous", "elastic"])
@pytest.mark.parametrize("scene", ["rolling", "pushing", "insertion"])
def test_only_numbers_come_out(
    scene: str, friction: str, integrator: str, precision: Literal["double", "single"]
) -> None:
    sim = drawn(scene, friction, integrator, precision)
    rng = np.random.default_rng(12)
    u = rng.normal(size=(STEPS, ENVS, sim.model.nu)) * np.exp(rng.uniform(-5, 2, (STEPS, ENVS, 1)))
    run = sim.rollout(u, read_after=[STEPS // 2, STEPS])
    for values in (run.q, run.v, run.anchors, run.tactile, run.history):
        assert np.isfinite(values).all()
    assert set(run.status.tolist()) <= set(STATUS)
    assert (run.status == 0).any()
    gradient = sim.rollout_gradient(run, q=1.0, v=1.0, tactile=1.0)
    for values in (gradient.u, gradient.q, gradient.v, gradient.anchors, gradient.history):
        assert np.isfinite(values).all()
    assert not gradient.v[run.status != 0].any()


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_what_lies_stays(friction: str) -> None:
    """A box at rest on the ground for 20 000 steps, 100 s: as it lay, so it lies."""
    sim = Simulator(load_scene("pushing", friction=friction), threads=1)
    sim.q[0] = sim.scene.q0
    u = np.zeros(sim.model.nu)
    sim.step(u, 2_000)
    before = sim.q[0].copy()
    sim.step(u, 20_000)
    sim.check()
    np.testing.assert_allclose(sim.q[0], before, atol=1e-9)


@pytest.mark.parametrize("step", [1e-6, 5e-2])
def test_short_and_long_steps(step: float) -> None:
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
