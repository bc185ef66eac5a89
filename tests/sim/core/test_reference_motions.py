"""Motions with a closed form: a block sliding to rest, a pendulum with large amplitude, a tumbling top, and creep in a
viscous grasp."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from gelflow.sim import _core
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.insertion import InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.sim.validation.thrown_bodies import GRAVITY, MASS, ThrownBody

Array = NDArray[np.float64]

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
@pytest.mark.parametrize("law", ["viscous", "elastic"])
def test_sliding_distance_of_a_block_is_v_squared_over_2_mu_g(law: str, integrator: str) -> None:
    """BDF1 sums the velocities at the ends of steps, which is less by v h / 2. The contributions of the friction laws
    are far below 1e-3: creep below µ m g / (n k_t) = 0.5 mm/s, or compliance of µ m g / (n k_s) = 0.01 mm."""
    mu, speed, step = 0.3, 0.8, 1e-3
    numbers = {"kn": 2e3, "kt": 200.0 if law == "viscous" else 5.0, "mu": mu, "kd": 1e4, "ks": 1e4 * (law == "elastic")}
    throw = ThrownBody("box", law, "hunt-crossley", step, numbers, integrator=integrator, has_rotation=False)
    sim = Simulator(_core.Model(throw.model_spec()))
    sim.q[0, 0], sim.q[0, 2] = (
        -10,
        0.012 - MASS * GRAVITY / (9 * numbers["kn"]),
    )  # nine points in contact, far from the slope
    sim.v[0, 0] = speed
    sim.step(np.zeros(0), 600)
    sim.check()
    exact = speed**2 / (2 * mu * GRAVITY)
    behind = speed * step / 2 if integrator == "bdf1" else 0.0
    assert sim.q[0, 0] + 10 == pytest.approx(exact - behind, rel=1e-3)
    assert abs(sim.v[0, 0]) < 1e-6


def pendulum(step: float, integrator: str) -> Simulator:
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.tolerance, spec.integrator = (0.0, 0.0, -GRAVITY), step, 1e-12, integrator
    spec.add_body(_core.BodyDef(name="body", mass=2.0, com=(0, 0, -0.25), inertia=(0.03, 0.03, 0.03, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="hinge", body=0, type="hinge", axis=(1, 0, 0)))
    return Simulator(_core.Model(spec))


@pytest.mark.parametrize("amplitude", [0.5, 2.0, 3.0])
@pytest.mark.parametrize(("integrator", "order"), [("bdf1", 1), ("bdf2", 2)])
def test_period_of_a_pendulum_at_large_amplitudes(integrator: str, order: int, amplitude: float) -> None:
    """A quarter period is K(sin² θ₀/2) / ω, with the complete elliptic integral K and ω² = m g l / (I + m l²)."""
    omega = np.sqrt(2.0 * GRAVITY * 0.25 / (0.03 + 2.0 * 0.25**2))
    exact = ellipk(np.sin(amplitude / 2) ** 2) / omega
    errors = []
    for step in (2e-3, 1e-3, 5e-4):
        sim = pendulum(step, integrator)
        sim.q[0] = amplitude
        run = sim.rollout(np.zeros((round(1.2 * exact / step), 1, 0)))
        angle = run.q[:, 0, 0]
        last = int(np.argmax(angle < 0)) - 1
        errors.append(abs(step * (last + angle[last] / (angle[last] - angle[last + 1])) - exact) / exact)
    assert errors[-1] < (3e-3 if order == 1 else 2e-5)
    np.testing.assert_allclose(-np.diff(np.log2(errors)), order, atol=0.3)


INERTIA = np.array([0.01, 0.02, 0.03])
SPIN = np.array([0.1, 6.0, -0.05])  # about the unstable intermediate axis
DURATION = 2.0  # [s]


def euler(_: float, spin: Array) -> Array:
    """Euler's equations of a torque-free body."""
    return np.asarray(-np.cross(spin, INERTIA * spin) / INERTIA)


@pytest.mark.parametrize(("integrator", "order"), [("bdf1", 1), ("bdf2", 2)])
def test_top_tumbling_about_its_intermediate_axis(integrator: str, order: int) -> None:
    """Agrees with Euler's equations; energy and angular momentum drift at the order of the integrator."""
    path = solve_ivp(euler, (0, DURATION), SPIN, rtol=1e-12, atol=1e-12, dense_output=True)
    assert path.sol(np.linspace(0, DURATION, 200))[1].min() < -5  # it has flipped
    exact = path.y[:, -1]
    energy, momentum = 0.5 * INERTIA @ SPIN**2, np.linalg.norm(INERTIA * SPIN)
    rows = []
    for step in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        spec = _core.ModelSpec()
        spec.gravity, spec.step, spec.tolerance, spec.integrator = ORIGIN, step, 1e-11, integrator
        spec.add_body(_core.BodyDef(name="body", mass=1.0, inertia=(*INERTIA, 0, 0, 0)))
        spec.add_joint(_core.JointDef(name="free", body=0, type="free"))
        sim = Simulator(_core.Model(spec))
        sim.v[0, 3:] = SPIN
        sim.step(np.zeros(0), round(DURATION / step))
        sim.check()
        spin = sim.v[0, 3:]
        after = 0.5 * INERTIA @ spin**2
        assert order == 2 or after <= energy  # BDF1 never gains energy
        rows.append([np.linalg.norm(spin - exact), abs(after - energy), abs(np.linalg.norm(INERTIA * spin) - momentum)])
    slopes = -np.diff(np.log2(rows), axis=0)
    print(f"{integrator}: spin, energy, momentum off by {rows[-1]}, slopes {slopes[-1].round(2)}")
    assert (slopes[-1] > order - 0.3).all()
    np.testing.assert_allclose(rows[-1][1] / energy, 0, atol=2e-3 if order == 1 else 1e-5)


def test_creep_rate_in_a_viscous_grasp_is_m_g_over_n_k_t() -> None:
    attempts = InsertionAttempts(1, scene=insertion_scene(friction="viscous"), randomization=NOMINAL)
    attempts.draw(np.random.default_rng(0))
    sim, scene, u = attempts.sim, attempts.scene, attempts._u
    height = scene.q("part").start + 2
    sim.step(u, 100)
    before, at = sim.q[0, height], sim.q[0, scene.q("arm_z").start]
    sim.step(u, 100)
    sim.check()
    touching = sum(p.weights.sum() / 2 for p in scene.points if p.name.startswith("pad_"))
    weight = float(sim.param("part.mass")[0]) * GRAVITY
    creep = weight / (touching * float(sim.param("pad_left.kt")[0])) * 100 * scene.step
    sunk = before - sim.q[0, height] - (at - sim.q[0, scene.q("arm_z").start])
    assert sunk == pytest.approx(creep, rel=1e-3)


def thrown(free: bool, integrator: str, step: float, center: tuple[float, float, float]) -> Simulator:
    """A tumbling body on a free joint, or on three slides and a ball joint."""
    spec = _core.ModelSpec()
    spec.step, spec.tolerance, spec.integrator = step, 1e-10, integrator
    body = spec.add_body(
        _core.BodyDef(name="body", mass=0.3, com=center, inertia=(2e-4, 3e-4, 4e-4, 2e-5, -1e-5, 3e-5))
    )
    joints = (
        [("free", (0, 0, 1))]
        if free
        else [("slide", (1, 0, 0)), ("slide", (0, 1, 0)), ("slide", (0, 0, 1)), ("ball", (0, 0, 1))]
    )
    for i, (kind, axis) in enumerate(joints):
        spec.add_joint(_core.JointDef(name=f"joint{i}", body=body, type=kind, axis=axis, damping=0.01))
    sim = Simulator(_core.Model(spec))
    sim.q[0] = [0.1, -0.2, 0.3, *(np.array([1, 2, -1, 0.5]) / 2.5)]
    sim.v[0] = [0.5, -1.0, 2.0, 7.0, -3.0, 11.0]
    return sim


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
def test_free_joint_equals_three_slides_and_a_ball_joint(integrator: str) -> None:
    """Free bodies and chains of joints use different equations in the core."""
    free, chain = (thrown(kind, integrator, 2e-3, ORIGIN) for kind in (True, False))
    for sim in (free, chain):
        sim.step(np.zeros(0), 100)
        sim.check()
    np.testing.assert_allclose(free.q, chain.q, atol=1e-10)
    np.testing.assert_allclose(free.v, chain.v, atol=1e-8)
    assert free.iterations == chain.iterations  # same Newton iterations: the derivatives agree


@pytest.mark.parametrize(("integrator", "order"), [("bdf1", 1), ("bdf2", 2)])
def test_free_joint_off_the_centre_of_mass_agrees_at_the_order_of_the_integrator(integrator: str, order: int) -> None:
    """A free body conserves linear momentum exactly, a chain to the order of the integrator."""
    apart, center = [], (0.02, -0.01, 0.03)
    for step in (2e-3, 1e-3, 5e-4, 2.5e-4):
        free, chain = (thrown(kind, integrator, step, center) for kind in (True, False))
        for of in (Simulator.mass_matrix, Simulator.bias):
            np.testing.assert_allclose(of(free), of(chain), rtol=1e-12, atol=1e-15)
        for sim in (free, chain):
            sim.step(np.zeros(0), round(0.2 / step))
            sim.check()
        apart.append(np.abs(free.q - chain.q).max())
    slopes = -np.diff(np.log2(apart))
    print(f"{integrator}: {apart[-1]:.1e} apart, slopes {slopes.round(2)}")
    assert (slopes > order - 0.3).all()


def test_a_hundred_bodies_have_the_same_free_fall() -> None:
    spec = _core.ModelSpec()
    for i in range(100):
        body = spec.add_body(_core.BodyDef(name=f"body{i}", mass=0.1 + i, inertia=(1, 1, 1, 0, 0, 0)))
        spec.add_joint(_core.JointDef(name=f"slide{i}", body=body, type="slide"))
    sim = Simulator(_core.Model(spec))
    sim.step(np.zeros(0), 20)
    sim.check()
    np.testing.assert_allclose(sim.v[0], -9.8 * 20 * 5e-3, rtol=1e-12)
