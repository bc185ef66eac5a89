"""Elements of model files that the simulator does not support: an error if they affect the motion, else a notice."""

import itertools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.actuators import is_fixed
from gelflow.sim.scene.mjcf.couplings import tendon_terms
from gelflow.sim.scene.mjcf.model_file import element_names
from gelflow.sim.scene.mjcf.tendon_equalities import unsupported_equality

Unsupported = tuple[str, str]  # element, advice

# Fields of the model that each disable flag sets to 0.
_FLAGS = {
    "SPRING": ("jnt_stiffness", "jnt_stiffnesspoly", "tendon_stiffness", "tendon_stiffnesspoly"),
    "DAMPER": ("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly", "actuator_damping"),
    "LIMIT": ("jnt_limited", "tendon_limited"),
    "FRICTIONLOSS": ("dof_frictionloss", "tendon_frictionloss"),
    "EQUALITY": ("eq_active0",),
    "CLAMPCTRL": ("actuator_ctrllimited",),
}
_FLAGS["PASSIVE"] = _FLAGS["SPRING"] + _FLAGS["DAMPER"]
_FLAGS["CONSTRAINT"] = _FLAGS["LIMIT"] + _FLAGS["FRICTIONLOSS"] + _FLAGS["EQUALITY"]

# Equalities that are modelled.
_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_EQUALITIES = (*map(int, (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)), _TENDON)

_TRANSMISSIONS = {
    mujoco.mjtTrn.mjTRN_TENDON: "on a spatial tendon",
    mujoco.mjtTrn.mjTRN_SITE: "on a site",
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: "on a slider-crank",
    mujoco.mjtTrn.mjTRN_BODY: "on a body (adhesion)",
}

_LOSSES = ("damping", "frictionloss")  # fields of joints and tendons that must not be negative
_ROTATING_JOINTS = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball"}


def apply_disable_flags(model: Any) -> None:
    """Set the fields of the model to 0 that the disable flags of the file switch off."""
    flags = model.opt.disableflags
    for flag, fields in _FLAGS.items():
        if flags & _bit(flag):
            for field in fields:
                if hasattr(model, field):
                    getattr(model, field)[:] = 0
    if flags & _bit("SPRING") and flags & _bit("DAMPER"):  # then MuJoCo computes no passive forces
        model.body_gravcomp[:] = 0
    if flags & _bit("GRAVITY"):
        model.opt.gravity[:] = 0


def check_supported(model: Any, location: str) -> None:
    """Raise UsageError, in one line, if the model has elements that are not supported."""
    unsupported = [*_elements(model), *_options(model), *_joints(model), *_actuators(model)]
    if not unsupported:
        return
    (element, advice), *rest = unsupported
    more = (
        f" (also not supported: {', '.join(other for other, _ in rest[:5])}{', …' * (len(rest) > 5)})" if rest else ""
    )
    raise UsageError(f"{location}: {element} is not supported: {advice}{more}")


def not_modelled(model: Any) -> tuple[str, ...]:
    """Elements of the file that have no effect on the motion, one line each."""
    lines = []
    if pairs := model.npair + model.nexclude:
        lines.append(f"{pairs} contact pairs and excludes: the TOML file defines the contacts")
    if model.nsensor:
        lines.append(f"{model.nsensor} MuJoCo sensors: the TOML file defines the pads")
    if spatial := sum(not is_fixed(model, t) for t in range(model.ntendon)):
        lines.append(f"{spatial} spatial tendons: without force")
    if inactive := model.neq - int(np.count_nonzero(model.eq_active0)):
        lines.append(f"{inactive} equality constraints: not active")
    return tuple(lines)


def _bit(flag: str) -> int:
    return int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0))


def _nonzero(model: Any, prefix: str, *fields: str) -> list[int]:
    """Indices of elements with a field that is not 0; fields that this version of MuJoCo does not have count as 0."""
    indices: set[int] = set()
    for field in fields:
        if hasattr(model, prefix + field):
            indices |= {i for i, value in enumerate(getattr(model, prefix + field)) if np.any(value)}
    return sorted(indices)


def _elements(model: Any) -> Iterator[Unsupported]:
    tendons, bodies = element_names(model, "tendon", model.ntendon), element_names(model, "body", model.nbody)
    actuated = _actuated_tendons(model)
    stiff = _nonzero(
        model, "tendon_", "stiffness", "stiffnesspoly", "damping", "dampingpoly", "frictionloss", "limited", "armature"
    )
    for f in range(model.nflex):
        yield f"flex {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, f)!r}", "remove it"
    for t in sorted({*actuated, *stiff}):
        if not is_fixed(model, t):
            yield f"spatial tendon {tendons[t]!r}", "remove it or drive the joints directly"
    for t in _nonzero(model, "tendon_", "stiffness"):
        low, high = model.tendon_lengthspring[t]
        if low != high:
            yield f"range of springlength of tendon {tendons[t]!r}", "give one length"
    for t in _nonzero(model, "tendon_", "stiffnesspoly", "dampingpoly"):
        yield f"polynomial stiffness or damping of tendon {tendons[t]!r}", "give one coefficient"
    for t, field in itertools.product(range(model.ntendon), _LOSSES):
        if getattr(model, f"tendon_{field}")[t] < 0:
            yield f"negative {field} of tendon {tendons[t]!r}", "give 0 or more"
    for t in _nonzero(model, "tendon_", "actfrclimited"):
        if (count := actuated.count(t)) > 1:
            yield f"actuatorfrcrange of tendon {tendons[t]!r} with {count} actuators", "give each actuator a forcerange"
    for e in _nonzero(model, "eq_", "active0"):
        if model.eq_type[e] not in _EQUALITIES or (model.eq_type[e] == _TENDON and unsupported_equality(model, e)):
            yield f"equality {_equality(model, e)}", "remove it, or make it inactive"
    for b, body in enumerate(bodies):
        if model.body_plugin[b] >= 0:
            yield f"plugin of body {body!r}", "remove it"


def _equality(model: Any, e: int) -> str:
    kind = mujoco.mjtEq(model.eq_type[e]).name.removeprefix("mjEQ_").lower()
    if name := model.equality(e).name:
        return f"{kind} {name!r}"
    target = {"joint": "joint", "tendon": "tendon", "connect": "body", "weld": "body"}.get(kind)
    if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
        target = "site"
    ends = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e]) if i >= 0]
    return f"{kind} of {' and '.join(repr(getattr(model, target)(i).name) for i in ends)}" if target else kind


def _options(model: Any) -> Iterator[Unsupported]:
    for option in ("density", "viscosity", "wind"):
        if np.any(getattr(model.opt, option)):
            yield f"option {option}", "remove it; fluid forces are not simulated"
    if model.opt.disableflags & _bit("ACTUATION"):
        yield 'flag actuation="disable"', "remove it; for motors, controls of 0 have the same effect"
    if model.opt.disableactuator:
        yield "option actuatorgroupdisable", "remove it, and the actuators of those groups"


def _joints(model: Any) -> Iterator[Unsupported]:
    driven = np.bincount(model.actuator_trnid[_on_joint(model), 0], minlength=model.njnt)
    polynomial_stiffness = _nonzero(model, "jnt_", "stiffnesspoly")
    polynomial_damping = _nonzero(model, "dof_", "dampingpoly")
    by_tendon = _driven_by_tendons(model)
    for j, joint in enumerate(element_names(model, "joint", model.njnt)):
        rotating = _ROTATING_JOINTS.get(int(model.jnt_type[j]))
        if rotating == "ball" and model.jnt_limited[j]:
            yield f"range of ball joint {joint!r}", "remove it, or replace the joint by three hinges"
        if rotating and model.jnt_stiffness[j] != 0:
            yield f"stiffness of {rotating} joint {joint!r}", "remove it"
        if j in polynomial_stiffness:
            yield f"polynomial stiffness of joint {joint!r}", "give one coefficient"
        if model.jnt_dofadr[j] in polynomial_damping:
            yield f"polynomial damping of joint {joint!r}", "give one coefficient"
        for field in _LOSSES:
            if getattr(model, f"dof_{field}")[model.jnt_dofadr[j]] < 0:
                yield f"negative {field} of joint {joint!r}", "give 0 or more"
        if model.jnt_actgravcomp[j] and model.jnt_actfrclimited[j]:
            yield f"actuatorgravcomp of joint {joint!r} with an actuatorfrcrange", "remove one of them"
        if model.jnt_actfrclimited[j] and j in by_tendon:
            yield f"actuatorfrcrange of joint {joint!r}, which a tendon drives", "use a forcerange instead"
        if model.jnt_actfrclimited[j] and driven[j] > 1:
            yield f"actuatorfrcrange of joint {joint!r} with {driven[j]} actuators", "give each actuator a forcerange"


def _driven_by_tendons(model: Any) -> set[int]:
    """The joints that actuators drive by fixed tendons."""
    return {j for t in _actuated_tendons(model) if is_fixed(model, t) for j in tendon_terms(model, t)}


def _actuated_tendons(model: Any) -> list[int]:
    """The tendon of each actuator on a tendon."""
    return list(map(int, model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]))


def _on_joint(model: Any) -> Any:
    return np.isin(model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def _actuators(model: Any) -> Iterator[Unsupported]:
    for a, name in enumerate(element_names(model, "actuator", len(model.actuator_trntype))):
        if problem := _actuator(model, a):
            feature, advice = problem
            yield f"actuator {name!r} {feature}", advice
    for a in _nonzero(model, "actuator_", "dampingpoly"):
        yield f"polynomial damping of actuator {element_names(model, 'actuator', a + 1)[a]!r}", "give one coefficient"


def _actuator(model: Any, a: int) -> Unsupported | None:
    kinds = [
        (kind, mujoco_enum(getattr(model, f"actuator_{kind}")[a]).name.split("_", 1)[1].lower())
        for kind, mujoco_enum in (
            ("gaintype", mujoco.mjtGain),
            ("biastype", mujoco.mjtBias),
            ("dyntype", mujoco.mjtDyn),
        )
    ]
    gain, bias, dyn = (value for _, value in kinds)
    advice = "use motor, position, velocity or general on joints"
    if model.actuator_plugin[a] >= 0:
        return "with a plugin", advice
    if gain == "affine" and not model.actuator_gainprm[a, 1:3].any():
        gain = "fixed"  # an affine gain with slopes 0
    if gain != "fixed":
        return f"with gaintype {gain}", advice
    if bias not in ("none", "affine"):
        return f"with biastype {bias}", advice
    if dyn != "none":
        return f"with an activation (dyntype {dyn})", "remove timeconst or dyntype"
    trn = model.actuator_trntype[a]
    if trn == mujoco.mjtTrn.mjTRN_TENDON and is_fixed(model, int(model.actuator_trnid[a, 0])):
        return _delay(model, a)
    if not _on_joint(model)[a]:
        return _TRANSMISSIONS.get(mujoco.mjtTrn(trn), "without a joint"), "drive the joints directly"
    joint = int(model.actuator_trnid[a, 0])
    if rotating := _ROTATING_JOINTS.get(int(model.jnt_type[joint])):
        return f"on {rotating} joint {model.joint(joint).name!r}", "drive slide or hinge joints"
    return _delay(model, a)


def _delay(model: Any, a: int) -> Unsupported | None:
    if np.any(getattr(model, "actuator_delay", np.zeros(a + 1))[a]):
        return "with a delay", "remove it"
    return None
