"""Newton's third law: contact forces between moving bodies cancel, in every scene with such contacts.

The bodies of a scene become free bodies at their poses in the middle of the scene's motion, without gravity, actuators
and joints, with the contacts of the scene.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.geometry import rotation_matrices
from gelflow.sim import _core
from gelflow.sim.scene import load_scene, scene_names
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion
from gelflow.sim.validation.thrown_bodies import SIZE, ThrownBody

Array = NDArray[np.float64]

TOLERANCE = 1e-11  # of Newton's method
IN_TOUCH = {"rolling": 0.2, "pushing": 0.2, "insertion": 0.3, "grasp": 0.2, "dclaw": 0.3}  # time in contact [s]


def free_bodies(spec: _core.ModelSpec, poses: Array, *, centred: bool) -> tuple[_core.ModelSpec, Array]:
    """The bodies of `spec` as free bodies at `poses` (bodies, 7), the contacts between two of them, and their poses.

    `centred`: each body's frame is moved to its centre of mass.
    """
    free, poses = _core.ModelSpec(), poses.copy()
    shifts = [body.com * centred for body in spec.bodies]  # of each body's frame, in that frame
    for body, pose, shift in zip(spec.bodies, poses, shifts, strict=True):
        pose[:3] += rotation_matrices(pose[3:]) @ shift
        body.parent, body.pos, body.quat, body.com = -1, pose[:3], pose[3:], body.com - shift
        index = free.add_body(body)
        free.add_joint(_core.JointDef(name=f"{body.name} floats", body=index, type="free"))
    shapes, points = spec.shapes, spec.points
    for shape in shapes:
        shape.pos = shape.pos - (shifts[shape.body] if shape.body >= 0 else 0.0)
        free.add_shape(shape)
    for point_set in points:
        point_set.points = point_set.points - shifts[point_set.body]
        free.add_points(point_set)
    for contact in spec.contacts:
        if shapes[contact.shape].body >= 0 and points[contact.points].body >= 0:
            free.add_contact(contact)
    return free, poses


def cut_loose(name: str, law: str, step: float = 1e-3, integrator: str = "bdf1", *, centred: bool = True) -> Simulator:
    """The bodies of a scene as free bodies, with the state in the middle of its motion."""
    scene = load_scene(name, friction=law)
    sim, moves = Simulator(scene), reference_motion(scene)
    sim.q[0] = moves.q0
    for u in moves.step_controls(scene.step)[: round(IN_TOUCH[name] / scene.step)]:
        sim.step(u)
    sim.check()
    spec, poses = free_bodies(scene.model_spec(), sim.poses()[0], centred=centred)
    spec.integrator, spec.step = integrator, step
    spec.gravity, spec.tolerance = (0.0, 0.0, 0.0), TOLERANCE
    floating = Simulator(_core.Model(spec))
    assert len(floating.model.contact_names) > 0
    floating.q[0] = poses.ravel()
    floating.v[0] = 1e-2 * np.random.default_rng(0).normal(size=floating.model.nv)
    return floating


def in_world(sim: Simulator, of_joints: Array) -> Array:
    """Generalized forces (or momenta) of free bodies as (moment about the world origin, force), (bodies, 6)."""
    poses, parts = sim.poses()[0], of_joints.reshape(-1, 6)
    moment = np.einsum("bij,bj->bi", rotation_matrices(poses[:, 3:]), parts[:, 3:]) + np.cross(
        poses[:, :3], parts[:, :3]
    )
    return np.hstack([moment, parts[:, :3]])


def momentum(sim: Simulator) -> Array:
    """Momentum of each body: (angular about the world origin, linear)."""
    return in_world(sim, sim.mass_matrix()[0] @ sim.v[0])


@pytest.mark.parametrize("law", ["viscous", "elastic"])
@pytest.mark.parametrize("name", scene_names())
def test_contact_forces_and_moments_between_bodies_cancel(name: str, law: str) -> None:
    """The wrenches from the bodies' equations of motion sum to zero, and equal the simulator's contact wrench on the
    first body of each contact."""
    sim = cut_loose(name, law, 1e-5)  # fingers of 0.2 g pressed with 5 N separate within larger steps
    touched = 0.0
    for _ in range(10):
        before, anchors, anchored = sim.v[0].copy(), sim.anchors.copy(), sim.anchored.copy()
        sim.step(np.zeros(0))
        sim.check()
        force = sim.mass_matrix()[0] @ (sim.v[0] - before) / sim.model.step + sim.bias()[0]
        on_bodies = in_world(sim, force)
        after, set_after = sim.anchors.copy(), sim.anchored.copy()
        sim.anchors[:], sim.anchored[:] = anchors, anchored  # those at the start of the step
        wrenches = sim.wrenches()[0].copy()
        sim.anchors[:], sim.anchored[:] = after, set_after
        size = np.abs(wrenches).max(0, initial=0.0)
        size = np.repeat([size[:3].max(), size[3:].max()], 3)
        if size[3] < 1e-6:
            continue
        touched = max(touched, float(size[3]))
        assert (np.abs(on_bodies.sum(0)) <= 1e-9 * size).all()
        assert np.abs(on_bodies).sum(0).max() > 0
    assert touched > 1e-3


@pytest.mark.parametrize("law", ["viscous", "elastic"])
@pytest.mark.parametrize("name", scene_names())
def test_generalized_contact_forces_cancel_to_rounding(name: str, law: str) -> None:
    """Generalized contact forces of a step, as forces and moments on the free bodies."""
    sim = cut_loose(name, law, 1e-5)
    touched, worst = 0.0, 0.0
    for _ in range(10):
        sim.step(np.zeros(0))
        on_bodies = in_world(sim, sim.contact_forces()[0])
        wrenches = sim.wrenches()[0]
        size = np.repeat(np.abs(wrenches).reshape(-1, 2, 3).max((0, 2)), 3)
        if size[3] < 1e-6:
            continue
        touched = max(touched, float(size[3]))
        worst = max(worst, float(np.abs(on_bodies.sum(0) / size).max()))
        if len(wrenches) == 1:
            np.testing.assert_allclose(np.abs(on_bodies), np.abs(wrenches).repeat(2, 0), atol=1e-13 * size.max())
    sim.check()
    print(f"{name}, {law}: pairs cancel to {worst:.0e}")
    assert touched > 1e-3
    assert worst < 1e-13


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
def test_generalized_contact_forces_do_not_depend_on_the_spin(integrator: str) -> None:
    """Without damping and friction; the arc correction belongs to a step, not to the forces of a state."""
    numbers = {"kn": 2e3, "kt": 0.0, "mu": 0.0, "kd": 0.0, "ks": 0.0}
    throw = ThrownBody("box", "viscous", "hunt-crossley", 1e-3, numbers, integrator=integrator)
    sim = Simulator(_core.Model(throw.model_spec()), num_envs=2)
    sim.q[:, 0], sim.q[:, 2] = -10, 0.6 * SIZE - 1e-3
    sim.v[1, 3:6] = 5.0, -3.0, 8.0
    forces = sim.contact_forces()
    assert forces[0, 2] > 1e-3
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
@pytest.mark.parametrize("name", scene_names())
def test_linear_momentum_is_conserved_to_the_newton_tolerance(name: str, integrator: str, centred: bool) -> None:
    """For any location of the body frame."""
    sim = cut_loose(name, "elastic", integrator=integrator, centred=centred)
    start, mass = momentum(sim)[:, 3:].sum(0), sum(sim.param(f"{b}.mass")[0] for b in sim.model.body_names)
    largest, steps = 0.0, 200
    for _ in range(steps):
        sim.step(np.zeros(0))
        largest = max(largest, float(np.abs(sim.wrenches()).max()))
    sim.check()
    assert largest > 1e-3
    drift = np.abs(momentum(sim)[:, 3:].sum(0) - start).max()
    assert drift <= 10 * steps * TOLERANCE * sim.model.step * (9.81 * mass + largest)


def drift_of(law: str, step: float) -> float:
    """Change of the angular momentum of the pushing scene's bodies in 20 ms."""
    sim = cut_loose("pushing", law, step)
    start = momentum(sim).sum(0)
    sim.step(np.zeros(0), round(0.02 / step))
    sim.check()
    return float(np.linalg.norm((momentum(sim).sum(0) - start)[:3]))


@pytest.mark.parametrize("law", ["viscous", "elastic"])
def test_angular_momentum_error_is_of_first_order(law: str) -> None:
    """Torques are those at the end of a BDF1 step, while lever arms change within the step."""
    drifts = [drift_of(law, step) for step in (2e-4, 1e-4, 5e-5, 2.5e-5)]
    slopes = -np.diff(np.log2(drifts))
    print(f"{law}: drifts {[f'{d:.1e}' for d in drifts]} N m s, slopes {slopes.round(2)}")
    np.testing.assert_allclose(slopes, 1, atol=0.3)
