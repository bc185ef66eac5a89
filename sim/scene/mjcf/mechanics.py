"""Mechanics of a model file: bodies, joints, geometries, sites, actuators.

MuJoCo parses and compiles the file (defaults, meshes, inertia); it never steps. Bodies without a joint are merged into
the body that they are fixed to, including their mass, geometries and sites.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.scene.mjcf.actuators import ActuatorDef, actuator_addition, default_limit, read_actuators
from gelflow.sim.scene.mjcf.couplings import (
    CouplingDef,
    LoopClosureDef,
    TendonDef,
    driving_actuators,
    loop_joints,
    read_couplings,
    read_loop_closures,
    read_tendons,
)
from gelflow.sim.scene.mjcf.model_file import compile_model, element_names
from gelflow.sim.scene.mjcf.tendon_equalities import read_tendon_equalities
from gelflow.sim.scene.mjcf.unsupported import apply_disable_flags, check_supported, not_modelled

Array = NDArray[np.float64]

WORLD = -1  # body index of the world


@dataclass(frozen=True)
class BodyDef:
    """A moving body: a body with at least one joint and all bodies that are fixed to it."""

    name: str
    parent: int  # index of a moving body, or WORLD
    pose: Pose  # in the parent frame at q = 0
    mass: float  # [kg]
    com: Array  # centre of mass in the body frame [m], shape (3,)
    inertia: Array  # about the centre of mass in body axes [kg m²]: xx, yy, zz, xy, xz, yz
    gravcomp: float = 0.0  # share of the weight that a force at com + gravcomp_pos balances
    gravcomp_pos: Array = field(default_factory=lambda: np.zeros(3))  # in the body frame [m], shape (3,)


@dataclass(frozen=True)
class SiteDef:
    """A named frame on a body."""

    name: str
    body: int  # index of the moving body, or WORLD
    pose: Pose  # in the body frame


@dataclass(frozen=True)
class JointDef:
    """A joint. Units are those of a slide joint; those of a hinge and ball joint have rad for m and N m for N."""

    name: str
    body: int  # index of the moving body
    type: str  # "slide", "hinge", "ball" or "free"
    pos: Array  # in the body frame [m], shape (3,)
    axis: Array  # in the body frame, shape (3,)
    q_start: int  # index of the first position in q
    v_start: int  # index of the first velocity in v
    damping: float = 0.0  # [N s/m]
    armature: float = 0.0  # [kg]
    stiffness: float = 0.0  # [N/m]
    springref: float = 0.0  # position of zero spring force [m]
    range: tuple[float, float] | None = None  # [m]
    default_limit: tuple[float, float] | None = None  # stiffness [N/m] and damping [N s/m] beyond the range
    ref: float = 0.0  # position at which the body has the pose of its definition [m]
    frictionloss: float = 0.0  # dry friction [N]
    prescribed: bool = False  # of a mocap body: no force changes its velocity

    @property
    def nq(self) -> int:
        """Number of positions."""
        return {"free": 7, "ball": 4}.get(self.type, 1)

    @property
    def nv(self) -> int:
        """Number of velocities."""
        return {"free": 6, "ball": 3}.get(self.type, 1)


@dataclass(frozen=True)
class GeomDef:
    """A geometry of a moving body or of the world."""

    name: str
    body: int  # index of a moving body, or WORLD
    kind: str  # MuJoCo geometry type in lower case: "box", "cylinder", …
    pose: Pose  # in the body frame
    size: Array  # MuJoCo's three sizes [m]
    mesh: TriangleMesh | None = None  # of a mesh, in the frame of the geometry


@dataclass(frozen=True)
class Mechanics:
    """The content of a model file."""

    bodies: tuple[BodyDef, ...]
    joints: tuple[JointDef, ...]
    geoms: tuple[GeomDef, ...]
    frames: dict[str, tuple[int, Pose]]  # of all bodies of the file: name -> moving body, pose in its frame
    sites: dict[str, tuple[int, Pose]]  # the same of the sites
    tendons: tuple[TendonDef, ...]
    couplings: tuple[CouplingDef, ...]
    loop_closures: tuple[LoopClosureDef, ...]
    actuators: tuple[ActuatorDef, ...]
    gravity: Array  # [m/s²], shape (3,)
    q0: Array  # initial positions, shape (nq,)
    keyframe_controls: Array | None  # of the keyframe that gives q0, shape (nu,); None: it has none
    step: float  # time step of the file, MuJoCo's 0.002 if it has none [s]
    not_modelled: tuple[str, ...]  # elements without effect, with the reason


_JOINTS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}


def read_mechanics(path: Path) -> Mechanics:
    """Read and compile a model file.

    Raises UsageError, in one line, if a file is missing or invalid, or has an element that is not supported.
    """
    compiled = compile_model(path)
    model = compiled.model
    if model.njnt == 0:
        raise UsageError(f"{path}: the model has no joint, so nothing can move; add a joint, or a free joint to a body")
    apply_disable_flags(model)
    check_supported(model, path.name)
    _check_finite(model, path.name)
    moving_body, poses = _merge(model)
    actuators = read_actuators(model, path.name)
    tendons = read_tendons(model, actuators)
    couplings = read_couplings(model)
    more_couplings, stiff_tendons = read_tendon_equalities(model, couplings)
    frames = {name: (int(moving_body[b]), poses[b]) for b, name in enumerate(element_names(model, "body", model.nbody))}
    sites = {
        name: (int(moving_body[b]), poses[b] @ Pose(model.site_pos[i].copy(), model.site_quat[i].copy()))
        for i, (name, b) in enumerate(zip(element_names(model, "site", model.nsite), model.site_bodyid, strict=True))
    }
    return Mechanics(
        bodies=_bodies(model, moving_body, poses, path.name),
        joints=_joints(model, moving_body, actuators, tendons, compiled.mocap),
        geoms=_geoms(model, moving_body, poses),
        frames=frames,
        sites=frames if compiled.urdf else sites,  # a URDF has no sites; its link frames take their place
        tendons=tendons + stiff_tendons,
        couplings=couplings + more_couplings,
        loop_closures=read_loop_closures(model, moving_body, poses),
        actuators=actuators,
        gravity=model.opt.gravity.copy(),
        q0=compiled.q0,
        keyframe_controls=compiled.controls,
        step=float(model.opt.timestep),
        not_modelled=not_modelled(model),
    )


def _check_finite(model: Any, location: str) -> None:
    """Raise UsageError if a number is not finite from which several elements follow; the core checks the others."""
    numbers = {
        "a body's mass": model.body_mass,
        "an actuator's gear": model.actuator_gear,
        "an actuator's gain": model.actuator_gainprm,
        "an actuator's bias": model.actuator_biasprm,
        "an equality constraint": model.eq_data,
    }
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            raise UsageError(f"{location}: {name} has an entry that is not finite")


def _merge(model: Any) -> tuple[NDArray[np.int64], list[Pose]]:
    """For each body of the file: the moving body that it is merged into, and its pose in the frame of that body."""
    moving_body = np.full(model.nbody, WORLD)
    poses = [Pose()]
    for b in range(1, model.nbody):
        parent = model.body_parentid[b]
        if model.body_jntnum[b]:
            moving_body[b] = moving_body.max() + 1
            poses.append(Pose())
        else:
            moving_body[b] = moving_body[parent]
            poses.append(poses[parent] @ Pose(model.body_pos[b].copy(), model.body_quat[b].copy()))
    return moving_body, poses


def _bodies(model: Any, moving_body: NDArray[np.int64], poses: list[Pose], location: str) -> tuple[BodyDef, ...]:
    bodies = []
    body_names = element_names(model, "body", model.nbody)
    for root in np.flatnonzero(model.body_jntnum > 0):
        members = np.flatnonzero(moving_body == moving_body[root])
        masses = model.body_mass[members]
        mass = float(masses.sum())
        frames = [poses[b] @ Pose(model.body_ipos[b].copy(), model.body_iquat[b].copy()) for b in members]
        com = sum(m * frame.position for m, frame in zip(masses, frames, strict=True)) / max(mass, 1e-300)
        inertia = np.zeros((3, 3))
        for b, m, frame in zip(members, masses, frames, strict=True):
            rotation, arm = frame.matrix(), frame.position - com
            inertia += rotation @ np.diag(model.body_inertia[b]) @ rotation.T
            inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        parent = model.body_parentid[root]
        pose = poses[parent] @ Pose(model.body_pos[root].copy(), model.body_quat[root].copy())
        packed = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        centers = np.array([frame.position for frame in frames])
        owner = f"{location}: body {body_names[root]!r}"
        compensation = _gravity_compensation(model.body_gravcomp[members], masses, centers, com, owner)
        bodies.append(BodyDef(body_names[root], int(moving_body[parent]), pose, mass, com, packed, *compensation))
    return tuple(bodies)


def _gravity_compensation(factors: Array, masses: Array, centers: Array, com: Array, owner: str) -> tuple[float, Array]:
    """Share of the weight that is balanced, and the point of the force relative to the centre of mass `com`.

    `factors`, `masses` (members,) and `centers` (members, 3): of the bodies that are fixed to each other.
    """
    balanced = factors * masses
    total = float(balanced.sum())
    if not balanced.any():
        return 0.0, np.zeros(3)
    if abs(total) <= 1e-9 * float(np.abs(balanced).sum()):
        raise UsageError(f"{owner}: gravcomp of the bodies fixed to it adds up to 0; give them equal gravcomp")
    if len(set(factors[masses > 0])) == 1:
        return float(factors[masses > 0][0]), np.zeros(3)
    return total / float(masses.sum()), balanced @ (centers - com) / total


def _joints(
    model: Any,
    moving_body: NDArray[np.int64],
    actuators: tuple[ActuatorDef, ...],
    tendons: tuple[TendonDef, ...],
    mocap: tuple[str, ...],
) -> tuple[JointDef, ...]:
    in_loops = loop_joints(model)
    # A loop passes the torques of all its joints on to any of them.
    loop_load = sum(_largest_torque(model, j, driving_actuators(actuators, tendons, j)) for j in in_loops)
    joints = []
    for j, name in enumerate(element_names(model, "joint", model.njnt)):
        kind = _JOINTS[int(model.jnt_type[j])]
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        rotates_freely = kind in ("ball", "free")
        limited = bool(model.jnt_limited[j]) and not rotates_freely
        driving = driving_actuators(actuators, tendons, j)
        load = loop_load if j in in_loops and kind == "hinge" else 0.0
        joints.append(
            JointDef(
                name=name,
                body=int(moving_body[model.jnt_bodyid[j]]),
                type=kind,
                pos=model.jnt_pos[j].copy(),
                axis=model.jnt_axis[j].copy(),
                q_start=q,
                v_start=v,
                damping=float(model.dof_damping[v]) + actuator_addition(model, "joint", j, "damping"),
                armature=float(model.dof_armature[v]) + actuator_addition(model, "joint", j, "armature"),
                stiffness=float(model.jnt_stiffness[j]),
                springref=0.0 if rotates_freely else float(model.qpos_spring[q]),
                range=(float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1])) if limited else None,
                default_limit=default_limit(kind, float(model.dof_M0[v]), driving, load) if limited else None,
                ref=0.0 if rotates_freely else float(model.qpos0[q]),
                frictionloss=float(model.dof_frictionloss[v]),
                prescribed=name in mocap,
            )
        )
    return tuple(joints)


def _largest_torque(model: Any, joint: int, actuators: list[ActuatorDef]) -> float:
    """Largest torque of the spring and the actuators with a force limit of a hinge within its range [N m]."""
    if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        return 0.0
    rest = model.qpos_spring[model.jnt_qposadr[joint]]
    spring = float(model.jnt_stiffness[joint] * np.abs(model.jnt_range[joint] - rest).max())
    peaks = [a.peak_force() for a in actuators]
    return spring + sum(peak for peak in peaks if np.isfinite(peak))


def _geoms(model: Any, moving_body: NDArray[np.int64], poses: list[Pose]) -> tuple[GeomDef, ...]:
    geoms = []
    for g, name in enumerate(element_names(model, "geom", model.ngeom)):
        b = model.geom_bodyid[g]
        pose = poses[b] @ Pose(model.geom_pos[g].copy(), model.geom_quat[g].copy())
        kind = mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower()
        mesh = _mesh(model, int(model.geom_dataid[g])) if kind == "mesh" else None
        geoms.append(GeomDef(name, int(moving_body[b]), kind, pose, model.geom_size[g].copy(), mesh))
    return tuple(geoms)


def _mesh(model: Any, m: int) -> TriangleMesh:
    """A compiled mesh: scaled, and in its principal axes; the pose of the geometry includes the inverse rotation."""
    first, count = model.mesh_vertadr[m], model.mesh_vertnum[m]
    face, faces = model.mesh_faceadr[m], model.mesh_facenum[m]
    vertices = model.mesh_vert[first : first + count].astype(float)
    return TriangleMesh(vertices, model.mesh_face[face : face + faces].astype(np.int64))
