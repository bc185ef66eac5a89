"""Mechanical energy of a simulator's state, by kind of storage.

A penalty contact point with depth d stores ½ k_n d², and with elastic friction also ½ k_s |s|², where s is the strain
from its anchor. The core sums forces and does not store values of single points. Therefore a second model, the probe,
has the same points, shapes and anchors as markers of stiffness 1, whose forces are −d n and −s.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotate
from gelflow.sim import _core
from gelflow.sim.arguments import check_type, qualified
from gelflow.sim.scene import CONTACT_PARAMS, Scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

_UNBOUNDED = 1e18  # friction coefficient without slip


@runtime_checkable
class HasModelSpec(Protocol):
    """An object with the definitions of a model, such as `gelflow.sim.Scene`."""

    def model_spec(self) -> _core.ModelSpec: ...


@dataclass(frozen=True)
class Energy:
    """Mechanical energy [J] by kind, each of shape (N,), without the energy of servos and motors."""

    kinetic: Array
    gravity: Array  # of weights and gravity compensation; zero at the origin of the world
    contact: Array  # ½ k_n d² of all contact points; markers that do not collide store none
    friction: Array  # ½ k_s |s|² of all contact points
    springs: Array  # of the springs of joints and tendons
    limits: Array  # of the limits of joints and tendons

    @property
    def total(self) -> Array:
        """Sum of all kinds."""
        return self.kinetic + self.gravity + self.contact + self.friction + self.springs + self.limits


class EnergyGauge:
    """Computes the energy of simulators of one scene.

    Parameters
    ----------
    scene: the `Scene`, or another object with the definitions of the simulator's model
    num_envs: number of environments of the simulators

    Raises UsageError for a scene with loop closures, or with couplings that springs keep.
    """

    def __init__(self, scene: HasModelSpec, *, num_envs: int = 1) -> None:
        check_type("scene", scene, HasModelSpec, "a Scene (see load_scene)")
        spec = scene.model_spec()
        kept = [closure.name for closure in spec.loop_closures]
        kept += [coupling.name for coupling in spec.couplings if len(coupling.coefficients) > 2]
        if kept:
            raise UsageError(f"the energy of the springs that keep {kept[0]!r} is not computed")
        probe, self._contacts = _probe_spec(spec)
        self._probe = Simulator(_core.Model(probe), num_envs=num_envs)
        self._tendons = spec.tendons

    def read(self, sim: Simulator) -> Energy:
        """Energy of the present state of a simulator. Raises UsageError for another number of environments or scene."""
        check_type("sim", sim, Simulator, "a Simulator")
        if sim.num_envs != self._probe.num_envs:
            raise UsageError(f"num_envs is {self._probe.num_envs} of the gauge and {sim.num_envs} of the simulator")
        if sim.model.joint_names != self._probe.model.joint_names:
            raise UsageError("the simulator must be one of the scene of the gauge")
        kinetic = 0.5 * np.einsum("ni,nij,nj->n", sim.v, sim.mass_matrix(), sim.v)
        contact, friction = self._stored(sim, *self.points(sim))
        springs, limits = joint_energies(sim, self._tendons)
        return Energy(kinetic, _gravity(sim), contact, friction, springs, limits)

    def points(self, sim: Simulator) -> tuple[Array, Array]:
        """Depth (N, points), 0 outside, and strain (N, points, 3) in the body's axes, of all contact points [m].

        Points are ordered by contact: those of `ModelSpec.contacts`, then those of colliding pads. Raises UsageError
        for points with another scale than 1.
        """
        probe, numbers = self._probe, set(CONTACT_PARAMS)
        for i, name in enumerate(probe.model.param_names):
            same = qualified(name, sim.param_index, "body", "joint", "shape")
            if same in sim.param_index and name.rsplit(".", 1)[-1] not in numbers:
                probe.params[:, i] = sim.param(same)
        for contact, (_, points) in self._contacts.items():
            for axis in "xyz":
                for pose in ("pos", "turn"):
                    probe.param(f"{contact}.markers.{pose}.{axis}")[:] = sim.param(f"{points}.{pose}.{axis}")
                scale = f"{points}.scale.{axis}"
                if scale in sim.param_index and (sim.param(scale) != 1).any():
                    raise UsageError(f"the energy of scaled points is not computed; {scale} must be 1")
        probe.q[:], probe.v[:] = sim.q, 0
        probe.anchored[:] = 0
        for name, start in _anchor_starts(sim).items():
            if start >= 0:
                own = probe.marker_slice(name)
                theirs = slice(start, start + own.stop - own.start)
                probe.anchors[:, own] = sim.anchors[:, theirs]
                probe.anchored[:, own] = sim.anchored[:, theirs]
        forces = []
        for mu in (0.0, _UNBOUNDED):
            for name in probe.model.pad_names:
                probe.param(f"{name}.mu")[:] = mu
            forces.append(probe.tactile() * [1.0, 1.0, -1.0])
        return np.linalg.norm(forces[0], axis=2), forces[0] - forces[1]

    def _stored(self, sim: Simulator, depth: Array, strain: Array) -> tuple[Array, Array]:
        contact, friction = np.zeros(sim.num_envs), np.zeros(sim.num_envs)
        anchor_starts = _anchor_starts(sim)
        for name, (weights, _) in self._contacts.items():
            own = self._probe.marker_slice(name)
            contact += 0.5 * _number(sim, name, "kn") * (depth[:, own] ** 2 @ weights)
            if anchor_starts[name] >= 0:
                friction += 0.5 * _number(sim, name, "ks") * ((strain[:, own] ** 2).sum(2) @ weights)
        return contact, friction


def actuator_forces(scene: Scene, sim: Simulator, u: ArrayLike) -> Array:
    """Forces of the actuators on their joints or tendons with controls u (nu,), shape (N, nu) [N, N m].

    Times the displacement of a step it is the work of the actuator, since the forces of a step are those at its end.
    """
    controls, forces = np.asarray(u, float), np.zeros((sim.num_envs, scene.nu))
    for i, a in enumerate(scene.actuators):
        length = a.gear * sum(c * sim.q[:, joint.q_start] for joint, c in scene.driven_joints(a))
        speed = a.gear * sum(c * sim.v[:, joint.v_start] for joint, c in scene.driven_joints(a))
        control = np.clip(controls[i], *a.ctrl_range)
        pull = {
            "motor": control + 0 * length,
            "position": a.kp * (control - length) - a.kd * speed,
            "velocity": a.kd * (control - speed),
            "general": a.gain * control + a.bias - a.kp * length - a.kd * speed,
        }[a.kind]
        forces[:, i] = a.gear * np.clip(pull, *a.force_range)
    return forces


def _number(sim: Simulator, contact: str, number: str) -> Array:
    """Parameter of a contact, (N,); contacts of colliding pads have those of the pad."""
    own = qualified(f"{contact}.{number}", sim.param_index, "contact")
    of_pad = qualified(f"{contact.split('/')[0]}.{number}", sim.param_index, "pad")
    return sim.param(own if own in sim.param_index else of_pad)


def _gravity(sim: Simulator) -> Array:
    gravity = np.stack([sim.param(f"gravity.{axis}") for axis in "xyz"], axis=1)
    result, poses = np.zeros(sim.num_envs), sim.poses()
    for n, name in enumerate(sim.model.body_names):
        com = np.stack([sim.param(f"{name}.com.{axis}") for axis in "xyz"], axis=1)
        position = poses[:, n, :3] + [rotate(turn, c) for turn, c in zip(poses[:, n, 3:], com, strict=True)]
        mass = sim.param(f"{name}.mass")
        result -= mass * (position * gravity).sum(1)
        if f"{name}.gravcomp" in sim.model.param_names:
            offset = np.stack([sim.param(f"{name}.gravcomp.{axis}") for axis in "xyz"], axis=1)
            position += [rotate(turn, r) for turn, r in zip(poses[:, n, 3:], offset, strict=True)]
            result += sim.param(f"{name}.gravcomp") * mass * (position * gravity).sum(1)
    return result


def joint_energies(sim: Simulator, tendons: Sequence[_core.TendonDef] = ()) -> tuple[Array, Array]:
    """Energies [J] of the springs of all joints and of `tendons`, and of the springs at their limits, (N,) each."""
    ends = [*sim.model.joint_q[1:], sim.model.nq]
    joints = zip(sim.model.joint_names, sim.model.joint_q, ends, strict=True)
    # A ball or free joint has no spring and no limits.
    values = [("joint", name, sim.q[:, q]) for name, q, end in joints if end - q == 1]
    for tendon in tendons:
        positions = sim.q[:, [sim.model.joint_q[joint] for joint in tendon.joints]]
        values.append(("tendon", tendon.name, positions @ np.array(tendon.coefficients)))
    springs, limits = np.zeros(sim.num_envs), np.zeros(sim.num_envs)
    for kind, name, value in values:
        stiffness, rest, lower, upper, limit_stiffness = (
            sim.param(qualified(f"{name}.{key}", sim.param_index, kind))
            for key in ("stiffness", "springref", "lower", "upper", "limit_stiffness")
        )
        springs += 0.5 * stiffness * (value - rest) ** 2
        beyond = np.maximum(value - upper, 0) + np.maximum(lower - value, 0)
        limits += 0.5 * limit_stiffness * beyond**2
    return springs, limits


def _anchor_starts(sim: Simulator) -> dict[str, int]:
    """First anchor of each contact, by name; -1 under the viscous law."""
    return dict(zip(sim.model.contact_names, sim.model.contact_anchors, strict=True))


def _probe_spec(spec: _core.ModelSpec) -> tuple[_core.ModelSpec, dict[str, tuple[Array, str]]]:
    """The probe: the same bodies and shapes, a pad in place of each contact; and by its name the weights of its points,
    and whose parameters they are ("box.points").

    The pads are elastic, of stiffness 1, so that marker i has anchor i.
    """
    result, shapes, used = _core.ModelSpec(), spec.shapes, {}
    for body in spec.bodies:
        result.add_body(body)
    for joint in spec.joints:
        result.add_joint(joint)
    for shape in shapes:
        result.add_shape(shape)
    sets = spec.points
    contacts = [(c.name, sets[c.points], c.shape, f"{sets[c.points].name}.points") for c in spec.contacts]
    for pad in spec.pads:
        if pad.collides:
            points = _core.PointsDef(
                name=pad.name, body=pad.body, points=pad.positions, weights=pad.weights, pos=pad.pos, quat=pad.quat
            )
            contacts += [(_pad_contact(pad, shapes[i]), points, i, f"{pad.name}.markers") for i in pad.shapes]
    for name, points, index, owner in contacts:
        touched = index if points.radius == 0 else result.add_shape(_raised(shapes[index], points.radius, name))
        result.add_pad(
            _core.PadDef(
                name=name,
                body=points.body,
                positions=points.points,
                shapes=[touched],
                law="elastic",
                kn=1.0,
                kt=0.0,
                mu=0.0,
                kd=0.0,
                ks=1.0,
                pos=points.pos,
                quat=points.quat,
            )
        )
        weights = np.ones(len(points.points)) if points.weights is None else np.array(points.weights)
        used[name] = weights, owner
    return result, used


def _pad_contact(pad: _core.PadDef, shape: _core.ShapeDef) -> str:
    """The name that the core gives to the contact of a colliding pad with a shape."""
    return pad.name if len(pad.shapes) == 1 else f"{pad.name}/{shape.name}"


def _raised(plane: _core.ShapeDef, radius: float, contact: str) -> _core.ShapeDef:
    """The plane raised by the radius of a sphere: its distance to the centre is that of `plane` to the sphere."""
    normal = rotate(plane.quat, np.array([0.0, 0.0, 1.0]))
    return _core.ShapeDef(
        name=f"{plane.name} below {contact}",
        body=plane.body,
        kind=plane.kind,
        pos=plane.pos + radius * np.array(normal),
        quat=plane.quat,
        size=plane.size,
    )
