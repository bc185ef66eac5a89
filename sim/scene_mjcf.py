"""Mechanics from MJCF or URDF, read with MuJoCo's own parser and compiler.

MuJoCo resolves defaults, meshes and inertia; its compiled arrays are the source of every number here. Nothing is
ever stepped by it. Bodies without a joint are merged into the body that carries them, mass and geometry included.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

Array = NDArray[np.float64]

WORLD = -1


@dataclass(frozen=True)
class Pose:
    """A frame in another: x_outer = pos + R(quat) x_inner."""

    pos: Array = field(default_factory=lambda: np.zeros(3))  # [m]
    quat: Array = field(default_factory=lambda: np.array([1.0, 0, 0, 0]))  # w x y z

    def matrix(self) -> Array:
        flat = np.zeros(9)
        mujoco.mju_quat2Mat(flat, self.quat)
        return flat.reshape(3, 3)

    def points(self, points: Array) -> Array:
        """Points of the inner frame in the outer one [m], shape (n, 3)."""
        return points @ self.matrix().T + self.pos

    def __matmul__(self, inner: "Pose") -> "Pose":
        quat = np.zeros(4)
        mujoco.mju_mulQuat(quat, self.quat, inner.quat)
        return Pose(self.points(inner.pos[None])[0], quat)


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
    type: str  # "slide", "hinge" or "free"
    pos: Array  # in the body's frame [m]
    axis: Array
    q: int  # first position
    v: int  # first velocity
    damping: float
    armature: float
    stiffness: float
    springref: float
    range: tuple[float, float] | None


@dataclass(frozen=True)
class GeomDef:
    name: str
    body: int
    kind: str  # MuJoCo's name of the type: "box", "cylinder", …
    pose: Pose  # in the moving body's frame
    size: Array  # MuJoCo's three sizes [m]


@dataclass(frozen=True)
class ActuatorDef:
    name: str
    joint: int
    kind: str  # "motor" or "position"
    gear: float
    kp: float
    kd: float
    force: tuple[float, float]


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
    left_out: tuple[str, ...]


_JOINTS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "free",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
}


def read_mechanics(path: Path) -> Mechanics:
    """Read and compile a model file.

    Raises UsageError, in one line, when a file is missing or unreadable, or holds what the simulator does not model.
    """
    if not path.is_file():
        raise UsageError(f"no such model file: {path}")
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
    except (ValueError, mujoco.FatalError) as error:
        raise UsageError(f"{path}: {' '.join(str(error).split())}") from None
    where = path.name
    _refuse(model, where)
    carrier, poses = _merge(model)
    joints = _joints(model, carrier, where)
    start = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "start")
    return Mechanics(
        bodies=_bodies(model, carrier, poses),
        joints=joints,
        geoms=_geoms(model, carrier, poses),
        sites={
            model.site(i).name: (int(carrier[b]), poses[b] @ Pose(model.site_pos[i].copy(), model.site_quat[i].copy()))
            for i, b in enumerate(model.site_bodyid)
        },
        actuators=_actuators(model, where),
        gravity=model.opt.gravity.copy(),
        q0=(model.qpos0 if start < 0 else model.key_qpos[start]).copy(),
        left_out=_left_out(model),
    )


def _refuse(model: Any, where: str) -> None:
    """Raise UsageError on a feature whose absence would silently change the motion."""
    counts = {
        "equality constraints": model.neq,
        "tendons": model.ntendon,
        "flexible bodies": model.nflex,
        "plugins": model.nplugin,
        "mocap bodies": model.nmocap,
        "joint friction loss": np.count_nonzero(model.dof_frictionloss),
        "gravity compensation": np.count_nonzero(model.body_gravcomp),
        "joint force ranges (actuatorfrcrange)": np.count_nonzero(model.jnt_actfrclimited),
        "a surrounding medium (density, viscosity, wind)": np.count_nonzero(
            [model.opt.density, model.opt.viscosity, *model.opt.wind]
        ),
    }
    if found := [name for name, count in counts.items() if count]:
        raise UsageError(f"{where}: {found[0]} are not modelled; take them out of the model")


def _left_out(model: Any) -> tuple[str, ...]:
    """What the file has besides, that changes no motion here."""
    parts = []
    if model.npair or model.nexclude:
        parts.append(
            f"{model.npair + model.nexclude} contact pairs and excludes: the scene file says what touches what"
        )
    if model.nsensor:
        parts.append(f"{model.nsensor} MuJoCo sensors: the scene file has pads")
    return tuple(parts)


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
    for root in np.flatnonzero(model.body_jntnum > 0):
        members = np.flatnonzero(carrier == carrier[root])
        masses = model.body_mass[members]
        mass = float(masses.sum())
        frames = [poses[b] @ Pose(model.body_ipos[b].copy(), model.body_iquat[b].copy()) for b in members]
        com = sum(m * frame.pos for m, frame in zip(masses, frames, strict=True)) / max(mass, 1e-300)
        inertia = np.zeros((3, 3))
        for b, m, frame in zip(members, masses, frames, strict=True):
            rotation, arm = frame.matrix(), frame.pos - com
            inertia += rotation @ np.diag(model.body_inertia[b]) @ rotation.T
            inertia += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        parent = model.body_parentid[root]
        pose = poses[parent] @ Pose(model.body_pos[root].copy(), model.body_quat[root].copy())
        packed = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        bodies.append(BodyDef(model.body(root).name or f"body{root}", int(carrier[parent]), pose, mass, com, packed))
    return tuple(bodies)


def _joints(model: Any, carrier: NDArray[np.int64], where: str) -> tuple[JointDef, ...]:
    joints = []
    for j in range(model.njnt):
        name = model.joint(j).name or f"joint{j}"
        kind = _JOINTS.get(int(model.jnt_type[j]))
        if kind is None:
            raise UsageError(f"{where}: joint {name!r} is a ball joint; slide, hinge and free joints are modelled")
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        if kind != "free" and model.qpos0[q] != 0:
            raise UsageError(f"{where}: joint {name!r} has ref = {model.qpos0[q]:g}; positions must count from 0")
        if kind == "free" and model.jnt_stiffness[j] != 0:
            raise UsageError(f"{where}: joint {name!r} is free and has a stiffness; a free body has no spring")
        limits = tuple(float(x) for x in model.jnt_range[j])
        joints.append(
            JointDef(
                name=name,
                body=int(carrier[model.jnt_bodyid[j]]),
                type=kind,
                pos=model.jnt_pos[j].copy(),
                axis=model.jnt_axis[j].copy(),
                q=q,
                v=v,
                damping=float(model.dof_damping[v]),
                armature=float(model.dof_armature[v]),
                stiffness=float(model.jnt_stiffness[j]),
                springref=0.0 if kind == "free" else float(model.qpos_spring[q]),
                range=(limits[0], limits[1]) if model.jnt_limited[j] else None,
            )
        )
    return tuple(joints)


def _geoms(model: Any, carrier: NDArray[np.int64], poses: list[Pose]) -> tuple[GeomDef, ...]:
    geoms = []
    for g in range(model.ngeom):
        b = model.geom_bodyid[g]
        pose = poses[b] @ Pose(model.geom_pos[g].copy(), model.geom_quat[g].copy())
        kind = mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower()
        geoms.append(GeomDef(model.geom(g).name or f"geom{g}", int(carrier[b]), kind, pose, model.geom_size[g].copy()))
    return tuple(geoms)


def _actuators(model: Any, where: str) -> tuple[ActuatorDef, ...]:
    actuators = []
    for a in range(model.nu):
        name = model.actuator(a).name or f"actuator{a}"
        gain, bias = model.actuator_gainprm[a], model.actuator_biasprm[a]
        joint = int(model.actuator_trnid[a, 0])
        plain = (
            model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
            and model.actuator_dyntype[a] == mujoco.mjtDyn.mjDYN_NONE
            and model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
            and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE
        )
        motor = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
        servo = (
            model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
            and bias[0] == 0
            and bias[1] == -gain[0]
            and bias[2] <= 0
            and model.actuator_gear[a, 0] == 1
        )
        if not plain or not (motor or servo):
            raise UsageError(
                f"{where}: actuator {name!r} is of a kind that is not modelled; there are motors and position servos "
                "(gear 1) on slide and hinge joints"
            )
        if model.actuator_ctrllimited[a]:
            raise UsageError(f"{where}: actuator {name!r} has a ctrlrange; controls are not clipped, give forcerange")
        limited = model.actuator_forcelimited[a]
        low, high = model.actuator_forcerange[a] if limited else (-np.inf, np.inf)
        actuators.append(
            ActuatorDef(
                name=name,
                joint=joint,
                kind="motor" if motor else "position",
                gear=float(model.actuator_gear[a, 0] * (gain[0] if motor else 1)),
                kp=0.0 if motor else float(gain[0]),
                kd=0.0 if motor else float(-bias[2]),
                force=(float(low), float(high)),
            )
        )
    return tuple(actuators)
