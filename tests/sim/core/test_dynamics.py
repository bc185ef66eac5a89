"""The core without contact: random trees compared with MuJoCo, motions compared with closed forms.

Tolerances follow from the origin of each quantity: rounding for algebraic ones, Newton's tolerance for quantities that
the solved equation conserves, and an error that halves with the step for those that the integrator (BDF1) approximates.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.sim import _core
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)
GRAVITY = 9.8


@dataclass
class Link:
    """One body of a random tree."""

    parent: int  # -1: the world
    pos: Array
    quat: Array
    mass: float
    com: Array
    inertia: Array  # xx yy zz xy xz yz about the centre of mass
    joints: list[tuple[str, Array, Array, float]] = field(default_factory=list)  # type, position, axis, armature


def random_tree(rng: np.random.Generator, bodies: int, *, free: bool) -> list[Link]:
    """A tree of bodies with one to three joints each; with `free` a single root on a free joint."""
    links: list[Link] = []
    for i in range(bodies):
        parent = -1 if i == 0 else int(rng.integers(0 if free else -1, i))
        atoms = rng.normal(size=(4, 3)) * 0.1  # four point masses give a valid inertia
        shares = rng.uniform(0.1, 1.0, 4)
        com = shares @ atoms / shares.sum()
        arms = atoms - com
        tensor = np.einsum(
            "i,ijk->jk", shares, (arms**2).sum(1)[:, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None]
        )
        quat = rng.normal(size=4)
        link = Link(
            parent,
            rng.normal(size=3) * 0.3,
            quat / np.linalg.norm(quat),
            float(shares.sum()),
            com,
            tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        )
        kinds = ["free"] if free and parent == -1 else list(rng.choice(["slide", "hinge"], size=rng.integers(1, 4)))
        for kind in kinds:
            axis = rng.normal(size=3)
            armature = 0.0 if kind == "free" else float(rng.uniform(0, 0.2))
            link.joints.append((kind, rng.normal(size=3) * 0.1, axis / np.linalg.norm(axis), armature))
        links.append(link)
    return links


def our_model(links: list[Link], gravity: Array, step: float = 5e-3, tolerance: float = 1e-12) -> _core.Model:
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.tolerance = gravity, step, tolerance
    for i, link in enumerate(links):
        spec.add_body(
            _core.BodyDef(
                name=f"body{i}",
                parent=link.parent,
                pos=link.pos,
                quat=link.quat,
                mass=link.mass,
                com=link.com,
                inertia=link.inertia,
            )
        )
        for j, (kind, pos, axis, armature) in enumerate(link.joints):
            spec.add_joint(
                _core.JointDef(name=f"joint{i}_{j}", body=i, type=kind, pos=pos, axis=axis, armature=armature)
            )
    return _core.Model(spec)


def their_model(links: list[Link], gravity: Array) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.gravity = gravity
    nodes = [spec.worldbody]
    for i, link in enumerate(links):
        body = nodes[link.parent + 1].add_body(name=f"body{i}", pos=link.pos, quat=link.quat)
        body.explicitinertial = True
        body.mass, body.ipos, body.fullinertia = link.mass, link.com, link.inertia
        for j, (kind, pos, axis, armature) in enumerate(link.joints):
            type_ = getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}")
            body.add_joint(name=f"joint{i}_{j}", type=type_, pos=pos, axis=axis, armature=armature)
        nodes.append(body)
    return spec.compile()


def joint_indices(model: _core.Model, reference: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Indices of positions and velocities in MuJoCo, which orders bodies depth first."""
    positions: list[int] = []
    velocities: list[int] = []
    for name in model.joint_names:
        joint = reference.joint(name)
        wide = joint.type[0] == mujoco.mjtJoint.mjJNT_FREE
        positions += range(joint.qposadr[0], joint.qposadr[0] + (7 if wide else 1))
        velocities += range(joint.dofadr[0], joint.dofadr[0] + (6 if wide else 1))
    return positions, velocities


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_mass_matrix_and_bias_agree_with_mujoco(seed: int, free: bool) -> None:
    rng = np.random.default_rng(seed)
    links = random_tree(rng, 6, free=free)
    gravity = rng.normal(size=3) * 10
    model, reference = our_model(links, gravity), their_model(links, gravity)
    at_q, at_v = joint_indices(model, reference)
    sim, data = Simulator(model, num_envs=3), mujoco.MjData(reference)
    for env in range(sim.num_envs):
        data.qpos[:] = rng.normal(size=reference.nq)
        data.qvel[:] = rng.normal(size=reference.nv) * 3
        mujoco.mj_normalizeQuat(reference, data.qpos)
        mujoco.mj_forward(reference, data)
        sim.q[env], sim.v[env] = data.qpos[at_q], data.qvel[at_v]
        mass = np.zeros((reference.nv, reference.nv))
        mujoco.mj_fullM(reference, data, mass)
        np.testing.assert_allclose(sim.mass_matrix()[env], mass[np.ix_(at_v, at_v)], atol=1e-11)
        np.testing.assert_allclose(sim.bias()[env], data.qfrc_bias[at_v], rtol=1e-11, atol=1e-10)


def mechanical_state(reference: mujoco.MjModel, q: Array, v: Array) -> tuple[Array, Array, float]:
    """Linear and angular momentum (about the centre of mass) and energy, from MuJoCo."""
    data = mujoco.MjData(reference)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(reference, data)
    mujoco.mj_subtreeVel(reference, data)
    mujoco.mj_energyPos(reference, data)
    mujoco.mj_energyVel(reference, data)
    return (
        reference.body_subtreemass[0] * data.subtree_linvel[0],
        data.subtree_angmom[0].copy(),
        float(data.energy.sum()),
    )


def drift(
    links: list[Link], gravity: Array, start_v: Array, step: float, duration: float
) -> tuple[float, float, float]:
    """Relative drift of momenta and energy after `duration`."""
    reference = their_model(links, gravity)
    sim = Simulator(our_model(links, gravity, step))
    at_q, at_v = joint_indices(sim.model, reference)
    back_q, back_v = np.argsort(at_q), np.argsort(at_v)
    sim.v[0] = start_v
    linear, angular, energy = mechanical_state(reference, sim.q[0][back_q], sim.v[0][back_v])
    sim.step(np.zeros(0), round(duration / step))
    sim.check()
    linear_1, angular_1, energy_1 = mechanical_state(reference, sim.q[0][back_q], sim.v[0][back_v])
    fallen = reference.body_subtreemass[0] * gravity * duration
    return (
        float(np.linalg.norm(linear_1 - linear - fallen)),
        float(np.linalg.norm(angular_1 - angular)),
        abs(energy_1 - energy),
    )


@pytest.mark.parametrize("seed", [1, 4])
def test_momenta_and_energy_of_a_free_tree_drift_at_first_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    links = random_tree(rng, 3, free=True)
    for link in links:  # MuJoCo includes armature in the energy, not in the momentum
        link.joints = [(kind, pos, axis, 0.0) for kind, pos, axis, _ in link.joints]
    gravity = np.array([0.0, 0.0, -GRAVITY])
    start = rng.normal(size=our_model(links, gravity).nv)
    coarse, fine = (np.array(drift(links, gravity, start, h, 0.1)) for h in (2e-4, 1e-4))
    np.testing.assert_allclose(coarse / fine, 2, atol=0.1)


def free_bodies(
    inertia: Array, *, step: float, gravity: float = 0.0, tolerance: float = 1e-9, count: int = 1
) -> Simulator:
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.tolerance = (0.0, 0.0, -gravity), step, tolerance
    for i in range(count):
        spec.add_body(_core.BodyDef(name=f"body{i}", pos=(0.5 * i, 0.0, 1.0), mass=2.0, inertia=inertia))
        spec.add_joint(_core.JointDef(name=f"joint{i}", body=i, type="free"))
    return Simulator(_core.Model(spec))


def test_linear_momentum_is_conserved_to_the_newton_tolerance() -> None:
    """The velocity of a body that tumbles about its centre of mass is constant."""
    steps, tolerance = 500, 1e-9
    sim = free_bodies(np.array([0.01, 0.02, 0.025, 0.001, 0.002, -0.001]), step=5e-3, tolerance=tolerance)
    sim.v[0] = 1.0, -2.0, 3.0, 20.0, 5.0, -7.0
    start = sim.v[0, :3].copy()
    sim.step(np.zeros(0), steps)
    assert np.abs(sim.v[0, :3] - start).max() <= steps * tolerance * 5e-3 * 9.81
    assert np.abs(sim.v[0, 3:] - [20.0, 5.0, -7.0]).max() > 1


def turned(quat: Array, vector: Array) -> Array:
    """quat ⊗ exp(vector), w x y z."""
    result, step = np.zeros(4), np.zeros(4)
    angle = np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(step, vector / angle, angle)
    mujoco.mju_mulQuat(result, quat, step)
    return result


def free_precession(inertia: Array, spin: Array, duration: float) -> Array:
    """Orientation of a symmetric top, upright at the start: precession about the constant angular momentum L at
    |L| / I₁, and rotation about its axis z at (1 − I₃/I₁) ω₃."""
    across, along = inertia[0], inertia[2]
    momentum = inertia * spin
    own = np.array([0.0, 0.0, (1 - along / across) * spin[2] * duration])
    return turned(turned(np.array(UPRIGHT), momentum / across * duration), own)


def test_symmetric_top_converges_to_the_closed_form_at_first_order() -> None:
    inertia, spin, duration = np.array([0.02, 0.02, 0.01]), np.array([1.0, 0.5, 8.0]), 0.5
    expected = free_precession(inertia, spin, duration)
    errors, drifts = [], []
    for step in (2e-3, 1e-3, 5e-4):
        sim = free_bodies(np.array([*inertia, 0, 0, 0]), step=step, gravity=GRAVITY, tolerance=1e-13)
        sim.v[0] = 1.0, 2.0, 3.0, *spin
        sim.step(np.zeros(0), round(duration / step))
        flown = np.array([1.0, 2.0, 3.0 - GRAVITY * duration / 2]) * duration
        # BDF1 uses the velocity at the end of each step: the fall is exactly g t (t + h) / 2.
        flown[2] -= GRAVITY * duration * step / 2
        np.testing.assert_allclose(sim.q[0, :3] - [0, 0, 1], flown, atol=1e-12)
        np.testing.assert_allclose(sim.v[0, :3], [1, 2, 3 - GRAVITY * duration], atol=1e-12)
        errors.append(2 * np.arccos(min(1.0, abs(expected @ sim.q[0, 3:]))))
        drifts.append(np.linalg.norm(sim.v[0, 3:] * inertia) - np.linalg.norm(inertia * spin))
        assert np.linalg.norm(sim.q[0, 3:]) == pytest.approx(1, abs=1e-14)
    assert errors[-1] < 0.01
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2, atol=0.1)
    np.testing.assert_allclose(np.divide(drifts[:-1], drifts[1:]), 2, atol=0.1)


def one_joint(
    kind: str, *, step: float = 1e-3, com: float = 0.0, actuator: Mapping[str, Any] | None = None, **joint: Any
) -> Simulator:
    """A body of 2 kg on a vertical slide or a horizontal hinge."""
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.tolerance = (0.0, 0.0, -GRAVITY), step, 1e-13
    spec.add_body(_core.BodyDef(name="body", mass=2.0, com=(0, 0, -com), inertia=(0.03, 0.03, 0.03, 0, 0, 0)))
    spec.add_joint(
        _core.JointDef(name="joint", body=0, type=kind, axis=(0, 0, 1) if kind == "slide" else (1, 0, 0), **joint)
    )
    if actuator is not None:
        spec.add_actuator(_core.ActuatorDef(name="servo", joint=0, kind="position", **actuator))
    return Simulator(_core.Model(spec))


def test_pendulum_has_the_small_angle_period() -> None:
    """BDF1 of θ'' = −ω² θ gives z_n = z_0 (1 + i ω h)^−n for z = ω θ + i θ', with period 2π h / atan(ω h)."""
    step, com = 1e-3, 0.25
    omega = np.sqrt(2.0 * GRAVITY * com / (0.03 + 2.0 * com**2))
    sim = one_joint("hinge", step=step, com=com)
    sim.q[0] = amplitude = 1e-4
    steps = round(2 * np.pi / np.arctan(omega * step))
    sim.step(np.zeros(0), steps)
    expected = omega * amplitude * (1 + 1j * omega * step) ** -steps
    # The small-angle error is of third order.
    assert abs(omega * sim.q[0, 0] + 1j * sim.v[0, 0] - expected) < 20 * amplitude**3
    assert 2 * np.pi / omega == pytest.approx(steps * step, rel=2e-3)


def test_joint_damping_and_spring() -> None:
    """Damping multiplies the velocity by 1 / (1 + h c / m) per step; a spring at rest carries m g."""
    sim = one_joint("slide", damping=3.0, stiffness=0.0)
    sim.param("gravity.z")[:] = 0
    sim.v[0] = 5.0
    sim.step(np.zeros(0), 400)
    assert sim.v[0, 0] == pytest.approx(5.0 * (1 + 1e-3 * 3.0 / 2.0) ** -400, rel=1e-10)
    assert sim.v[0, 0] == pytest.approx(5.0 * np.exp(-3.0 / 2.0 * 0.4), rel=1e-3)
    sprung = one_joint("slide", damping=30.0, stiffness=200.0, springref=0.1)
    sprung.step(np.zeros(0), 5000)
    assert sprung.q[0, 0] == pytest.approx(0.1 - 2.0 * GRAVITY / 200.0, abs=1e-10)


def test_position_servo_deflects_under_load_and_clips_its_control() -> None:
    servo = {"kp": 200.0, "kd": 20.0, "force_lower": -50.0, "force_upper": 50.0}
    sim = one_joint("slide", actuator=servo)
    sim.step([0.3], 8000)
    assert sim.q[0, 0] == pytest.approx(0.3 - 2.0 * GRAVITY / 200.0, abs=1e-10)
    sim.param("servo.force_upper")[:] = 10.0  # less than the weight: it accelerates with the remainder
    sim.reset()
    sim.step([0.3], 100)
    assert sim.v[0, 0] == pytest.approx((10.0 / 2.0 - GRAVITY) * 0.1, rel=1e-12)
    sim.param("servo.force_lower")[:] = -4.0
    sim.reset()
    sim.step([-9.0], 100)
    assert sim.v[0, 0] == pytest.approx((-4.0 / 2.0 - GRAVITY) * 0.1, rel=1e-12)


def test_a_light_joint_that_arrives_fast_is_stopped_by_its_limit() -> None:
    """A damping that begins at once left no solution for the step in which the joint arrives, however short."""
    inertia, stiffness = 0.03, 3e7  # a period of 0.2 ms, as of a fingertip of 20 g on a limit for a motor of 10 N m
    limit = {"upper": 0.5, "limit_stiffness": stiffness, "limit_damping": 2 * (stiffness * inertia) ** 0.5}
    for share in np.linspace(0, 1, 21):  # of a step until the joint arrives
        for speed in (1.0, 20.0, 300.0):
            sim = one_joint("hinge", **limit)
            sim.q[0], sim.v[0] = 0.5 - share * speed * 1e-3, speed
            sim.step(np.zeros(0), 20)
            sim.check()
            assert sim.q[0, 0] < 0.5 + 2e-2 and sim.v[0, 0] < 1e-3


def test_gear_scales_force_and_length() -> None:
    servo = {"kp": 200.0, "kd": 20.0, "gear": 3.0}
    sim = one_joint("slide", actuator=servo)
    sim.step([0.3], 8000)
    assert sim.q[0, 0] == pytest.approx((0.3 - 2.0 * GRAVITY / (3.0 * 200.0)) / 3.0, abs=1e-10)


@pytest.mark.parametrize("up", [False, True])
def test_joint_limit_carries_the_load_and_never_pulls(up: bool) -> None:
    sign = 1 if up else -1
    sim = one_joint("slide", lower=-0.05, upper=0.05, limit_stiffness=4e3, limit_damping=100.0)
    sim.param("gravity.z")[:] = sign * GRAVITY
    sim.q[0] = sign * 0.04
    sim.step(np.zeros(0), 3000)
    assert sim.q[0, 0] == pytest.approx(sign * (0.05 + 2.0 * GRAVITY / 4e3), abs=1e-10)
    # At high separation speed the damper would pull; the limit releases instead.
    sim.param("gravity.z")[:] = 0
    sim.q[0], sim.v[0] = sign * 0.055, -sign * 1.0
    sim.step(np.zeros(0), 1)
    assert sim.v[0, 0] == pytest.approx(-sign * 1.0, abs=1e-12)
    # No force between the limits.
    sim.q[0], sim.v[0] = 0.0, sign * 0.3
    sim.step(np.zeros(0), 10)
    assert sim.v[0, 0] == pytest.approx(sign * 0.3, abs=1e-12)
