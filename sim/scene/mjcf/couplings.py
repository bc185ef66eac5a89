"""Couplings of a compiled model: joint equalities, fixed tendons, and loop closures (connect and weld)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from gelflow.geometry import Pose, conjugate, multiply
from gelflow.sim.scene.mjcf.actuators import ActuatorDef, actuator_addition, default_limit, is_fixed
from gelflow.sim.scene.mjcf.model_file import element_names

Array = NDArray[np.float64]

# Compliance of what a damped spring keeps: of loop closures, and of joint equalities above degree 1.
STIFFNESS = {"slide": 1e7, "hinge": 1e4}  # [N/m], [N m/rad]
RELAXATION = 1e-3  # time constant of the springs, damping over stiffness [s]


@dataclass(frozen=True)
class TendonDef:
    """A fixed tendon: its length is the sum of coefficient × position over slides and hinges."""

    name: str
    joints: tuple[int, ...]  # indices
    coefficients: tuple[float, ...]  # one per joint
    damping: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    springref: float = 0.0  # length of zero spring force
    range: tuple[float, float] | None = None
    limit: tuple[float, float] = (0.0, 0.0)  # stiffness and damping beyond the range
    frictionloss: float = 0.0  # dry friction along the tendon


@dataclass(frozen=True)
class CouplingDef:
    """A slide or hinge whose position is a polynomial of that of another one.

    Up to degree 1 the coupling is exact, above it is kept by a damped spring.
    """

    name: str
    joint: int  # index of the joint that follows
    leader: int  # index, or -1: the position is fixed
    coefficients: tuple[float, ...]  # of the powers 0, 1, … of the leader's position
    kind: str = "hinge"  # of the joint that follows


@dataclass(frozen=True)
class LoopClosureDef:
    """Two points of two bodies that coincide; of a weld also the orientations of the bodies. Kept by damped springs."""

    name: str
    bodies: tuple[int, int]  # indices of moving bodies, or WORLD
    points: tuple[Array, Array]  # in the frames of the bodies [m]
    weld: bool = False
    quaternion: Array | None = None  # of a weld: the first body in the frame of the second


def read_tendons(model: Any, actuators: Sequence[ActuatorDef]) -> tuple[TendonDef, ...]:
    """The fixed tendons, in their order; others have no effect (`unsupported.check_supported`)."""
    tendons: list[TendonDef] = []
    for t, name in enumerate(element_names(model, "tendon", model.ntendon)):
        if not is_fixed(model, t):
            continue
        terms = tendon_terms(model, t)
        limited = bool(model.tendon_limited[t])
        hinges = any(joint_kind(model, j) == "hinge" for j in terms)
        inertia = 1 / max(float(model.tendon_invweight0[t]), 1e-9)
        driving = [a for a in actuators if a.tendon == len(tendons)]
        tendons.append(
            TendonDef(
                name=name,
                joints=tuple(terms),
                coefficients=tuple(terms.values()),
                damping=float(model.tendon_damping[t]) + actuator_addition(model, "tendon", t, "damping"),
                armature=_field(model, "tendon_armature", t) + actuator_addition(model, "tendon", t, "armature"),
                stiffness=float(model.tendon_stiffness[t]),
                springref=float(model.tendon_lengthspring[t, 0]),
                range=(float(model.tendon_range[t, 0]), float(model.tendon_range[t, 1])) if limited else None,
                limit=default_limit("hinge" if hinges else "slide", inertia, driving) if limited else (0.0, 0.0),
                frictionloss=float(model.tendon_frictionloss[t]),
            )
        )
    return tuple(tendons)


def read_couplings(model: Any) -> tuple[CouplingDef, ...]:
    """The active joint equalities: q₁ = q₁⁰ + P(q₂ − q₂⁰) with the positions q⁰ of the file."""
    couplings = []
    for e, name in active_equalities(model, (mujoco.mjtEq.mjEQ_JOINT,)):
        joint, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if leader < 0:
            coefficients = np.array([model.eq_data[e, 0]])
        else:
            deviation = Polynomial([-model.qpos0[model.jnt_qposadr[leader]], 1.0])
            coefficients = Polynomial(model.eq_data[e, :5])(deviation).coef
        coefficients[0] += model.qpos0[model.jnt_qposadr[joint]]
        coefficients = np.trim_zeros(coefficients, "b")
        couplings.append(CouplingDef(name, joint, leader, tuple(coefficients.tolist()), joint_kind(model, joint)))
    return tuple(couplings)


def read_loop_closures(model: Any, moving_body: NDArray[np.int64], poses: Sequence[Pose]) -> tuple[LoopClosureDef, ...]:
    """The active connect and weld equalities between moving bodies; `moving_body` and `poses` of each body."""
    closures = []
    for e, name in active_equalities(model, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)):
        weld = model.eq_type[e] == mujoco.mjtEq.mjEQ_WELD
        data = model.eq_data[e]
        members = _bodies(model, e)
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            sites = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))
            frames = [Pose(model.site_pos[s].copy(), model.site_quat[s].copy()) for s in sites]
        else:
            # Of a weld the file gives the point of the second body first, and the pose of the second body in the first.
            first, second = (data[3:6], data[:3]) if weld else (data[:3], data[3:6])
            frames = [Pose(first.copy(), data[6:10].copy()) if weld else Pose(first.copy()), Pose(second.copy())]
        first, second = (poses[b] @ frame for b, frame in zip(members, frames, strict=True))
        bodies = int(moving_body[members[0]]), int(moving_body[members[1]])
        if bodies[0] == bodies[1]:
            continue  # fixed to each other already
        turn = np.array(multiply(second.quaternion, conjugate(first.quaternion)))
        keeps_turn = weld and data[10] != 0  # torquescale; with 0 a weld keeps the points together only, as a connect
        points = (first.position, second.position)
        closures.append(LoopClosureDef(name, bodies, points, keeps_turn, turn if keeps_turn else None))
    return tuple(closures)


def loop_joints(model: Any) -> set[int]:
    """The joints of the closed loops: those that move one of the two bodies of a loop closure and not the other."""
    found: set[int] = set()
    for e, _ in active_equalities(model, (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)):
        first, second = (_moving_joints(model, b) for b in _bodies(model, e))
        found |= first ^ second
    return found


def _bodies(model: Any, e: int) -> tuple[int, int]:
    """The two bodies of a connect or weld, which may be given by sites."""
    first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
    if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, second


def _moving_joints(model: Any, body: int) -> set[int]:
    joints: set[int] = set()
    while body:
        joints.update(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    return joints


def driving_actuators(actuators: Sequence[ActuatorDef], tendons: Sequence[TendonDef], joint: int) -> list[ActuatorDef]:
    """The actuators that drive a joint, directly or by a tendon, with the gear to the joint."""
    driving = []
    for a in actuators:
        if a.joint == joint:
            driving.append(a)
        elif a.tendon >= 0:
            tendon = tendons[a.tendon]
            pairs = zip(tendon.joints, tendon.coefficients, strict=True)
            driving += [replace(a, gear=a.gear * c) for j, c in pairs if j == joint]
    return driving


def tendon_terms(model: Any, tendon: int) -> dict[int, float]:
    """The coefficient of each joint in the length of a fixed tendon."""
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    terms: dict[int, float] = {}
    for i in range(first, first + count):
        joint = int(model.wrap_objid[i])
        terms[joint] = terms.get(joint, 0.0) + float(model.wrap_prm[i])
    return terms


def joint_kind(model: Any, joint: int) -> str:
    """`slide` or `hinge`."""
    return "slide" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge"


def active_equalities(model: Any, kinds: Sequence[int]) -> list[tuple[int, str]]:
    """Index and name of each active equality of these kinds (mujoco.mjtEq)."""
    names = element_names(model, "equality", model.neq)
    wanted = [int(kind) for kind in kinds]
    return [(e, names[e]) for e in range(model.neq) if model.eq_active0[e] and int(model.eq_type[e]) in wanted]


def _field(model: Any, name: str, index: int) -> float:
    """A field that older versions of MuJoCo do not have."""
    return float(getattr(model, name)[index]) if hasattr(model, name) else 0.0
