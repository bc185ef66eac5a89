"""Gravity compensation (`gravcomp`): MuJoCo's forces, gradients, free bodies as without gravity, energy."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import INTEGRATORS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation import gradient_check
from gelflow.sim.validation.contact_states import POLISH
from gelflow.sim.validation.energy import EnergyGauge

Array = NDArray[np.float64]

# The camera and the counterweight are fixed to links and merged into them.
ARM = """<mujoco model="arm">
  <option gravity="0.5 -0.3 -9.8"/>
  <worldbody>
    <body name="shoulder" gravcomp="1">
      <joint name="pan" type="hinge" axis="0 0.6 0.8"/>
      <inertial pos="0.1 0.02 0.2" mass="2" diaginertia="0.02 0.03 0.01"/>
      <body name="socket" pos="0.3 0 0.1" gravcomp="0.7">
        <joint name="socket" type="ball" pos="0.01 0 0.02"/>
        <inertial pos="0.05 0 0.1" mass="1.5" diaginertia="0.01 0.02 0.02"/>
        <body name="camera" pos="0 0.1 0.05">
          <inertial pos="0 0.03 0" mass="0.4" diaginertia="1e-3 1e-3 1e-3"/>
        </body>
        <body name="slider" pos="0 0 0.2" gravcomp="-0.5">
          <joint name="slide" type="slide" axis="0.8 0 0.6"/>
          <inertial pos="0.02 0.01 0" mass="0.5" diaginertia="2e-3 2e-3 3e-3"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def load(folder: Path, xml: str = ARM) -> Scene:
    (folder / "arm.xml").write_text(xml)
    return load_scene(folder / "arm.xml")


def tumbler(integrator: str, *, gravcomp: float, gravity: float, offset: tuple[float, float, float]) -> Simulator:
    """A free body that rotates about a point away from its origin."""
    spec = _core.ModelSpec()
    spec.integrator, spec.polish, spec.tolerance = integrator, POLISH, 1e-12
    spec.gravity = (0.1 * gravity, 0.0, -gravity)
    body = spec.add_body(
        _core.BodyDef(
            name="body",
            mass=0.3,
            com=(0.02, -0.01, 0.03),
            inertia=(3e-4, 4e-4, 5e-4, 1e-5, 0, 2e-5),
            gravcomp=gravcomp,
            gravcomp_pos=offset,
        )
    )
    spec.add_joint(_core.JointDef(name="body", body=body, type="free"))
    wheel = spec.add_body(_core.BodyDef(name="wheel", mass=0.1, inertia=(1e-4,) * 3 + (0, 0, 0)))
    joint = spec.add_joint(_core.JointDef(name="wheel", body=wheel, type="hinge", damping=1e-3))
    spec.add_actuator(_core.ActuatorDef(name="wheel", joint=joint, kind="motor"))
    sim = Simulator(_core.Model(spec))
    sim.v[0] = [0.1, 0.2, 0.3, 4.0, -3.0, 2.0, 0.0]
    return sim


def test_forces_are_those_of_mujoco(tmp_path: Path) -> None:
    scene = load(tmp_path)
    assert scene.bodies[0].gravcomp == 1 and not scene.bodies[0].gravcomp_pos.any()
    assert scene.bodies[1].gravcomp == pytest.approx(0.7 * 1.5 / 1.9) and scene.bodies[1].gravcomp_pos.any()
    model = mujoco.MjModel.from_xml_path(str(scene.path))
    data, sim, rng = mujoco.MjData(model), Simulator(scene), np.random.default_rng(0)
    assert np.abs(sim.bias()).max() > 1  # gravity alone, as in MuJoCo
    for _ in range(10):
        sim.clear_history()  # each step is one of BDF1: M (v₁ − v₀)/h = f
        sim.v[0] = before = rng.normal(size=scene.nv)
        sim.step(np.zeros(0))
        sim.check()
        data.qpos[:], data.qvel[:] = sim.q[0], sim.v[0]
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        force = data.qfrc_passive - data.qfrc_bias
        inertia = full @ (sim.v[0] - before) / scene.step
        np.testing.assert_allclose(inertia, force, atol=1e-6 * np.abs(data.qfrc_bias).max())
        assert np.abs(data.qfrc_passive).max() > 1


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_free_body_moves_as_without_gravity(integrator: str) -> None:
    compensated = tumbler(integrator, gravcomp=1.0, gravity=9.8, offset=(0, 0, 0))
    weightless = tumbler(integrator, gravcomp=0.0, gravity=0.0, offset=(0, 0, 0))
    for sim in (compensated, weightless):
        sim.step([0.0], 100)
        sim.check()
    np.testing.assert_allclose(compensated.q, weightless.q, atol=1e-9)
    np.testing.assert_allclose(compensated.v, weightless.v, atol=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_gradients_of_a_free_body(integrator: str) -> None:
    rng = np.random.default_rng(1)
    sim = tumbler(integrator, gravcomp=0.8, gravity=9.8, offset=(0.03, 0.02, -0.01))
    check_gradients(sim, rng.normal(size=(8, 1)) * 0.1, rng)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_gradients_of_an_arm(integrator: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    motor = '<actuator><motor joint="pan"/></actuator></mujoco>'
    spec = load(tmp_path, ARM.replace("</mujoco>", motor)).model_spec()
    spec.integrator, spec.polish = integrator, POLISH
    sim = Simulator(_core.Model(spec))
    sim.v[0] = rng.normal(size=sim.model.nv)
    check_gradients(sim, rng.normal(size=(8, 1)), rng)


def check_gradients(sim: Simulator, u: Array, rng: np.random.Generator) -> None:
    names = [name for name in sim.model.param_names if ".gravcomp" in name]
    assert len(names) >= 4
    for output in ("q", "v"):
        case = gradient_check.RolloutLoss.random(sim, u, output, rng)
        assert gradient_check.compare_to_dual_numbers(case, rng, directions=2).error < 1e-10
        assert gradient_check.compare_to_differences(case).error < 1e-6


def test_energy_of_a_swinging_arm(tmp_path: Path) -> None:
    """The potential energy includes the force: the total energy changes by the error of the integrator alone."""
    spec = load(tmp_path).model_spec()
    spec.step = 2e-4
    sim, gauge = Simulator(_core.Model(spec)), EnergyGauge(load(tmp_path))
    sim.v[0] = [1.0, 0.5, -0.5, 0.3, 0.2]
    before = gauge.read(sim)
    sim.step(np.zeros(0), 500)
    after = gauge.read(sim)
    assert abs(after.gravity - before.gravity) > 0.1
    np.testing.assert_allclose(
        after.total, before.total, rtol=0, atol=2e-3 * float(abs(after.gravity - before.gravity)[0])
    )


def test_what_is_refused(tmp_path: Path) -> None:
    cancelled = ARM.replace('name="camera" pos="0 0.1 0.05"', 'name="camera" pos="0 0.1 0.05" gravcomp="-2.625"')
    with pytest.raises(UsageError, match=r"arm\.xml: body 'socket': gravcomp of the bodies fixed to it adds up to 0"):
        load(tmp_path, cancelled)
    limited = ARM.replace('name="pan"', 'name="pan" actuatorgravcomp="true" actuatorfrcrange="-1 1"')
    with pytest.raises(UsageError, match="actuatorgravcomp of joint 'pan' with an actuatorfrcrange is not supported"):
        load(tmp_path, limited)


def test_disabled_springs_and_dampers_disable_the_compensation_too(tmp_path: Path) -> None:
    """MuJoCo computes no passive forces then."""
    for flags, compensated in (('spring="disable"', True), ('spring="disable" damper="disable"', False)):
        text = ARM.replace('<option gravity="0.5 -0.3 -9.8"/>', f"<option><flag {flags}/></option>")
        (tmp_path / "arm.xml").write_text(text)
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        sim = Simulator(load_scene(tmp_path / "arm.xml", overrides={"step": 1e-5}))
        sim.step(np.zeros(sim.model.nu))
        np.testing.assert_allclose(sim.v[0] / 1e-5, data.qacc, rtol=2e-3, atol=1e-3)
        assert bool(np.abs(data.qfrc_gravcomp).max() > 0) == compensated
