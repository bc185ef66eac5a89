"""Mechanical energy of a simulator's state, by kind of storage.

A penalty contact point with depth d stores ½ k_n d², and with elastic friction also ½ k_s |s|², where s is the strain
from its anchor. The core sums forces and does not store values of single points. Therefore a second model, the probe,
has the same points, shapes and anchors as markers of stiffness 1, whose forces are −d n and −s.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.geometry import rotate
from gelflow.sim import _core
from gelflow.sim.scene import CONTACT_PARAMS, Scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.gradient_check import quaternion_joints

Array = NDArray[np.float64]

_UNBOUNDED = 1e18  # friction coefficient without slip


class Describes(Protocol):
    """An object that adds its parts to a ModelSpec, such as `gelflow.sim.Scene`."""

    def describe_to(self, spec: Any) -> Any: ...


@dataclass(frozen=True)
class Energy:
    """Mechanical energy [J] by kind, each of shape (N,), without the energy of servos and motors."""

    kinetic: Array
    gravity: Array  # zero at the origin of the world
    contact: Array  # ½ k_n d² of all contact points; markers that do not collide store none
    friction: Array  # ½ k_s |s|² of all contact points
    springs: Array  # of joint springs
    limits: Array  # of joint limits

    @property
    def total(self) -> Array:
        """Sum of all kinds."""
        return self.kinetic + self.gravity + self.contact + self.friction + self.springs + self.limits


class EnergyGauge:
    """Computes the energy of simulators of one scene.

    Parameters
    ----------
    scene: the `Scene`, or another object that described the simulator's model
    num_envs: number of environments of the simulators
    """

    def __init__(self, scene: Describes, *, num_envs: int = 1) -> None:
        self._parts = _Parts()
        scene.describe_to(self._parts)
        self._probe = Simulator(_core.Model(self._parts.spec), num_envs=num_envs)

    def read(self, sim: Simulator) -> Energy:
        """Energy of the present state of a simulator."""
        kinetic = 0.5 * np.einsum("ni,nij,nj->n", sim.v, sim.mass_matrix(), sim.v)
        contact, friction = self._stored(sim, *self.points(sim))
        springs, limits = _joints(sim)
        return Energy(kinetic, _gravity(sim), contact, friction, springs, limits)

    def points(self, sim: Simulator) -> tuple[Array, Array]:
        """Depth (N, points), 0 outside, and strain (N, points, 3) in the body's axes, of all contact points [m].

        Points are ordered by contact, as in the scene.
        """
        probe, numbers = self._probe, set(CONTACT_PARAMS)
        columns = {name: i for i, name in enumerate(sim.model.param_names)}
        for i, name in enumerate(probe.model.param_names):
            if name in columns and name.rsplit(".", 1)[-1] not in numbers:
                probe.params[:, i] = sim.params[:, columns[name]]
        probe.q[:], probe.v[:] = sim.q, 0
        probe.anchored[:] = 0
        first = 0
        for block, count in zip(self._parts.anchors, self._parts.counts, strict=True):
            if block is not None:
                probe.anchors[:, first : first + count] = sim.anchors[:, block : block + count]
                probe.anchored[:, first : first + count] = sim.anchored[:, block : block + count]
            first += count
        forces = []
        for mu in (0.0, _UNBOUNDED):
            for name in probe.model.pad_names:
                probe.param(f"{name}.mu")[:] = mu
            forces.append(probe.tactile() * [1.0, 1.0, -1.0])
        return np.linalg.norm(forces[0], axis=2), forces[0] - forces[1]

    def _stored(self, sim: Simulator, depth: Array, strain: Array) -> tuple[Array, Array]:
        contact, friction = np.zeros(sim.num_envs), np.zeros(sim.num_envs)
        for n, name in enumerate(self._probe.model.pad_names):
            own, weights = self._probe.pad(name), self._parts.weights[n]
            contact += 0.5 * _number(sim, name, "kn") * (depth[:, own] ** 2 @ weights)
            if self._parts.anchors[n] is not None:
                friction += 0.5 * _number(sim, name, "ks") * ((strain[:, own] ** 2).sum(2) @ weights)
        return contact, friction


def actuator_forces(scene: Scene, sim: Simulator, u: ArrayLike) -> Array:
    """Joint forces of the actuators at the present state with controls u (nu,), shape (N, nu) [N, N m].

    Times the displacement of a step it is the work of the actuator, since the forces of a step are those at its end.
    """
    controls, forces = np.asarray(u, float), np.zeros((sim.num_envs, scene.nu))
    for i, a in enumerate(scene.actuators):
        length = a.gear * sim.q[:, sim.model.joint_q[a.joint]]
        speed = a.gear * sim.v[:, sim.model.joint_v[a.joint]]
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
    """Parameter of a contact, (N,); contacts of a pad with several shapes have those of the pad."""
    own = f"{contact}.{number}"
    return sim.param(own if own in sim.model.param_names else f"{contact.split('/')[0]}.{number}")


def _gravity(sim: Simulator) -> Array:
    gravity = np.stack([sim.param(f"gravity.{axis}") for axis in "xyz"], axis=1)
    result, poses = np.zeros(sim.num_envs), sim.poses()
    for n, name in enumerate(sim.model.body_names):
        com = np.stack([sim.param(f"{name}.com.{axis}") for axis in "xyz"], axis=1)
        position = poses[:, n, :3] + [rotate(turn, c) for turn, c in zip(poses[:, n, 3:], com, strict=True)]
        result -= sim.param(f"{name}.mass") * (position * gravity).sum(1)
    return result


def _joints(sim: Simulator) -> tuple[Array, Array]:
    springs, limits = np.zeros(sim.num_envs), np.zeros(sim.num_envs)
    quaternions = {v for _, v in quaternion_joints(sim.model)}
    for name, q, v in zip(sim.model.joint_names, sim.model.joint_q, sim.model.joint_v, strict=True):
        if v in quaternions or v + 3 in quaternions:  # ball or free joint
            continue
        value = sim.q[:, q]
        springs += 0.5 * sim.param(f"{name}.stiffness") * (value - sim.param(f"{name}.springref")) ** 2
        beyond = np.maximum(value - sim.param(f"{name}.upper"), 0) + np.maximum(sim.param(f"{name}.lower") - value, 0)
        limits += 0.5 * sim.param(f"{name}.limit_stiffness") * beyond**2
    return springs, limits


class _Parts:
    """Stands in for ModelSpec: builds the probe, with markers in place of contact points."""

    gravity: Any
    step: float
    integrator: str
    tolerance: float

    def __init__(self) -> None:
        self.spec = _core.ModelSpec()
        self.anchors: list[int | None] = []  # first anchor of each contact; None without anchors
        self.counts: list[int] = []  # points of each contact
        self.weights: list[Array] = []
        self._anchors = 0
        self._points: list[tuple[int, Array, Array, float, dict[str, Array]]] = []
        self._shapes: list[tuple[Any, ...]] = []

    def add_body(self, *args: Any, **more: Any) -> int:
        return int(self.spec.add_body(*args, **more))

    def add_joint(self, *args: Any, **more: Any) -> None:
        self.spec.add_joint(*args, **more)

    def add_actuator(self, *args: Any, **more: Any) -> None:
        pass

    def add_shape(self, name: str, body: int, kind: str, pos: Any, quat: Any, size: Any, **more: Any) -> int:
        self._shapes.append((name, body, kind, pos, quat, size))
        self.spec.add_shape(name, body, kind, pos, quat, size, **more)
        return len(self._shapes) - 1

    def add_points(
        self,
        name: str,
        body: int,
        points: ArrayLike,
        weights: ArrayLike,
        radius: float = 0.0,
        pos: ArrayLike = (0, 0, 0),
        quat: ArrayLike = (1, 0, 0, 0),
        areas: Any = None,
    ) -> int:
        place = {"pos": np.array(pos, float), "quat": np.array(quat, float)}
        self._points.append((body, np.array(points, float), np.array(weights, float), radius, place))
        return len(self._points) - 1

    def add_contact(self, name: str, points: int, shape: int, *, law: str = "viscous", **numbers: Any) -> None:
        body, places, weights, radius, place = self._points[points]
        if radius > 0:  # lowest point of a sphere: its centre against a plane shifted by the radius
            owner, on, kind, pos, quat, size = self._shapes[shape]
            w, x, y, z = np.asarray(quat, float) / np.linalg.norm(quat)
            normal = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
            shape = self.add_shape(f"{owner} below {name}", on, kind, np.asarray(pos) + radius * normal, quat, size)
        axes = [np.tile(axis, (len(places), 1)) for axis in np.eye(3)]
        self.spec.add_pad(
            name, body, places, *axes, shapes=[shape], law="elastic", kn=1.0, kt=0.0, mu=0.0, kd=0.0, ks=1.0, **place
        )
        self.weights.append(weights)
        self.counts.append(len(places))
        self.anchors.append(self._anchors if law == "elastic" else None)
        self._anchors += len(places) if law == "elastic" else 0

    def add_pad(
        self,
        name: str,
        body: int,
        positions: ArrayLike,
        *axes: Any,
        shapes: Any,
        law: str = "viscous",
        weights: ArrayLike | None = None,
        pos: ArrayLike = (0, 0, 0),
        quat: ArrayLike = (1, 0, 0, 0),
        pushes: bool = False,
        **_: Any,
    ) -> None:
        count = len(np.asarray(positions))
        if not pushes:
            self._anchors += count * len(shapes) if law == "elastic" else 0
            return
        points = self.add_points(name, body, positions, np.ones(count) if weights is None else weights, 0.0, pos, quat)
        for shape in shapes:
            own = name if len(shapes) == 1 else f"{name}/{self._shapes[shape][0]}"
            self.add_contact(own, points, shape, law=law)
