"""The description of a scene as plain, immutable data."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.scene.contacts import ContactDef, PointsDef
from gelflow.sim.scene.joint_limits import JointLimit
from gelflow.sim.scene.mjcf.actuators import ActuatorDef
from gelflow.sim.scene.mjcf.mechanics import BodyDef, JointDef
from gelflow.sim.scene.pads import PadDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.toml_tables import suggestion

Array = NDArray[np.float64]
Precision = Literal["double", "single"]

DEFAULT_TOLERANCE = 1e-7  # of Newton's method


@dataclass(frozen=True)
class Scene:
    """A scene: bodies, joints, actuators, contact geometry and tactile pads.

    `load_scene` reads a scene from files; `dataclasses.replace` makes a changed copy. Bodies, joints and actuators are
    in the order of the model file, contacts and pads in the order of the TOML file. Elements refer to bodies and joints
    by index, to shapes and points by name.
    """

    name: str
    path: Path  # of the TOML file; names the scene in error messages
    step: float  # time step [s]
    bodies: tuple[BodyDef, ...]  # parents before children
    joints: tuple[JointDef, ...]
    limits: tuple[JointLimit, ...]  # one per joint
    q0: Array  # initial positions, shape (nq,)
    integrator: str = "bdf1"  # or "bdf2"
    tolerance: float = DEFAULT_TOLERANCE  # of Newton's method, see docs/reference/physics.md
    precision: Precision = "double"  # default precision of a `Simulator` of this scene
    friction: str = "viscous"  # friction law of contacts and pads that set none: "viscous" or "elastic"
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))  # [m/s²], shape (3,)
    actuators: tuple[ActuatorDef, ...] = ()
    shapes: tuple[ShapeDef, ...] = ()
    points: tuple[PointsDef, ...] = ()
    contacts: tuple[ContactDef, ...] = ()
    pads: tuple[PadDef, ...] = ()
    not_modelled: tuple[str, ...] = ()  # elements of the files without effect in the simulation, with the reason
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # name -> dotted key -> value

    @property
    def nq(self) -> int:
        """Number of generalized positions."""
        return sum(joint.nq for joint in self.joints)

    @property
    def nv(self) -> int:
        """Number of generalized velocities."""
        return sum(joint.nv for joint in self.joints)

    @property
    def nu(self) -> int:
        """Number of controls."""
        return len(self.actuators)

    @property
    def num_markers(self) -> int:
        """Total number of markers of all pads."""
        return sum(len(pad.positions) for pad in self.pads)

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The marker grid of each pad [mm]. Raises UsageError if a pad is not a rectangle."""
        if no_grid := [pad.name for pad in self.pads if pad.grid is None]:
            raise UsageError(f"{self.path}: pad {no_grid[0]!r} is not a rectangle and has no marker grid")
        return tuple(pad.grid for pad in self.pads if pad.grid is not None)

    def q(self, joint: str) -> slice:
        """The slice of q with the positions of a joint. Raises UsageError on an unknown name."""
        definition = self._joint(joint)
        return slice(definition.q_start, definition.q_start + definition.nq)

    def v(self, joint: str) -> slice:
        """The slice of v with the velocities of a joint. Raises UsageError on an unknown name."""
        definition = self._joint(joint)
        return slice(definition.v_start, definition.v_start + definition.nv)

    def u(self, actuator: str) -> int:
        """The index of an actuator in u. Raises UsageError on an unknown name."""
        return _index("actuator", actuator, [actuator.name for actuator in self.actuators])

    def body(self, name: str) -> int:
        """The index of a moving body. Raises UsageError on an unknown name."""
        return _index("moving body", name, [body.name for body in self.bodies])

    def contact_names(self, contact: str) -> tuple[str, ...]:
        """Names in the model of a contact of the TOML file, one per shape. Raises UsageError on an unknown name."""
        _index("contact", contact, [c.group for c in self.contacts])
        return tuple(c.name for c in self.contacts if c.group == contact)

    def marker_slice(self, pad: str) -> slice:
        """The slice of the tactile forces with the markers of a pad. Raises UsageError on an unknown name."""
        index = _index("pad", pad, [p.name for p in self.pads])
        start = sum(len(p.positions) for p in self.pads[:index])
        return slice(start, start + len(self.pads[index].positions))

    def build(self) -> Any:
        """Compile the scene to a model of the C++ core (gelflow.sim._core.Model)."""
        core = importlib.import_module("gelflow.sim._core")  # lazy: loading a scene does not need the compiled core
        return core.Model(self.describe_to(core.ModelSpec()))

    def describe_to(self, spec: Any) -> Any:
        """Add every element of the scene to `spec` (gelflow.sim._core.ModelSpec) and return it."""
        spec.gravity = tuple(self.gravity)
        spec.step = self.step
        spec.integrator = self.integrator
        spec.tolerance = self.tolerance
        for index, body in enumerate(self.bodies):
            spec.add_body(
                body.name, body.parent, body.pose.position, body.pose.quaternion, body.mass, body.com, body.inertia
            )
            for joint, limit in zip(self.joints, self.limits, strict=True):
                if joint.body == index:
                    _add_joint(spec, joint, limit)
        shapes = {shape.name: _add_shape(spec, shape) for shape in self.shapes}
        points = {
            p.name: spec.add_points(
                p.name,
                p.body,
                p.points,
                p.weights,
                radius=p.radius,
                pos=p.pose.position,
                quat=p.pose.quaternion,
                areas=p.areas if p.per_area else None,
            )
            for p in self.points
        }
        for contact in self.contacts:
            spec.add_contact(
                contact.name,
                points[contact.points],
                shapes[contact.shape],
                law=contact.law,
                damping=contact.damping,
                **contact.params,
            )
        for pad in self.pads:
            frames = [np.ascontiguousarray(pad.axes[..., axis]) for axis in range(3)]
            spec.add_pad(
                pad.name,
                pad.body,
                pad.positions,
                *frames,
                shapes=[shapes[name] for name in pad.against],
                law=pad.law,
                weights=pad.weights,
                pos=pad.pose.position,
                quat=pad.pose.quaternion,
                pushes=pad.collides,
                **pad.params,
            )
        for a in self.actuators:
            spec.add_actuator(
                a.name,
                a.joint,
                kind=a.kind,
                gear=a.gear,
                kp=a.kp,
                kd=a.kd,
                force_lower=a.force_range[0],
                force_upper=a.force_range[1],
                ctrl_lower=a.ctrl_range[0],
                ctrl_upper=a.ctrl_range[1],
                gain=a.gain,
                bias=a.bias,
            )
        return spec

    def _joint(self, name: str) -> JointDef:
        return self.joints[_index("joint", name, [joint.name for joint in self.joints])]


def _add_shape(spec: Any, shape: ShapeDef) -> int:
    geometry = (shape.pose.position, shape.pose.quaternion, shape.size)
    if shape.grid is None:
        return int(spec.add_shape(shape.name, shape.body, shape.kind, *geometry, rounding=shape.rounding))
    return int(
        spec.add_shape(
            shape.name,
            shape.body,
            "grid",
            *geometry,
            origin=shape.grid.origin,
            spacing=shape.grid.spacing,
            coefficients=shape.grid.coefficients,
        )
    )


def _add_joint(spec: Any, joint: JointDef, limit: JointLimit) -> None:
    low, high = joint.range or (-np.inf, np.inf)
    spec.add_joint(
        joint.name,
        joint.body,
        joint.type,
        joint.pos,
        joint.axis,
        damping=joint.damping,
        armature=joint.armature,
        stiffness=joint.stiffness,
        springref=joint.springref,
        lower=low,
        upper=high,
        limit_stiffness=limit.stiffness,
        limit_damping=limit.damping,
        ref=joint.ref,
        frictionloss=joint.frictionloss,
    )


def _index(kind: str, name: str, names: list[str]) -> int:
    if name not in names:
        raise UsageError(f"no {kind} {name!r}; {suggestion(name, names)}")
    return names.index(name)
