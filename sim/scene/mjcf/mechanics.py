"""Mechanics from MJCF or URDF, read with MuJoCo's own parser and compiler.

MuJoCo resolves defaults, meshes and inertia; its compiled arrays are the source of every number here. Nothing is
ever stepped by it. Bodies without a joint are merged into the body that carries them, mass and geometry included.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import Pose
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.scene.mjcf.actuators import ActuatorDef, default_limit, joint_extra, read_actuators
from gelflow.sim.scene.mjcf.model_file import compile_model, element_names
from gelflow.sim.scene.mjcf.unsupported import apply_disable_flags, check_supported, not_modelled

Array = NDArray[np.float64]

WORLD = -1


@dataclass(frozen=True)
class BodyDef:
    """A body with at least one joint, with all that is rigidly attached to it."""

    name: str
    parent: int  # index of a moving body, or WORLD
    pose: Pose  # in the parent's frame at q = 0
    mass: float  # [kg]
    com: Array  # centre of mass in the body's frame [m]
    inertia: Array  # xx yy zz xy xz yz about the centre of mass, body axes [kg m²]


@dataclass(frozen=True)
class JointDef:
    name: str
    body: int
    type: str  # "slide", "hinge", "ball" or "free"
    pos: Array  # in the body's frame [m]
    axis: Array
    q_start: int  # index of the first position in q
    v_start: int  # index of the first velocity in v
    damping: float
    armature: float
    stiffness: float
    springref: float
    range: tuple[float, float] | None
    limit: tuple[float, float] | None  # stiffness and damping beyond the range, where the scene gives none
    ref: float  # position at the pose of the file
    frictionloss: float  # [N] or [N m]

    @property
    def nq(self) -> int:
        """How many positions."""
        return {"free": 7, "ball": 4}.get(self.type, 1)

    @property
    def nv(self) -> int:
        """How many velocities."""
        return {"free": 6, "ball": 3}.get(self.type, 1)


@dataclass(frozen=True)
class GeomDef:
    name: str
    body: int
    kind: str  # MuJoCo's name of the type: "box", "cylinder", …
    pose: Pose  # in the moving body's frame
    size: Array  # MuJoCo's three sizes [m]
    mesh: TriangleMesh | None = None  # of the kind "mesh", in the geometry's frame, as MuJoCo compiled it


@dataclass(frozen=True)
class Mechanics:
    """What a model file says of the mechanics."""

    bodies: tuple[BodyDef, ...]
    joints: tuple[JointDef, ...]
    geoms: tuple[GeomDef, ...]
    sites: dict[str, tuple[int, Pose]]
    actuators: tuple[ActuatorDef, ...]
    gravity: Array
    q0: Array
    not_modelled: tuple[str, ...]


_JOINTS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}


def read_mechanics(path: Path) -> Mechanics:
    """Read and compile a model file.

    Raises UsageError, in one line, when a file is missing or unreadable, or holds what the simulator does not model.
    """
    model, urdf = compile_model(path)
    apply_disable_flags(model)
    check_supported(model, path.name)
    carrier, poses = _merge(model)
    actuators = read_actuators(model, path.name)
    sites = {
        name: (int(carrier[b]), poses[b] @ Pose(model.site_pos[i].copy(), model.site_quat[i].copy()))
        for i, (name, b) in enumerate(zip(element_names(model, "site", model.nsite), model.site_bodyid, strict=True))
    }
    if urdf:  # it has no sites: the frames of its links serve as such
        sites = {name: (int(carrier[b]), poses[b]) for b, name in enumerate(element_names(model, "body", model.nbody))}
    return Mechanics(
        bodies=_bodies(model, carrier, poses),
        joints=_joints(model, carrier, actuators),
        geoms=_geoms(model, carrier, poses),
        sites=sites,
        actuators=actuators,
        gravity=model.opt.gravity.copy(),
        q0=_start(model),
        not_modelled=not_modelled(model),
    )


def _start(model: Any) -> Array:
    """Where the scene starts: the keyframe "start", else "home", else the pose in the file."""
    for name in ("start", "home"):
        if (key := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name)) >= 0:
            return np.array(model.key_qpos[key])
    return np.array(model.qpos0)


def _merge(model: Any) -> tuple[NDArray[np.int64], list[Pose]]:
    """For every body of the file: the moving body that carries it, and its pose in that body's frame."""
    carrier = np.full(model.nbody, WORLD)
    poses = [Pose()]
    for b in range(1, model.nbody):
        parent = model.body_parentid[b]
        if model.body_jntnum[b]:
            carrier[b] = carrier.max() + 1
            poses.append(Pose())
        else:
            carrier[b] = carrier[parent]
            poses.append(poses[parent] @ Pose(model.body_pos[b].copy(), model.body_quat[b].copy()))
    return carrier, poses


def _bodies(model: Any, carrier: NDArray[np.int64], poses: list[Pose]) -> tuple[BodyDef, ...]:
    bodies = []
    body_names = element_names(model, "body", model.nbody)
    for root in np.flatnonzero(model.body_jntnum > 0):
        members = np.flatnonzero(carrier == carrier[root])
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
        bodies.append(BodyDef(body_names[root], int(carrier[parent]), pose, mass, com, packed))
    return tuple(bodies)


def _joints(model: Any, carrier: NDArray[np.int64], actuators: tuple[ActuatorDef, ...]) -> tuple[JointDef, ...]:
    joints = []
    for j, name in enumerate(element_names(model, "joint", model.njnt)):
        kind = _JOINTS[int(model.jnt_type[j])]
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        turns = kind in ("ball", "free")
        limited = bool(model.jnt_limited[j]) and not turns
        own = [a for a in actuators if a.joint == j]
        joints.append(
            JointDef(
                name=name,
                body=int(carrier[model.jnt_bodyid[j]]),
                type=kind,
                pos=model.jnt_pos[j].copy(),
                axis=model.jnt_axis[j].copy(),
                q_start=q,
                v_start=v,
                damping=float(model.dof_damping[v]) + joint_extra(model, j, "damping"),
                armature=float(model.dof_armature[v]) + joint_extra(model, j, "armature"),
                stiffness=float(model.jnt_stiffness[j]),
                springref=0.0 if turns else float(model.qpos_spring[q]),
                range=(float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1])) if limited else None,
                limit=default_limit(kind, float(model.dof_M0[v]), own) if limited else None,
                ref=0.0 if turns else float(model.qpos0[q]),
                frictionloss=float(model.dof_frictionloss[v]),
            )
        )
    return tuple(joints)


def _geoms(model: Any, carrier: NDArray[np.int64], poses: list[Pose]) -> tuple[GeomDef, ...]:
    geoms = []
    for g, name in enumerate(element_names(model, "geom", model.ngeom)):
        b = model.geom_bodyid[g]
        pose = poses[b] @ Pose(model.geom_pos[g].copy(), model.geom_quat[g].copy())
        kind = mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower()
        mesh = _mesh(model, int(model.geom_dataid[g])) if kind == "mesh" else None
        geoms.append(GeomDef(name, int(carrier[b]), kind, pose, model.geom_size[g].copy(), mesh))
    return tuple(geoms)


def _mesh(model: Any, m: int) -> TriangleMesh:
    """A compiled mesh: scaled, and in its own principal axes, which the geometry's pose makes up for."""
    first, count = model.mesh_vertadr[m], model.mesh_vertnum[m]
    face, faces = model.mesh_faceadr[m], model.mesh_facenum[m]
    vertices = model.mesh_vert[first : first + count].astype(float)
    return TriangleMesh(vertices, model.mesh_face[face : face + faces].astype(np.int64))
