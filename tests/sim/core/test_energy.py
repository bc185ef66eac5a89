"""Energy: BDF1 never adds energy to free bodies on planes; in scenes the gain of a step is bounded.

Free bodies are thrown on planes at random; hypothesis draws stiffness, damping, friction, step and centre of mass. The
tolerance is ten times Newton's, relative to the energy involved.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, load_scene, scene_names
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.energy import EnergyGauge, actuator_forces, joint_energies
from gelflow.sim.validation.reference_motions import reference_motion
from gelflow.sim.validation.thrown_bodies import GRAVITY, KINDS, MASS, SIZE, Kind, ThrownBody, throw_bodies

TOLERANCE = 1e-8


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log(low), np.log(high)).map(lambda x: float(np.exp(x)))


def throws(kind: Kind, law: str) -> st.SearchStrategy[ThrownBody]:
    """All materials, with and without damping, steps of 0.1 to 20 ms, with and without rotation."""
    damped = st.one_of(st.just(0.0), logarithmic(0.03, 30))
    numbers = st.fixed_dictionaries(
        {
            "kn": logarithmic(1e2, 1e5),
            "kt": st.one_of(st.just(0.0), logarithmic(0.1, 50)),
            "mu": st.sampled_from([0.0, 0.3, 0.8, 2.0]),
            "ks": logarithmic(1e2, 1e4) if law == "elastic" else st.just(0.0),
        }
    )
    centers = st.one_of(st.just((0.0, 0.0, 0.0)), st.tuples(*[st.floats(-0.5 * SIZE, 0.5 * SIZE)] * 3))

    def build(
        damping: str, kd: float, step: float, numbers: dict[str, float], turns: bool, center: tuple[float, float, float]
    ) -> ThrownBody:
        scaled = kd * (1e3 if damping == "hunt-crossley" else 1)
        return ThrownBody(kind, law, damping, step, {**numbers, "kd": scaled}, has_rotation=turns, center=center)

    turning = st.sampled_from([True, True, True, False])
    return st.builds(
        build, st.sampled_from(["hunt-crossley", "linear"]), damped, logarithmic(1e-4, 2e-2), numbers, turning, centers
    )


SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(
    ("kind", "law"), [(kind, law) for kind in KINDS for law in FRICTION_LAWS if (kind, law) != ("sphere", "elastic")]
)
def test_free_bodies_on_planes_never_gain_energy(kind: Kind, law: str) -> None:
    """In no step, with or without substeps. The contact point of a sphere has no anchor, so its friction is viscous."""

    @settings(max_examples=40)
    @given(throw=throws(kind, law), seed=SEEDS)
    def check(throw: ThrownBody, seed: int) -> None:
        growth = throw_bodies(throw, np.random.default_rng(seed), bodies=8, steps=40)
        assert (growth.change <= TOLERANCE * growth.scale).all()

    check()


def test_fast_spinning_bodies_with_long_steps_never_gain_energy() -> None:
    """Points move along long arcs within a step, without friction springs; the body frame is off the centre of mass."""
    numbers = {"kn": 2e3, "kt": 0.0, "mu": 0.0, "kd": 0.0, "ks": 0.0}
    for kind in ("box", "cylinder"):
        throw = ThrownBody(kind, "viscous", "hunt-crossley", 2e-2, numbers, center=(4e-3, -3e-3, 5e-3))
        growth = throw_bodies(throw, np.random.default_rng(1), bodies=24, steps=150)
        assert (growth.change <= TOLERANCE * growth.scale).all()


@pytest.mark.parametrize(("integrator", "step", "within"), [("bdf1", 1e-3, 1e-6), ("bdf2", 1e-5, 2e-3)])
def test_friction_energy_of_a_slipping_block(integrator: str, step: float, within: float) -> None:
    """The springs of a sliding block have strain µ N / k_s at any speed, and the deceleration is µ g.

    BDF2 computes the slip of a step to first order."""
    numbers = {"kn": 2e3, "kt": 5.0, "mu": 0.3, "kd": 0.0, "ks": 1e3}
    throw = ThrownBody("box", "elastic", "hunt-crossley", step, numbers, integrator=integrator, has_rotation=False)
    sim, gauge = Simulator(_core.Model(throw.model_spec())), EnergyGauge(throw)
    points = 9  # of the lower face
    sim.q[0, 2] = 0.6 * SIZE - MASS * GRAVITY / (points * numbers["kn"])
    sim.q[0, 0], sim.v[0, 0] = -10, 1.0  # far from the slope
    sim.step(np.zeros(0), round(0.1 / step))
    assert sim.v[0, 0] == pytest.approx(1 - 0.3 * GRAVITY * 0.1, rel=1e-6)
    strain = 0.3 * MASS * GRAVITY / points / numbers["ks"]
    assert gauge.read(sim).friction[0] == pytest.approx(points * 0.5 * numbers["ks"] * strain**2, rel=within)


def test_energy_terms_equal_their_formulas() -> None:
    """A resting block, and the springs of a scene."""
    numbers = {"kn": 2e3, "kt": 0.0, "mu": 0.5, "kd": 0.0, "ks": 1e3}
    throw = ThrownBody("box", "elastic", "hunt-crossley", 1e-3, numbers)
    sim, gauge = (
        Simulator(_core.Model(throw.model_spec()), num_envs=2),
        EnergyGauge(throw, num_envs=2),
    )
    sim.q[:, 0], sim.q[:, 2] = -10, 0.6 * SIZE - np.array([1e-4, -1.0])
    sim.v[:, 0] = 1.0, 2.0
    energy = gauge.read(sim)
    np.testing.assert_allclose(energy.kinetic, 0.5 * MASS * sim.v[:, 0] ** 2)
    np.testing.assert_allclose(energy.gravity, MASS * GRAVITY * sim.q[:, 2])
    np.testing.assert_allclose(energy.contact, [9 * 0.5 * 2e3 * 1e-8, 0], atol=1e-15)
    sim.v[:] = 0
    sim.step(np.zeros(0))
    sim.q[0, 0] += 2e-5  # the same strain at all nine points
    np.testing.assert_allclose(gauge.read(sim).friction[0], 9 * 0.5 * 1e3 * 4e-10, rtol=1e-6)


def test_springs_of_joints_before_a_ball_joint_have_energy() -> None:
    """Three slides and a ball joint: the first slide has the velocity number that the ball's has less three."""
    spec = _core.ModelSpec()
    body = spec.add_body(_core.BodyDef(name="body", mass=0.1, inertia=[1e-4, 1e-4, 1e-4, 0, 0, 0]))
    for axis in range(3):
        spec.add_joint(
            _core.JointDef(name=f"slide{axis}", body=body, type="slide", axis=np.eye(3)[axis], stiffness=10.0)
        )
    spec.add_joint(_core.JointDef(name="ball", body=body, type="ball"))
    sim = Simulator(_core.Model(spec))
    sim.q[0, :3] = 0.1
    springs, _ = joint_energies(sim)
    assert springs[0] == pytest.approx(3 * 0.5 * 10 * 0.1**2)


# Largest gain of a step beyond the motors' work, relative to their total work. BDF2 has errors above its dissipation.
MOST = {
    ("viscous", "bdf1"): TOLERANCE,
    ("elastic", "bdf1"): TOLERANCE,
    ("viscous", "bdf2"): 2e-3,
    ("elastic", "bdf2"): 2e-2,
}


@pytest.mark.parametrize(("law", "integrator"), MOST)
@pytest.mark.parametrize("name", scene_names())
def test_energy_gain_of_scenes_is_bounded(name: str, law: str, integrator: str) -> None:
    grid = {"pads.pad.rows": 5, "pads.pad.cols": 5} if name == "rolling" else {}
    for step in (5e-3, 2e-2):
        scene = load_scene(name, friction=law, overrides={**grid, "step": step, "integrator": integrator})
        sim, gauge, moves = Simulator(scene), EnergyGauge(scene), reference_motion(scene)
        sim.q[0] = moves.q0
        driven = [sim.model.joint_q[a.joint] for a in scene.actuators]
        before, gains, work = gauge.read(sim).total[0], [], 0.0
        for u in moves.step_controls(step):
            start, halved = sim.q[0, driven].copy(), sim.halved[0]
            sim.step(u)
            done = actuator_forces(scene, sim, u)[0] @ (sim.q[0, driven] - start)
            after = gauge.read(sim).total[0]
            if sim.halved[0] == halved:  # with substeps, the force at the end does not give the motors' work
                gains.append(after - before - done)
            work += abs(done)
            before = after
        sim.check()
        assert max(gains) <= MOST[law, integrator] * work


def test_contact_points_that_were_moved_store_energy_at_their_position() -> None:
    sim = Simulator(load_scene("pushing"), num_envs=2)
    gauge = EnergyGauge(sim.scene, num_envs=2)
    sim.param("box.points.pos.z")[1] -= 1e-3
    energy, force = gauge.read(sim).contact, sim.wrenches()[:, sim.model.contact_names.index("box_ground"), 5]
    assert energy[0] == 0 and force[1] > 1
    np.testing.assert_allclose(energy[1], 0.5 * force[1] * 1e-3, rtol=1e-6)
    sim.param("box.points.scale.x")[:] = 1.1
    with pytest.raises(UsageError, match=r"box\.points\.scale\.x must be 1"):
        gauge.read(sim)


def test_springs_of_tendons_keep_the_energy(tmp_path: Path) -> None:
    (tmp_path / "tendon.xml").write_text("""<mujoco><option gravity="0 0 0" timestep="1e-4"/><worldbody><body>
      <joint name="t" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
      <tendon><fixed name="t" stiffness="100" springlength="0"><joint joint="t" coef="1"/></fixed></tendon></mujoco>""")
    sim = Simulator(load_scene(tmp_path / "tendon.xml"))
    gauge, sim.v[:] = EnergyGauge(sim.scene), 1.0
    sim.step(np.zeros(0), 1000)
    assert sim.v[0, 0] < 0.6
    np.testing.assert_allclose(gauge.read(sim).total, 0.5, rtol=1e-2)


def test_energy_of_springs_that_keep_bodies_together_is_refused(tmp_path: Path) -> None:
    (tmp_path / "closed.xml").write_text("""<mujoco><worldbody><body name="a"><joint/><geom size="0.1"/></body>
      <body name="b"><joint/><geom size="0.1"/></body></worldbody>
      <equality><connect name="pin" body1="a" body2="b" anchor="0 0 0"/></equality></mujoco>""")
    with pytest.raises(UsageError, match="the energy of the springs that keep 'pin' is not computed"):
        EnergyGauge(load_scene(tmp_path / "closed.xml"))
