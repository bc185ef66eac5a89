"""Description of a loaded scene: its parts, elements that are not modelled, and its size (`gelflow describe`)."""

import ctypes
import gc
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.benchmark.accuracy_hints import accuracy_hints
from gelflow.sim.scene import Scene
from gelflow.sim.scene.loader import scene_tables
from gelflow.sim.scene.mjcf.mechanics import WORLD, JointDef, Mechanics, read_mechanics
from gelflow.sim.scene.mjcf.model_file import compile_model, element_names
from gelflow.sim.scene.start_controls import holding_controls
from gelflow.sim.simulator import Simulator


@dataclass(frozen=True)
class ActuatorPart:
    """An actuator of a joint, or of a tendon with the joint."""

    name: str
    kind: str  # "motor", "position", "velocity" or "general"
    gear: float
    kp: float
    kd: float
    gain: float  # factor of the control; 1 except for kind "general"
    bias: float
    force: tuple[float | None, float | None]  # [N] or [N m]; None where unlimited
    control: tuple[float | None, float | None]  # range of the control; None where unlimited


@dataclass(frozen=True)
class JointPart:
    """A joint of a body."""

    name: str
    type: str
    axis: tuple[float, ...] | None  # in the body's frame; None for ball and free joints
    range: tuple[float, float] | None  # [m] or [rad]
    limit_stiffness: float
    damping: float
    armature: float
    stiffness: float
    frictionloss: float
    prescribed: bool  # of a mocap body: no force changes its velocity
    actuators: tuple[ActuatorPart, ...]


@dataclass(frozen=True)
class BodyPart:
    """A moving body, or the world, with its rigidly attached bodies."""

    name: str
    parent: str | None  # None for the world
    mass: float  # [kg], of the attached bodies too; 0 for the world
    merged: tuple[str, ...]  # bodies of the model file that are merged into it
    geometry: tuple[str, ...]  # kind and name
    joints: tuple[JointPart, ...]


@dataclass(frozen=True)
class ShapePart:
    """A contact geometry that differs from the model file."""

    name: str
    kind: str  # "box", "cylinder" or "mesh"
    rounding: float  # radius of the edges [m]
    cells: tuple[int, int, int] | None  # of a mesh's grid, along x, y, z
    spacing: float | None  # [m], edge of a cell
    bytes: int | None  # of the grid, shared by all environments


@dataclass(frozen=True)
class ContactPart:
    """A contact of sampled points with one or more shapes."""

    name: str
    points: str  # kind and name of the sampled geometry
    candidates: int  # points
    against: tuple[str, ...]
    law: str
    damping: str
    unit: str  # "per point", "per area" or "one exact point"
    numbers: dict[str, float]  # kn, kt, mu, kd, ks


@dataclass(frozen=True)
class PadPart:
    """A tactile pad."""

    name: str
    body: str
    shape: str  # "rectangle", "disc", "hemisphere" or "points"
    markers: int
    rows: int | None  # None without a grid
    cols: int | None
    pitch_mm: float | None
    against: tuple[str, ...]
    law: str
    unit: str
    numbers: dict[str, float]
    collides: bool  # the markers are contact points
    gel: str | None  # None without a gel model


@dataclass(frozen=True)
class Size:
    """Size of a scene; bytes for double precision."""

    nq: int
    nv: int
    nu: int
    contact_pairs: int  # pairs of a point set and a geometry
    candidate_points: int  # largest number of point-geometry tests in an evaluation of the contacts
    anchors: int  # friction anchors: points and markers, for each geometry
    markers: int
    parameters: int
    state_bytes: int  # per environment
    parameter_bytes: int  # per environment
    reading_bytes: int  # per environment
    workspace_bytes: int | None  # per thread, as allocated; None if the C library does not report it
    model_bytes: int | None  # shared by all environments


@dataclass(frozen=True)
class Description:
    """All parts of a scene, elements that are not modelled, and its size."""

    scene: str
    path: str
    step: float  # [s]
    integrator: str  # "bdf1" or "bdf2"
    friction: str
    gravity: tuple[float, ...]  # [m/s²]
    bodies: tuple[BodyPart, ...]  # the world first
    couplings: tuple[str, ...]  # couplings of joints, fixed tendons and loop closures, a line each
    shapes: tuple[ShapePart, ...]  # meshes and rounded shapes
    contacts: tuple[ContactPart, ...]
    pads: tuple[PadPart, ...]
    hints: tuple[str, ...]  # parts that the step and integrator resolve poorly
    not_modelled: tuple[str, ...]
    size: Size


def describe(scene: Scene) -> Description:
    """Describe a scene.

    Raises UsageError when the scene's files changed after it was loaded.
    """
    if not isinstance(scene, Scene):
        raise UsageError(f"scene must be a Scene (see load_scene), got {type(scene).__name__}")
    path = scene.path.parent / str(scene_tables(scene.path).get("model"))
    mechanics = read_mechanics(path)
    if [b.name for b in mechanics.bodies] != [b.name for b in scene.bodies]:
        raise UsageError(f"{path} has other bodies than the loaded scene; load the scene again")
    model = compile_model(path).model
    bodies = _bodies(scene, mechanics, model)
    kinds = {geom.name: geom.kind for geom in mechanics.geoms}
    return Description(
        scene=scene.name,
        path=str(scene.path),
        step=scene.step,
        integrator=scene.integrator,
        friction=scene.friction,
        gravity=_floats(scene.gravity),
        bodies=bodies,
        couplings=_couplings(scene),
        shapes=_shapes(scene),
        contacts=_contacts(scene, kinds),
        pads=tuple(
            PadPart(
                name=pad.name,
                body=_body_name(scene, pad.body),
                shape=pad.shape,
                markers=len(pad.positions),
                rows=pad.grid.rows if pad.grid else None,
                cols=pad.grid.cols if pad.grid else None,
                pitch_mm=pad.grid.pitch if pad.grid else None,
                against=pad.against,
                law=pad.law,
                unit="per point" if (pad.weights == 1).all() else "per area",
                numbers=dict(pad.params),
                collides=pad.collides,
                gel=None if pad.gel is None else str(pad.gel),
            )
            for pad in scene.pads
        ),
        hints=accuracy_hints(scene),
        not_modelled=(*scene.not_modelled, *_not_modelled(scene, mechanics, model, bodies)),
        size=_size(scene),
    )


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(x) for x in values)


def _body_name(scene: Scene, body: int) -> str:
    return "world" if body == WORLD else scene.bodies[body].name


def _bodies(scene: Scene, mechanics: Mechanics, model: Any) -> tuple[BodyPart, ...]:
    roots = [0, *np.flatnonzero(model.body_jntnum > 0)]  # bodies of the file: the world, and those with joints
    file_names = element_names(model, "body", model.nbody)
    parts = []
    for index, root in zip(range(WORLD, len(scene.bodies)), roots, strict=True):
        welded = [int(b) for b in np.flatnonzero(model.body_weldid == root) if b != root]
        parts.append(
            BodyPart(
                name=_body_name(scene, index),
                parent=None if index == WORLD else _body_name(scene, scene.bodies[index].parent),
                mass=0.0 if index == WORLD else scene.bodies[index].mass,
                merged=tuple(file_names[b] for b in welded),
                geometry=tuple(f"{g.kind} {g.name}" for g in mechanics.geoms if g.body == index),
                joints=tuple(
                    JointPart(
                        name=joint.name,
                        type=joint.type,
                        axis=_floats(joint.axis) if joint.type in ("slide", "hinge") else None,
                        range=joint.range,
                        limit_stiffness=limit.stiffness,
                        damping=joint.damping,
                        armature=joint.armature,
                        stiffness=joint.stiffness,
                        frictionloss=joint.frictionloss,
                        prescribed=joint.prescribed,
                        actuators=_actuators(scene, joint),
                    )
                    for joint, limit in zip(scene.joints, scene.limits, strict=True)
                    if joint.body == index
                ),
            )
        )
    return tuple(parts)


def _actuators(scene: Scene, joint: JointDef) -> tuple[ActuatorPart, ...]:
    def bounds(pair: tuple[float, float]) -> tuple[float | None, float | None]:
        low, high = (x if np.isfinite(x) else None for x in pair)
        return low, high

    return tuple(
        ActuatorPart(a.name, a.kind, a.gear, a.kp, a.kd, a.gain, a.bias, bounds(a.force_range), bounds(a.ctrl_range))
        for a in scene.actuators
        if any(driven is joint for driven, _ in scene.driven_joints(a))
    )


def _couplings(scene: Scene) -> tuple[str, ...]:
    def sum_of(terms: Iterable[tuple[float, str]]) -> str:
        words = [f"{c:g} {name}".strip() for c, name in terms if c != 0]
        return " + ".join(words) if words else "0"

    lines = []
    for coupling in scene.couplings:
        leader = scene.joints[coupling.leader].name
        powers = ["", leader, *(f"{leader}^{n}" for n in range(2, len(coupling.coefficients)))]
        kind = "exact" if len(coupling.coefficients) <= 2 else "kept by a spring"
        terms = zip(coupling.coefficients, powers, strict=False)
        lines.append(f"{scene.joints[coupling.joint].name} = {sum_of(terms)} ({kind})")
    for tendon in scene.tendons:
        names = (scene.joints[j].name for j in tendon.joints)
        lines.append(f"tendon {tendon.name} = {sum_of(zip(tendon.coefficients, names, strict=True))}")
    for closure in scene.loop_closures:
        first, second = (_body_name(scene, b) for b in closure.bodies)
        lines.append(f"{'weld' if closure.weld else 'connect'} {closure.name}: {first} to {second}")
    return tuple(lines)


def _shapes(scene: Scene) -> tuple[ShapePart, ...]:
    return tuple(
        ShapePart(
            name=shape.name,
            kind=shape.kind,
            rounding=shape.rounding,
            cells=shape.grid.cells if shape.grid else None,
            spacing=shape.grid.spacing if shape.grid else None,
            bytes=shape.grid.nbytes if shape.grid else None,
        )
        for shape in scene.shapes
        if shape.rounding > 0 or shape.grid is not None
    )


def _contacts(scene: Scene, kinds: dict[str, str]) -> tuple[ContactPart, ...]:
    points = {p.name: p for p in scene.points}
    parts = []
    for group, members in itertools.groupby(scene.contacts, lambda contact: contact.group):
        contacts = list(members)
        first = contacts[0]
        sampled = points[first.points]
        unit = "per area" if sampled.per_area else "per point"
        parts.append(
            ContactPart(
                name=group,
                points=f"{kinds[sampled.geom]} {sampled.geom}",
                candidates=len(sampled.points),
                against=tuple(c.shape for c in contacts),
                law=first.law,
                damping=first.damping,
                unit="one exact point" if sampled.radius > 0 else unit,
                numbers=dict(first.params),
            )
        )
    return tuple(parts)


def _not_modelled(scene: Scene, mechanics: Mechanics, model: Any, bodies: tuple[BodyPart, ...]) -> Iterator[str]:
    """Elements without effect that `Scene.not_modelled` does not list, with the reason."""
    for body in bodies:
        for name in body.merged:
            merged = "" if body.parent is None else ", merged into it with its mass"
            yield f"body {name}: rigidly attached to {body.name}{merged}; no cost"
    for pad in scene.pads:
        if pad.law == "viscous" and not pad.collides:
            yield f"pad {pad.name}: viscous markers have no history; no cost until their forces are evaluated"
    shapes = {shape.name: shape.body for shape in scene.shapes}
    points = {p.name: p.body for p in scene.points}
    contacts = {frozenset((points[c.points], shapes[c.shape])) for c in scene.contacts}
    contacts |= {frozenset((pad.body, shapes[name])) for pad in scene.pads if pad.collides for name in pad.against}
    solid = sorted({geom.body for geom in mechanics.geoms})
    apart = [
        f"{_body_name(scene, b)} and {_body_name(scene, a)}"
        for a, b in itertools.combinations(solid, 2)
        if frozenset((a, b)) not in contacts and (a == WORLD or scene.bodies[b].parent != a)
    ]
    if apart:
        more = f" and {len(apart) - 6} more pairs" if len(apart) > 6 else ""
        yield f"contact between {', '.join(apart[:6])}{more}: not in the scene file; no collision"
    drawn = {"cameras": model.ncam, "lights": model.nlight, "materials": model.nmat, "textures": model.ntex}
    if any(drawn.values()):
        yield f"{', '.join(f'{n} {what}' for what, n in drawn.items() if n)}: for drawing only"
    yield "MuJoCo's contact and solver settings: replaced by those of the scene file"


def _size(scene: Scene) -> Size:
    Simulator(scene, threads=1).tactile()  # one-time allocations are not counted below
    gc.collect()
    before = _allocated()
    model = scene.build()
    built = _allocated()
    sim = Simulator(model, threads=1)
    sim.q[:] = scene.q0
    sim.step(holding_controls(scene))
    sim.tactile()
    after = _allocated()
    state = (sim.q, sim.v, sim.anchors, sim.anchored, sim.status, sim.iterations, sim.halved)
    state_bytes = sum(array.nbytes for array in state)
    reading_bytes = int(model.num_markers) * 3 * sim.q.itemsize
    known = state_bytes + sim.params.nbytes + reading_bytes
    sizes = {p.name: len(p.points) for p in scene.points}
    colliding = [pad for pad in scene.pads if pad.collides]
    return Size(
        nq=model.nq,
        nv=model.nv,
        nu=model.nu,
        contact_pairs=len(scene.contacts) + sum(len(pad.against) for pad in colliding),
        candidate_points=sum(sizes[c.points] for c in scene.contacts)
        + sum(len(pad.positions) * len(pad.against) for pad in colliding),
        anchors=model.na,
        markers=model.num_markers,
        parameters=len(model.param_names),
        state_bytes=state_bytes,
        parameter_bytes=sim.params.nbytes,
        reading_bytes=reading_bytes,
        workspace_bytes=None if built is None or after is None else max(0, after - built - known),
        model_bytes=None if before is None or built is None else max(0, built - before),
    )


class _Mallinfo2(ctypes.Structure):
    """Heap statistics of glibc [bytes]."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]


def _allocated() -> int | None:
    """Bytes allocated with malloc by this process; None without glibc 2.33 or newer."""
    try:
        mallinfo2 = ctypes.CDLL(None).mallinfo2
    except (OSError, AttributeError, TypeError):
        return None
    mallinfo2.restype = _Mallinfo2
    info = mallinfo2()
    return int(info.uordblks + info.hblkhd)
