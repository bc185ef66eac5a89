"""Actuators of a compiled model, and the default limits of their joints.

The force of an actuator is f = gain u + b₀ + b₁ l + b₂ l̇ with the length l = gear × joint position. Motors, position
servos and velocity servos are special cases, recognized by their coefficients.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.model_file import element_names

INF = float("inf")

LIMIT_TIME = 0.01  # [s] largest time constant sqrt(inertia / stiffness) of a default limit
LIMIT_DEFLECTION = {"hinge": 0.01, "slide": 1e-3}  # [rad], [m] beyond the range under the full motor force
LIMIT_SERVO_RATIO = 100.0  # stiffness of a default limit over that of a servo without a force limit


@dataclass(frozen=True)
class ActuatorDef:
    """An actuator of a slide joint, a hinge joint or a fixed tendon."""

    name: str
    joint: int  # index of the joint, or -1: on a tendon
    kind: str  # "motor", "position", "velocity" or "general"
    gear: float  # length of the actuator per position of the joint or length of the tendon
    kp: float  # [N/m] or [N m/rad]
    kd: float  # [N s/m] or [N m s/rad]
    force_range: tuple[float, float]  # limits of the force, before the gear [N] or [N m]
    ctrl_range: tuple[float, float] = (-INF, INF)  # limits of the control
    gain: float = 1.0  # of a "general" actuator: force = gain u + bias − kp l − kd l̇
    bias: float = 0.0
    tendon: int = -1  # index of the fixed tendon, or -1: on a joint

    def peak_force(self) -> float:
        """Largest force on the joint or tendon at rest [N] or [N m]; infinite for a servo without a force limit."""
        largest = max(abs(x) for x in self.force_range)
        if not np.isfinite(largest) and self.kp == 0:
            largest_control = max(abs(x) for x in self.ctrl_range)
            gain = {"velocity": self.kd, "general": self.gain}.get(self.kind, 1.0)
            largest = abs(gain) * largest_control + abs(self.bias) if gain else abs(self.bias)
        return abs(self.gear) * largest if self.gear else 0.0


def is_fixed(model: Any, tendon: int) -> bool:
    """Whether a tendon of a compiled model is fixed: a linear combination of joint positions."""
    return bool(model.wrap_type[model.tendon_adr[tendon]] == mujoco.mjtWrap.mjWRAP_JOINT)


def read_actuators(model: Any, where: str) -> tuple[ActuatorDef, ...]:
    """The actuators, on slides, hinges and fixed tendons. Raises UsageError if force ranges are disjoint."""
    actuators = []
    tendons = [t for t in range(model.ntendon) if is_fixed(model, t)]
    for a, name in enumerate(element_names(model, "actuator", len(model.actuator_trntype))):
        gear, gain = float(model.actuator_gear[a, 0]), float(model.actuator_gainprm[a, 0])
        affine = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
        b0, b1, b2 = (float(b) if affine else 0.0 for b in model.actuator_biasprm[a, :3])
        target = int(model.actuator_trnid[a, 0])
        on_tendon = model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON
        kind, kp, kd = _kind(gain, b0, b1, b2)
        general = kind == "general"
        actuators.append(
            ActuatorDef(
                name=name,
                joint=-1 if on_tendon else target,
                tendon=tendons.index(target) if on_tendon else -1,
                kind=kind,
                gear=gear,
                kp=kp,
                kd=kd,
                force_range=_force_range(model, a, gear, f"{where}: actuator {name!r}"),
                ctrl_range=_range(model.actuator_ctrllimited[a], model.actuator_ctrlrange[a]),
                gain=gain if general else 1.0,
                bias=b0 if general else 0.0,
            )
        )
    return tuple(actuators)


def _kind(gain: float, b0: float, b1: float, b2: float) -> tuple[str, float, float]:
    """The most specific kind with these coefficients, kp and kd."""
    if b0 == b1 == b2 == 0 and gain == 1:
        return "motor", 0.0, 0.0
    if b0 == 0 and gain > 0 and b1 == -gain and b2 <= 0:
        return "position", gain, -b2 + 0.0
    if b0 == 0 and gain > 0 and b1 == 0 and b2 == -gain:
        return "velocity", 0.0, gain
    return "general", -b1 + 0.0, -b2 + 0.0


def _range(limited: Any, bounds: Any) -> tuple[float, float]:
    return (float(bounds[0]), float(bounds[1])) if limited else (-INF, INF)


def _force_range(model: Any, a: int, gear: float, location: str) -> tuple[float, float]:
    """The intersection of the force range of the actuator and of its joint or tendon (actuatorfrcrange).

    As in MuJoCo, the range of a joint limits the force on the joint, and that of a tendon the force before the gear.
    """
    low, high = _range(model.actuator_forcelimited[a], model.actuator_forcerange[a])
    what = "tendon" if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_TENDON else "jnt"
    target = int(model.actuator_trnid[a, 0])
    limited = getattr(model, f"{what}_actfrclimited", None)
    if gear != 0 and limited is not None and limited[target]:
        ratio = gear if what == "jnt" else 1.0
        ends = sorted(float(end) / ratio for end in getattr(model, f"{what}_actfrcrange")[target])
        low, high = max(low, ends[0]), min(high, ends[1])
    if not low < high:
        raise UsageError(f"{location}: forcerange and the actuatorfrcrange that it acts on are disjoint; change one")
    return low, high


def actuator_addition(model: Any, kind: str, index: int, field: str) -> float:
    """Contribution of the actuators to "armature" or "damping" of a "joint" or "tendon" (MuJoCo 3.17 and newer).

    It is Σ gear² value.
    """
    values = getattr(model, f"actuator_{field}", None)
    if values is None:
        return 0.0
    on_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    on_target = (model.actuator_trnid[:, 0] == index) & (on_tendon == (kind == "tendon"))
    return float((values[on_target] * model.actuator_gear[on_target, 0] ** 2).sum())


def default_limit(
    kind: str, inertia: float, actuators: Sequence[ActuatorDef], load: float = 0.0
) -> tuple[float, float]:
    """Default stiffness [N/m] or [N m/rad] and damping [N s/m] or [N m s/rad] of a joint beyond its range.

    Parameters
    ----------
    kind: "hinge" or "slide"
    inertia: of the joint at the pose of the model [kg m²] or [kg]
    actuators: of the joint
    load: further force that presses the joint against its limit [N] or [N m]

    The deflection under the full motor force and the load is `LIMIT_DEFLECTION`; a servo without a force limit counts
    with `LIMIT_SERVO_RATIO` times its stiffness. The stiffness is at least inertia / `LIMIT_TIME`², the damping is
    critical.
    """
    motor_stiffness = load / LIMIT_DEFLECTION[kind]
    for actuator in actuators:
        peak = actuator.peak_force()
        if np.isfinite(peak):
            motor_stiffness += peak / LIMIT_DEFLECTION[kind]
        else:
            motor_stiffness += LIMIT_SERVO_RATIO * actuator.gear**2 * max(actuator.kp, 0)
    stiffness = max(inertia / LIMIT_TIME**2, motor_stiffness)
    return stiffness, 2 * (stiffness * inertia) ** 0.5
