"""Contact and friction compared with statics, closed-form motions and Newton's third law.

A block is a free cube with its corners as contact points: 8 of them, 4 of which touch. Stiffness is per point.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotation_matrices
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)
G = 9.8
HALF = 0.02
MASS = 0.3
CORNERS = HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


def block(spec: Any, name: str, pos: Any = ORIGIN, mass: float = MASS) -> int:
    """Add a free cube; returns its body."""
    inertia = mass * (2 * HALF) ** 2 / 6
    body = int(
        spec.add_body(_core.BodyDef(name=name, pos=pos, mass=mass, inertia=(inertia, inertia, inertia, 0, 0, 0)))
    )
    spec.add_joint(_core.JointDef(name=f"{name}_free", body=body, type="free"))
    return body


def block_on_plane(law: str, *, slope: float = 0.0, damping: str = "hunt-crossley", **numbers: float) -> Simulator:
    """A block on a plane, with markers of the same law at its corners; gravity is inclined by `slope` [rad]."""
    spec = _core.ModelSpec()
    spec.step, spec.tolerance = 2e-3, 1e-12
    spec.gravity = (G * np.sin(slope), 0.0, -G * np.cos(slope))
    body = block(spec, "block", (0, 0, HALF))
    plane = spec.add_shape(_core.ShapeDef(name="plane", kind="plane", size=(1, 1, 1)))
    points = spec.add_points(_core.PointsDef(name="corners", body=body, points=CORNERS))
    law_numbers: dict[str, Any] = {
        "kn": 2e3,
        "kt": 20.0,
        "mu": 0.6,
        "kd": 2e4,
        "ks": 1e3 if law == "elastic" else 0.0,
    } | numbers
    spec.add_contact(
        _core.ContactDef(name="contact", points=points, shape=plane, law=law, damping=damping, **law_numbers)
    )
    spec.add_pad(
        _core.PadDef(
            name="pad",
            body=body,
            positions=CORNERS,
            shapes=[plane],
            law=law,
            **law_numbers,
        )
    )
    return Simulator(_core.Model(spec))


def settle(sim: Simulator, seconds: float) -> None:
    sim.step(np.zeros(0), round(seconds / sim.model.step))
    sim.check()


@pytest.mark.parametrize("damping", ["hunt-crossley", "linear"])
@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_contact_forces_of_a_resting_block_carry_its_weight(law: str, damping: str) -> None:
    sim = block_on_plane(law, damping=damping, kd=20.0 if damping == "linear" else 2e4)
    settle(sim, 2.0)
    wrench = sim.wrenches()[0, 0]
    np.testing.assert_allclose(wrench[3:], [0, 0, MASS * G], atol=1e-9)
    np.testing.assert_allclose(wrench[:3], 0, atol=1e-10)  # about the origin, below the block
    assert HALF - sim.q[0, 2] == pytest.approx(MASS * G / (4 * 2e3), rel=1e-8)


def test_sticking_block_creeps_under_the_viscous_law() -> None:
    """The rate with N points in contact and load F is F / (N k_t)."""
    sim = block_on_plane("viscous", slope=0.3)
    settle(sim, 2.0)
    speed = MASS * G * np.sin(0.3) / (4 * 20.0)
    assert sim.v[0, 0] == pytest.approx(speed, rel=1e-6)
    before = sim.q[0, 0]
    settle(sim, 1.0)
    assert sim.q[0, 0] - before == pytest.approx(speed, rel=1e-6)


def test_sticking_block_does_not_creep_under_the_elastic_law() -> None:
    """Its displacement is F / (N k_s), constant, and zero again without load."""
    sim = block_on_plane("elastic", mu=2.0)  # no corner slips during the oscillation
    settle(sim, 1.0)
    rest = sim.q[0, 0]
    sim.param("gravity.x")[:] = G * 0.3
    settle(sim, 2.0)
    held = sim.q[0].copy()
    settle(sim, 2.0)
    np.testing.assert_allclose(sim.q[0], held, atol=1e-10)
    lean = 2 * held[5]  # rotation about y moves the lower face relative to the centre
    assert held[0] - HALF * lean - rest == pytest.approx(MASS * G * 0.3 / (4 * 1e3), rel=1e-3)
    sim.param("gravity.x")[:] = 0
    settle(sim, 2.0)
    assert sim.q[0, 0] == pytest.approx(rest, abs=1e-8)


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_slipping_block_is_decelerated_by_mu_n(law: str) -> None:
    slope, mu = 0.3, 0.1
    sim = block_on_plane(law, slope=slope, mu=mu)
    settle(sim, 0.5)
    before = sim.v[0, 0]
    settle(sim, 0.5)
    rate = (sim.v[0, 0] - before) / 0.5
    assert rate == pytest.approx(G * (np.sin(slope) - mu * np.cos(slope)), rel=1e-4)
    friction = sim.wrenches()[0, 0, 3:]
    assert abs(friction[0]) == pytest.approx(mu * friction[2], rel=1e-9)


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("slope", [0.3, 0.9])
def test_marker_forces_at_contact_points_add_up_to_the_contact_force(law: str, slope: float) -> None:
    """With the contact's parameters, sticking and slipping."""
    sim = block_on_plane(law, slope=slope)
    sim.v[0, 3:] = 0.1, 0.2, 0.5
    sim.step(np.zeros(0), 60)
    quat = sim.poses()[0, 0, 3:]
    force = (sim.tactile()[0] * [1, 1, -1]).sum(0) @ rotation_matrices(quat).T
    # Wrench and marker forces use the present state and anchors.
    np.testing.assert_allclose(force, sim.wrenches()[0, 0, 3:], rtol=0, atol=1e-13)
    assert sim.tactile()[0, :, :2].any()


def two_blocks(law: str) -> Simulator:
    """Two free blocks: the corners of the first in contact with the faces of the second."""
    spec = _core.ModelSpec()
    spec.step, spec.tolerance, spec.gravity = 1e-3, 1e-13, ORIGIN
    first = block(spec, "first")
    second = block(spec, "second", (1.9 * HALF, 0.7 * HALF, 0.4 * HALF), mass=0.1)
    shape = spec.add_shape(_core.ShapeDef(name="box", body=second, kind="box", size=(HALF, HALF, HALF)))
    points = spec.add_points(_core.PointsDef(name="corners", body=first, points=CORNERS))
    spec.add_contact(
        _core.ContactDef(
            name="contact", points=points, shape=shape, law=law, kn=300.0, kt=0.5, mu=0.7, kd=30.0, ks=100.0
        )
    )
    sim = Simulator(_core.Model(spec))
    sim.v[0] = 0.3, 0.05, 0.0, 1.0, -2.0, 3.0, -0.2, 0.0, 0.1, 0.0, 1.0, -1.0
    return sim


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_contact_forces_on_two_bodies_are_equal_and_opposite(law: str) -> None:
    """The change of momentum in a step is the contact impulse, with opposite signs for the two bodies."""
    sim = two_blocks(law)
    # The force of the implicit step is that of its end with the anchors of its start, which are restored here.
    gained = 0.0
    for _ in range(40):
        before, anchors, anchored = sim.v[0].copy(), sim.anchors.copy(), sim.anchored.copy()
        sim.step(np.zeros(0))
        sim.check()
        after, set_after = sim.anchors.copy(), sim.anchored.copy()
        sim.anchors[:], sim.anchored[:] = anchors, anchored
        wrench = sim.wrenches()[0, 0]
        sim.anchors[:], sim.anchored[:] = after, set_after
        gain = (sim.v[0] - before) / sim.model.step
        np.testing.assert_allclose(MASS * gain[:3], wrench[3:], atol=1e-9)
        np.testing.assert_allclose(0.1 * gain[6:9], -wrench[3:], atol=1e-9)
        for mass, joint, sign in ((MASS, 0, 1), (0.1, 1, -1)):
            position, turn = (
                sim.q[0, 7 * joint : 7 * joint + 3],
                rotation_matrices(sim.q[0, 7 * joint + 3 : 7 * joint + 7]),
            )
            moment = wrench[:3] - np.cross(position, wrench[3:])  # about the body's centre
            torque = mass * (2 * HALF) ** 2 / 6 * turn @ gain[6 * joint + 3 : 6 * joint + 6]
            np.testing.assert_allclose(torque, sign * moment, atol=1e-10)
        gained = max(gained, float(np.abs(wrench).max()))
    assert gained > 0.1
    momentum = MASS * sim.v[0, :3] + 0.1 * sim.v[0, 6:9]
    np.testing.assert_allclose(momentum, MASS * np.array([0.3, 0.05, 0]) + 0.1 * np.array([-0.2, 0, 0.1]), atol=1e-12)


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_contact_does_not_add_energy(law: str) -> None:
    sim = two_blocks(law)
    masses = np.repeat([MASS, 0.1], 6) * np.tile([1, 1, 1, *[(2 * HALF) ** 2 / 6] * 3], 2)
    start = 0.5 * float(masses @ sim.v[0] ** 2)
    sim.step(np.zeros(0), 400)
    sim.check()
    assert 0.5 * float(masses @ sim.v[0] ** 2) < start
    np.testing.assert_array_equal(sim.wrenches(), 0)  # separated


def ball_on_plane(step: float = 1e-3) -> Simulator:
    spec = _core.ModelSpec()
    spec.step, spec.tolerance = step, 1e-12
    radius, mass = 0.03, 0.2
    inertia = 0.4 * mass * radius**2
    ball = spec.add_body(
        _core.BodyDef(name="ball", pos=(0, 0, radius), mass=mass, inertia=(inertia, inertia, inertia, 0, 0, 0))
    )
    spec.add_joint(_core.JointDef(name="free", body=ball, type="free"))
    plane = spec.add_shape(_core.ShapeDef(name="plane", kind="plane", size=(1, 1, 1)))
    points = spec.add_points(_core.PointsDef(name="centre", body=ball, points=[ORIGIN], radius=radius))
    spec.add_contact(
        _core.ContactDef(
            name="contact", points=points, shape=plane, damping="linear", kn=5e4, kt=200.0, mu=0.3, kd=50.0
        )
    )
    return Simulator(_core.Model(spec))


def test_penetration_of_a_sphere_balances_its_weight() -> None:
    sim = ball_on_plane()
    settle(sim, 1.0)
    assert 0.03 - sim.q[0, 2] == pytest.approx(0.2 * G / 5e4, rel=1e-9)
    np.testing.assert_allclose(sim.wrenches()[0, 0], [0, 0, 0, 0, 0, 0.2 * G], atol=1e-10)


def test_sliding_ball_ends_rolling_at_five_sevenths_of_its_speed() -> None:
    """For any friction: conserved angular momentum about the contact gives v = 5/7 v₀, rolling without slip."""
    sim = ball_on_plane()
    settle(sim, 0.5)
    sim.v[0, 0] = 1.0
    depth = 0.03 - sim.q[0, 2]
    sliding = (2 / 7) * 1.0 / (0.3 * G)
    sim.step(np.zeros(0), round(0.5 * sliding / sim.model.step))
    assert 1.0 - sim.v[0, 0] == pytest.approx(0.3 * G * round(0.5 * sliding / 1e-3) * 1e-3, rel=1e-6)
    settle(sim, sliding)
    # The ground's reaction acts at the ground, `depth` above the sphere's lowest point.
    assert sim.v[0, 0] == pytest.approx(5 / 7, rel=5 * depth / 0.03)
    spin = rotation_matrices(sim.q[0, 3:]) @ sim.v[0, 3:]
    assert spin[1] * 0.03 == pytest.approx(sim.v[0, 0], rel=1e-6)
    before = sim.v[0, 0]
    settle(sim, 0.5)
    assert sim.v[0, 0] == pytest.approx(before, rel=1e-6)


def test_invalid_contacts_raise() -> None:
    with pytest.raises(ValueError, match="ks > 0"):
        block_on_plane("elastic", ks=0.0)
    with pytest.raises(ValueError, match="mu must be finite and not negative"):
        block_on_plane("viscous", mu=-1.0)
    with pytest.raises(ValueError, match="'sticky' is not one of viscous, elastic"):
        block_on_plane("sticky")
    with pytest.raises(UsageError, match=r"no parameter 'contact.kz'; there are contact\.kn"):
        block_on_plane("viscous").param("contact.kz")
