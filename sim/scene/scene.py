"""Scenes: mechanics from MJCF or URDF, and what those cannot say from a small TOML file beside it.

`load_scene` reads both, checks every key and name, and returns a `Scene`: plain data, frozen, from which `build`
makes the core's model. Only what the scene requires is passed on: geometry that is in no contact and under no pad is
left out, and `Scene.left_out` says so. The format is described in docs/guide/scenes.md.
"""

import copy
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.scene.mjcf import ActuatorDef, BodyDef, JointDef, read_mechanics
from gelflow.sim.scene.parts import (
    LAWS,
    ContactDef,
    Limit,
    PadDef,
    PointsDef,
    read_contacts,
    read_limits,
    read_pads,
    read_points,
)
from gelflow.sim.scene.presets import read_presets, with_preset
from gelflow.sim.scene.shapes import ShapeDef, used_shapes
from gelflow.toml_tables import TomlTable, read_toml, set_by_path, suggestion

Array = NDArray[np.float64]
Precision = Literal["double", "single"]

INTEGRATORS = ("bdf1", "bdf2")
PRECISIONS: tuple[Precision, ...] = ("double", "single")
TOLERANCE = 1e-7  # of Newton's method, where a scene says nothing
_HOW = ("step", "integrator", "tolerance", "precision")
_PARTS = ("joints", "shapes", "points", "contacts", "pads")
SECTIONS = ("format", "model", *_HOW, "friction", *_PARTS, "presets")


@dataclass(frozen=True)
class Scene:
    """Everything about a scene, as data. Indices follow the model file's order."""

    name: str
    path: Path
    step: float  # [s]
    integrator: str  # "bdf1" or "bdf2"
    tolerance: float  # of Newton's method, see docs/reference/physics.md
    precision: Precision  # in which a `Simulator` steps it unless told otherwise
    friction: str  # the law that contacts and pads follow unless they fix their own
    gravity: Array  # [m/s²]
    bodies: tuple[BodyDef, ...]
    joints: tuple[JointDef, ...]
    limits: tuple[Limit, ...]  # one per joint
    actuators: tuple[ActuatorDef, ...]
    shapes: tuple[ShapeDef, ...]
    points: tuple[PointsDef, ...]
    contacts: tuple[ContactDef, ...]
    pads: tuple[PadDef, ...]
    q0: Array  # where the scene starts: the keyframe "start" or "home", or the pose in the model file
    left_out: tuple[str, ...]  # what the files have and the simulation doesn't, and why
    presets: Mapping[str, Mapping[str, Any]]  # what each preset of the file sets, by dotted key

    @property
    def nq(self) -> int:
        return sum(joint.nq for joint in self.joints)

    @property
    def nv(self) -> int:
        return sum(joint.nv for joint in self.joints)

    @property
    def nu(self) -> int:
        return len(self.actuators)

    @property
    def markers(self) -> int:
        """Markers of all pads together, in the order of `pads`."""
        return sum(len(pad.positions) for pad in self.pads)

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The marker grid of each pad [mm]. Raises UsageError where a pad has none."""
        if round_pads := [pad.name for pad in self.pads if pad.grid is None]:
            raise UsageError(
                f"{self.path}: pad {round_pads[0]!r} is no rectangle; its markers have no rows and columns"
            )
        return tuple(pad.grid for pad in self.pads if pad.grid is not None)

    def q(self, joint: str) -> slice:
        """Where a joint's positions stand in q. Raises UsageError on an unknown name."""
        found = self._joint(joint)
        return slice(found.q, found.q + found.nq)

    def v(self, joint: str) -> slice:
        """Where a joint's velocities stand in v. Raises UsageError on an unknown name."""
        found = self._joint(joint)
        return slice(found.v, found.v + found.nv)

    def u(self, actuator: str) -> int:
        """Where an actuator stands in u. Raises UsageError on an unknown name."""
        return _index("actuator", actuator, [a.name for a in self.actuators])

    def body(self, name: str) -> int:
        """Index of a moving body. Raises UsageError on an unknown name."""
        return _index("moving body", name, [b.name for b in self.bodies])

    def contact_names(self, contact: str) -> tuple[str, ...]:
        """The core's names of a contact of the TOML file: one for each shape that it is against."""
        groups = [c.group for c in self.contacts]
        _index("contact", contact, groups)
        return tuple(c.name for c in self.contacts if c.group == contact)

    def markers_of(self, pad: str) -> slice:
        """Where a pad's markers stand in the tactile reading. Raises UsageError on an unknown name."""
        index = _index("pad", pad, [p.name for p in self.pads])
        first = sum(len(p.positions) for p in self.pads[:index])
        return slice(first, first + len(self.pads[index].positions))

    def build(self) -> Any:
        """The core's model of this scene (gelflow.sim._core.Model)."""
        core = importlib.import_module("gelflow.sim._core")  # here: scenes can be checked where it is not built
        return core.Model(self.describe_to(core.ModelSpec()))

    def describe_to(self, spec: Any) -> Any:
        """Tell a model builder (gelflow.sim._core.ModelSpec) every part of this scene; returns it."""
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
                    _tell_joint(spec, joint, limit)
        shapes = {shape.name: _tell_shape(spec, shape) for shape in self.shapes}
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
                **contact.numbers,
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
                pushes=pad.pushes,
                **pad.numbers,
            )
        for a in self.actuators:
            spec.add_actuator(
                a.name,
                a.joint,
                kind=a.kind,
                gear=a.gear,
                kp=a.kp,
                kd=a.kd,
                force_lower=a.force[0],
                force_upper=a.force[1],
                ctrl_lower=a.control[0],
                ctrl_upper=a.control[1],
                gain=a.gain,
                bias=a.bias,
            )
        return spec

    def _joint(self, name: str) -> JointDef:
        return self.joints[_index("joint", name, [j.name for j in self.joints])]


def _tell_shape(spec: Any, shape: ShapeDef) -> int:
    place = (shape.pose.position, shape.pose.quaternion, shape.size)
    if shape.grid is None:
        return int(spec.add_shape(shape.name, shape.body, shape.kind, *place, rounding=shape.rounding))
    return int(
        spec.add_shape(
            shape.name,
            shape.body,
            "grid",
            *place,
            origin=shape.grid.origin,
            spacing=shape.grid.spacing,
            coefficients=shape.grid.coefficients,
        )
    )


def _tell_joint(spec: Any, joint: JointDef, limit: Limit) -> None:
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


def scene_names() -> tuple[str, ...]:
    """Names of the scenes that come with gelflow."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in _shipped().iterdir() if p.name.endswith(".toml")))


def load_scene(
    scene: str | Path,
    *,
    preset: str | None = None,
    friction: str | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Scene:
    """Read a scene.

    Parameters
    ----------
    scene: name of a scene that comes with gelflow, or path of a TOML file
    preset: name of one of the file's presets, such as "fast": how exactly it is simulated, and at what cost
    friction: "viscous" or "elastic", instead of the file's own choice
    overrides: values that replace those of the file, by dotted key, such as {"pads.pad.rows": 50}; `*` for every
        table at its place. Keys are checked like the file's own. They count more than the preset's.

    Raises UsageError, in one line, on an unknown key or name, a missing file, or what the simulator does not model.
    """
    path = _find(scene)
    data = copy.deepcopy(read_toml(path))
    presets = read_presets(TomlTable(data, str(path)), free=_HOW, parts=_PARTS)
    if preset is not None:
        with_preset(data, presets, preset, str(path))
    for key, value in (overrides or {}).items():
        set_by_path(data, key, value)
    if friction is not None:
        data["friction"] = friction
    top = TomlTable(data, str(path))
    if top.integer("format") > 1:
        raise UsageError(f"{path}: format is {top.integer('format')}; this gelflow reads format 1")
    top.check_keys(SECTIONS)
    law = top.string("friction", "viscous", choices=LAWS)
    mechanics = read_mechanics(path.parent / top.string("model"))
    points = read_points(top.tables("points"), mechanics)
    contacts = read_contacts(top.tables("contacts"), points, mechanics, law)
    pads = read_pads(top.tables("pads"), mechanics, law, path.parent)
    wanted = {contact.shape for contact in contacts} | {name for pad in pads for name in pad.against}
    sampled = {points[contact.points].geom for contact in contacts}
    shapes, unused = used_shapes(mechanics, top.tables("shapes"), wanted, sampled)
    idle = tuple(f"points {name}: in no contact" for name in points if all(c.points != name for c in contacts))
    return Scene(
        name=path.stem,
        path=path,
        step=top.number("step", minimum=1e-6),
        integrator=top.string("integrator", "bdf1", choices=INTEGRATORS),
        tolerance=top.number("tolerance", TOLERANCE, minimum=1e-15),
        precision=cast("Precision", top.string("precision", "double", choices=PRECISIONS)),
        friction=law,
        gravity=mechanics.gravity,
        bodies=mechanics.bodies,
        joints=mechanics.joints,
        limits=read_limits(top.tables("joints"), mechanics, top.location),
        actuators=mechanics.actuators,
        shapes=shapes,
        points=tuple(p for p in points.values() if any(c.points == p.name for c in contacts)),
        contacts=contacts,
        pads=pads,
        q0=mechanics.q0,
        left_out=(*mechanics.left_out, *unused, *idle),
        presets=presets,
    )


def _find(scene: str | Path) -> Path:
    path = Path(scene)
    if path.suffix == ".toml" or path.is_file():
        return path
    shipped = Path(str(_shipped())) / f"{scene}.toml"
    if not shipped.is_file():
        raise UsageError(f"no scene {str(scene)!r}; {suggestion(str(scene), scene_names())} (or give a .toml file)")
    return shipped


def _shipped() -> Any:
    return resources.files("gelflow.sim") / "scenes"


def _index(what: str, name: str, names: list[str]) -> int:
    if name not in names:
        raise UsageError(f"no {what} {name!r}; {suggestion(name, names)}")
    return names.index(name)
