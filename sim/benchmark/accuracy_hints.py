"""Hints where step, integrator or start of a scene are poor for its bodies and contacts (`gelflow describe`)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import rotation_matrices
from gelflow.sim import _core
from gelflow.sim.scene import Scene
from gelflow.sim.scene.contacts import ContactDef, PointsDef
from gelflow.sim.scene.mjcf.mechanics import JointDef
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.gradient_check import retract

Array = NDArray[np.float64]

SPIN = 30.0  # [rad/s] of the test of a body that rotates freely
LARGEST_LOSS = 0.01  # of its energy per turn, without a hint
LARGEST_PHASE = 1.0  # [rad] of the oscillation of a contact per step, without a hint
_DIFFERENCE = 1e-6  # [m, rad] of numerical derivatives
_OUTSIDE = 1e-3  # [m, rad] outside of its range by which a joint may start, without a hint


def accuracy_hints(scene: Scene) -> tuple[str, ...]:
    """One line for each body and each contact that the step and integrator of a scene resolve poorly.

    Also one for each joint that starts outside its range.
    """
    return (*_spin_hints(scene), *_contact_hints(scene), *_start_hints(scene))


def energy_change_per_turn(inertia: Array, step: float, integrator: str) -> float:
    """Relative change of the energy of a free body within a turn at `SPIN`, equal about all principal axes.

    Parameters
    ----------
    inertia: about the centre of rotation [kg m²], shape (3, 3)
    step: time step [s]
    integrator: "bdf1" or "bdf2"
    """
    moments = np.linalg.eigvalsh(inertia)
    spec = _core.ModelSpec()
    spec.gravity, spec.step, spec.integrator = (0.0, 0.0, 0.0), step, integrator
    # Only ratios of the moments matter.
    spec.add_body(_core.BodyDef(name="body", mass=1.0, inertia=(*(moments / moments[2]), 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="joint", body=0, type="free"))
    sim = Simulator(_core.Model(spec), threads=1)
    sim.v[0, 3:] = SPIN / np.sqrt(3)
    before = float(moments @ sim.v[0, 3:] ** 2)
    sim.step(np.zeros(0), max(1, round(2 * np.pi / SPIN / step)))
    return float(moments @ sim.v[0, 3:] ** 2) / before - 1


def contact_period(scene: Scene, contact: ContactDef) -> float:
    """Period of the undamped oscillation of the bodies of a contact on one of its points, in the first state [s].

    The mass is the smallest over all directions, with the joints of both bodies free; infinite if nothing moves.
    """
    points = next(p for p in scene.points if p.name == contact.points)
    stiffness = contact.params["kn"] * float(np.median(points.weights))
    inverse_mass = _largest_inverse_mass(scene, points, next(s.body for s in scene.shapes if s.name == contact.shape))
    return float("inf") if stiffness * inverse_mass == 0 else 2 * np.pi / float(np.sqrt(stiffness * inverse_mass))


def _spin_hints(scene: Scene) -> Iterator[str]:
    for joint in scene.joints:
        if joint.type not in ("free", "ball") or joint.prescribed or scene.bodies[joint.body].mass <= 0:
            continue
        inertia = _inertia_about(scene, joint)
        change = energy_change_per_turn(inertia, scene.step, scene.integrator)
        if abs(change) <= LARGEST_LOSS:
            continue
        step = f"{scene.integrator} with steps of {1e3 * scene.step:g} ms"
        text = f"{step} changes the energy by {100 * change:.2g} % per turn"
        other = energy_change_per_turn(inertia, scene.step, "bdf2")
        better = f'; integrator = "bdf2": {100 * other:.2g} %' if scene.integrator == "bdf1" else "; use shorter steps"
        yield f"body {scene.bodies[joint.body].name}, where it tumbles at {SPIN:g} rad/s: {text}{better}"


def _contact_hints(scene: Scene) -> Iterator[str]:
    for contact in scene.contacts:
        period = contact_period(scene, contact)
        if 2 * np.pi * scene.step / period > LARGEST_PHASE:
            milliseconds = f"{1e3 * period:.2g} ms, which steps of {1e3 * scene.step:g} ms do not resolve"
            yield (
                f"contact {contact.name}: the bodies oscillate on one of its points with a period of {milliseconds}: "
                f"impacts lose energy and are late; bdf2 with steps of {1e3 * period / 20:.2g} ms resolves them"
            )


def _start_hints(scene: Scene) -> Iterator[str]:
    for joint in scene.joints:
        if joint.range is None:
            continue
        (low, high), start = joint.range, float(scene.q0[joint.q_start])
        if not low - _OUTSIDE < start < high + _OUTSIDE:
            unit = "m" if joint.type == "slide" else "rad"
            yield (
                f"joint {joint.name}: starts at {start:g} {unit}, outside its range of {low:g} to {high:g} {unit}: its "
                'limit pushes it back; give an MJCF file a keyframe "start", or set sim.q before the first step'
            )


def _inertia_about(scene: Scene, joint: JointDef) -> Array:
    """Inertia of the body of a joint about its centre of mass, or about the centre of a ball joint."""
    body = scene.bodies[joint.body]
    xx, yy, zz, xy, xz, yz = body.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if joint.type == "free":
        return inertia
    arm = body.com - joint.pos
    return inertia + body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def _largest_inverse_mass(scene: Scene, points: PointsDef, shape_body: int) -> float:
    """Largest eigenvalue of J M⁻¹ Jᵀ [1/kg], J the Jacobian of the velocity between both bodies at the points' mean."""
    model = scene.build()
    sim = Simulator(model, threads=1)
    sim.q[0] = scene.q0
    params = np.asarray(sim.params, dtype=float)
    frame = _core.SiteDef(name="frame", body=shape_body, pos=(0, 0, 0), quat=(1, 0, 0, 0))
    center = _core.SiteDef(name="center", body=points.body, pos=points.points.mean(0), quat=(1, 0, 0, 0))
    first = _core.site_poses(model, [frame, center], params, sim.q).reshape(2, 7)
    turn = rotation_matrices(first[0, 3:])
    opposite = turn.T @ (first[1, :3] - first[0, :3])
    sites = [center, _core.SiteDef(name="opposite", body=shape_body, pos=opposite, quat=(1, 0, 0, 0))]
    jacobian = np.zeros((3, model.nv))
    for i, tangent in enumerate(_DIFFERENCE * np.eye(model.nv)):
        rows = np.stack([retract(model, scene.q0, sign * tangent) for sign in (1, -1)])
        positions = _core.site_poses(model, sites, np.repeat(params, 2, axis=0), rows).reshape(2, 2, 7)[..., :3]
        between = positions[:, 0] - positions[:, 1]
        jacobian[:, i] = (between[0] - between[1]) / (2 * _DIFFERENCE)
    free = np.ones(model.nv, dtype=bool)
    for joint in scene.joints:
        free[joint.v_start : joint.v_start + joint.nv] &= not joint.prescribed
    mass = np.asarray(sim.mass_matrix(), dtype=float)[0][np.ix_(free, free)]
    inverse = jacobian[:, free] @ np.linalg.solve(mass, jacobian[:, free].T)
    return max(0.0, float(np.linalg.eigvalsh(inverse).max()))
