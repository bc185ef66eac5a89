"""Actuators of a compiled model, and how joints resist beyond their ranges where the scene does not say.

An actuator pulls with f = gain u + b₀ + b₁ l + b₂ l̇ at the length l = gear × joint position. Motors, servos of position
and of velocity are special cases of it, whatever element of the file they were written as.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.model_file import element_names

INF = float("inf")

LIMIT_TIME = 0.01  # [s] the softest default limit: a joint without motors swings back within π times this
LIMIT_YIELD = {"hinge": 0.01, "slide": 1e-3}  # [rad], [m] how far full motor force gets beyond a range
LIMIT_SERVO = 100.0  # a default limit is so much stiffer than a servo whose force has no bound


@dataclass(frozen=True)
class ActuatorDef:
    name: str
    joint: int
    kind: str  # "motor", "position", "velocity" or "general"
    gear: float
    kp: float  # [N/m] or [N m/rad]
    kd: float  # [N s/m] or [N m s/rad]
    force_range: tuple[float, float]  # what the force is clipped to, before the gear
    ctrl_range: tuple[float, float] = (-INF, INF)  # what the control is clipped to
    gain: float = 1.0  # of a "general" actuator: force = gain u + bias − kp l − kd l̇
    bias: float = 0.0

    def peak_force(self) -> float:
        """The largest force on the joint at rest [N] or [N m]; infinite for a servo whose force is not limited."""
        largest = max(abs(x) for x in self.force_range)
        if not np.isfinite(largest) and self.kp == 0:
            reach = max(abs(x) for x in self.ctrl_range)
            gain = {"velocity": self.kd, "general": self.gain}.get(self.kind, 1.0)
            largest = abs(gain) * reach + abs(self.bias) if gain else abs(self.bias)
        return abs(self.gear) * largest if self.gear else 0.0


def read_actuators(model: Any, where: str) -> tuple[ActuatorDef, ...]:
    """The actuators, all of them on slide and hinge joints. Raises UsageError when force ranges contradict."""
    actuators = []
    for a, name in enumerate(element_names(model, "actuator", len(model.actuator_trntype))):
        gear, gain = float(model.actuator_gear[a, 0]), float(model.actuator_gainprm[a, 0])
        affine = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
        b0, b1, b2 = (float(b) if affine else 0.0 for b in model.actuator_biasprm[a, :3])
        joint = int(model.actuator_trnid[a, 0])
        kind, kp, kd = _kind(gain, b0, b1, b2)
        plain = kind == "general"
        actuators.append(
            ActuatorDef(
                name=name,
                joint=joint,
                kind=kind,
                gear=gear,
                kp=kp,
                kd=kd,
                force_range=_force_range(model, a, gear, joint, f"{where}: actuator {name!r}"),
                ctrl_range=_range(model.actuator_ctrllimited[a], model.actuator_ctrlrange[a]),
                gain=gain if plain else 1.0,
                bias=b0 if plain else 0.0,
            )
        )
    return tuple(actuators)


def _kind(gain: float, b0: float, b1: float, b2: float) -> tuple[str, float, float]:
    """The simplest kind that is this actuator, with its kp and kd."""
    if b0 == b1 == b2 == 0 and gain == 1:
        return "motor", 0.0, 0.0
    if b0 == 0 and gain > 0 and b1 == -gain and b2 <= 0:
        return "position", gain, -b2 + 0.0
    if b0 == 0 and gain > 0 and b1 == 0 and b2 == -gain:
        return "velocity", 0.0, gain
    return "general", -b1 + 0.0, -b2 + 0.0


def _range(limited: Any, bounds: Any) -> tuple[float, float]:
    return (float(bounds[0]), float(bounds[1])) if limited else (-INF, INF)


def _force_range(model: Any, a: int, gear: float, joint: int, who: str) -> tuple[float, float]:
    """The actuator's force range, within what the joint takes (actuatorfrcrange)."""
    low, high = _range(model.actuator_forcelimited[a], model.actuator_forcerange[a])
    if gear != 0 and model.jnt_actfrclimited[joint]:
        ends = sorted(float(end) / gear for end in model.jnt_actfrcrange[joint])
        low, high = max(low, ends[0]), min(high, ends[1])
    if not low < high:
        raise UsageError(f"{who}: its forcerange and the joint's actuatorfrcrange share no force; correct one of them")
    return low, high


def joint_extra(model: Any, joint: int, field: str) -> float:
    """What the actuators add to a joint's "armature" or "damping", gear² times their own (MuJoCo 3.17 and newer)."""
    own = getattr(model, f"actuator_{field}", None)
    if own is None:
        return 0.0
    mine = model.actuator_trnid[:, 0] == joint
    return float((own[mine] * model.actuator_gear[mine, 0] ** 2).sum())


def default_limit(kind: str, inertia: float, actuators: list[ActuatorDef]) -> tuple[float, float]:
    """Stiffness and damping of a range for which the scene gives none.

    kind: "hinge" or "slide"; inertia: what the joint moves at the model's pose [kg m²] or [kg]; actuators: the joint's.
    Stiff relative to the motors (`LIMIT_YIELD`, `LIMIT_SERVO`), at least `inertia` / `LIMIT_TIME`²; critically damped.
    """
    stiffness = inertia / LIMIT_TIME**2
    motors = 0.0
    for actuator in actuators:
        peak = actuator.peak_force()
        motors += (
            peak / LIMIT_YIELD[kind] if np.isfinite(peak) else LIMIT_SERVO * actuator.gear**2 * max(actuator.kp, 0)
        )
    stiffness = max(stiffness, motors)
    return stiffness, 2 * (stiffness * inertia) ** 0.5
