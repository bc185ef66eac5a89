"""What model files may hold and the simulator does not model: refused by name, since its absence changes the motion."""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.model_file import element_names

Problem = tuple[str, str]  # what is not modelled, and what to do

# What each <flag> of the file switches off: fields of the model, which become 0.
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

_PULLS = {
    mujoco.mjtTrn.mjTRN_TENDON: "on a tendon",
    mujoco.mjtTrn.mjTRN_SITE: "on a site",
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: "on a slider-crank",
    mujoco.mjtTrn.mjTRN_BODY: "on a body (adhesion)",
}

_TURNING = {int(mujoco.mjtJoint.mjJNT_FREE): "free", int(mujoco.mjtJoint.mjJNT_BALL): "ball"}


def apply_disable_flags(model: Any) -> None:
    """Do what the file's flags say: what is switched off there becomes 0 here."""
    flags = model.opt.disableflags
    for flag, fields in _FLAGS.items():
        if flags & _bit(flag):
            for field in fields:
                if hasattr(model, field):
                    getattr(model, field)[:] = 0
    if flags & _bit("GRAVITY"):
        model.opt.gravity[:] = 0


def check_supported(model: Any, where: str) -> None:
    """Raise UsageError, in one line, when the model holds what is not modelled."""
    problems = [*_elements(model), *_options(model), *_joints(model), *_actuators(model)]
    if not problems:
        return
    (what, advice), *rest = problems
    more = f" (also not modelled: {', '.join(other for other, _ in rest[:5])}{', …' * (len(rest) > 5)})" if rest else ""
    raise UsageError(f"{where}: {what} is not modelled: {advice}{more}")


def not_modelled(model: Any) -> tuple[str, ...]:
    """What the file has besides, that changes no motion here."""
    parts = []
    if model.npair or model.nexclude:
        parts.append(
            f"{model.npair + model.nexclude} contact pairs and excludes: the scene file says what touches what"
        )
    if model.nsensor:
        parts.append(f"{model.nsensor} MuJoCo sensors: the scene file has pads")
    if model.ntendon:
        parts.append(f"{model.ntendon} tendons: nothing pulls on them")
    if model.neq:
        parts.append(f"{model.neq} equality constraints: not active")
    return tuple(parts)


def _bit(flag: str) -> int:
    return int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}", 0))


def _nonzero(model: Any, prefix: str, *fields: str) -> list[int]:
    """Indices of the elements for which any of the fields is not 0; a field that this MuJoCo lacks counts as 0."""
    found: set[int] = set()
    for field in fields:
        if hasattr(model, prefix + field):
            found |= {i for i, value in enumerate(getattr(model, prefix + field)) if np.any(value)}
    return sorted(found)


def _elements(model: Any) -> Iterator[Problem]:
    tendons, bodies = element_names(model, "tendon", model.ntendon), element_names(model, "body", model.nbody)
    pulled = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0].tolist()
    stiff = _nonzero(
        model, "tendon_", "stiffness", "stiffnesspoly", "damping", "dampingpoly", "frictionloss", "limited", "armature"
    )
    for f in range(model.nflex):
        yield f"flex {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, f)!r}", "remove it"
    for t in sorted({*pulled, *stiff}):
        yield f"tendon {tendons[t]!r}", "remove it or drive the joints directly"
    for e in _nonzero(model, "eq_", "active0"):
        yield f"equality {_equality(model, e)}", "remove it, or make it inactive; drive each joint by itself"
    for b, body in enumerate(bodies):
        if model.body_plugin[b] >= 0:
            yield f"plugin of body {body!r}", "remove it"
        if model.body_mocapid[b] >= 0:
            yield f"mocap body {body!r}", 'take mocap="true" away (it then stands still), or remove the body'
        if model.body_gravcomp[b] != 0:
            yield f"gravcomp of body {body!r}", "remove it, or switch gravity off for the whole model"


def _equality(model: Any, e: int) -> str:
    kind = mujoco.mjtEq(model.eq_type[e]).name.removeprefix("mjEQ_").lower()
    if name := model.equality(e).name:
        return f"{kind} {name!r}"
    what = {"joint": "joint", "tendon": "tendon", "connect": "body", "weld": "body"}.get(kind)
    if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
        what = "site"
    ends = [int(i) for i in (model.eq_obj1id[e], model.eq_obj2id[e]) if i >= 0]
    return f"{kind} of {' and '.join(repr(getattr(model, what)(i).name) for i in ends)}" if what else kind


def _options(model: Any) -> Iterator[Problem]:
    for option in ("density", "viscosity", "wind"):
        if np.any(getattr(model.opt, option)):
            yield f"option {option}", "remove it; there is no air or water"
    if model.opt.disableflags & _bit("ACTUATION"):
        yield 'flag actuation="disable"', "remove it; controls of 0 do the same for motors"
    if model.opt.disableactuator:
        yield "option actuatorgroupdisable", "remove it, and the actuators of those groups"


def _joints(model: Any) -> Iterator[Problem]:
    driven = np.bincount(model.actuator_trnid[_on_joint(model), 0], minlength=model.njnt)
    curved = _nonzero(model, "jnt_", "stiffnesspoly"), _nonzero(model, "dof_", "dampingpoly")
    for j, joint in enumerate(element_names(model, "joint", model.njnt)):
        turns = _TURNING.get(int(model.jnt_type[j]))
        if turns == "ball" and model.jnt_limited[j]:
            yield f"range of ball joint {joint!r}", "remove it, or build the joint from three hinges"
        if turns and model.jnt_stiffness[j] != 0:
            yield f"stiffness of {turns} joint {joint!r}", "remove it"
        if j in curved[0]:
            yield f"polynomial stiffness of joint {joint!r}", "give one number"
        if model.jnt_dofadr[j] in curved[1]:
            yield f"polynomial damping of joint {joint!r}", "give one number"
        if model.jnt_actfrclimited[j] and driven[j] > 1:
            yield f"actuatorfrcrange of joint {joint!r}, which {driven[j]} actuators drive,", "give each a forcerange"


def _on_joint(model: Any) -> Any:
    return np.isin(model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def _actuators(model: Any) -> Iterator[Problem]:
    for a, name in enumerate(element_names(model, "actuator", len(model.actuator_trntype))):
        if found := _actuator(model, a):
            yield f"actuator {name!r} {found[0]}", found[1]
    for a in _nonzero(model, "actuator_", "dampingpoly"):
        yield f"polynomial damping of actuator {element_names(model, 'actuator', a + 1)[a]!r}", "give one number"


def _actuator(model: Any, a: int) -> Problem | None:
    kinds = [
        (kind, mujoco_enum(getattr(model, f"actuator_{kind}")[a]).name.split("_", 1)[1].lower())
        for kind, mujoco_enum in (
            ("gaintype", mujoco.mjtGain),
            ("biastype", mujoco.mjtBias),
            ("dyntype", mujoco.mjtDyn),
        )
    ]
    gain, bias, dyn = (value for _, value in kinds)
    servo = "use motor, position, velocity or general on joints"
    if model.actuator_plugin[a] >= 0:
        return "with a plugin", servo
    if gain == "affine" and not model.actuator_gainprm[a, 1:3].any():
        gain = "fixed"  # an affine gain without its slopes
    if gain != "fixed":
        return f"with gaintype {gain}", servo
    if bias not in ("none", "affine"):
        return f"with biastype {bias}", servo
    if dyn != "none":
        return f"with an activation (dyntype {dyn})", "take timeconst or dyntype away"
    trn = model.actuator_trntype[a]
    if not _on_joint(model)[a]:
        return _PULLS.get(mujoco.mjtTrn(trn), "on no joint"), "drive the joints directly"
    joint = int(model.actuator_trnid[a, 0])
    if turns := _TURNING.get(int(model.jnt_type[joint])):
        return f"on {turns} joint {model.joint(joint).name!r}", "drive slide or hinge joints"
    if np.any(getattr(model, "actuator_delay", np.zeros(a + 1))[a]):
        return "with a delay", "remove it"
    return None
