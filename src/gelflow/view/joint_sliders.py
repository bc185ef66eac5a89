"""Sliders of a page for the positions of joints and the controls of actuators of one environment."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gelflow.sim.scene import Scene
from gelflow.sim.scene.start_controls import start_controls
from gelflow.sim.simulator import Simulator

_SLIDE_RANGE = 0.1  # [m] to both sides of the start, of joints without a range
_FREE_MOTOR = 1.0  # range of a control without limits
_STEPS = 500
_AXES = "xyz"


@dataclass(frozen=True)
class Coordinate:
    """One number that a slider sets: a coordinate of q, or of the rotation of a ball or free joint."""

    label: str
    joint: int
    low: float
    high: float
    q: int = -1  # index in q; -1 for a rotation
    axis: int = -1  # of a rotation vector relative to the start
    quaternion: int = -1  # index in q of the quaternion that it rotates


def coordinates(scene: Scene) -> list[Coordinate]:
    """The coordinates of all joints of a scene, in their order."""
    found = []
    for number, joint in enumerate(scene.joints):
        start = joint.q_start
        if joint.type in ("slide", "hinge"):
            reach, unit = (_SLIDE_RANGE, "m") if joint.type == "slide" else (np.pi, "rad")
            value = float(scene.q0[start])
            low, high = joint.range or (value - reach, value + reach)
            found.append(Coordinate(f"{joint.name} [{unit}]", number, min(low, value), max(high, value), q=start))
            continue
        if joint.type == "free":
            for axis in range(3):
                value = float(scene.q0[start + axis])
                ends = (value - _SLIDE_RANGE, value + _SLIDE_RANGE)
                found.append(Coordinate(f"{joint.name} {_AXES[axis]} [m]", number, *ends, q=start + axis))
        quaternion = start + (3 if joint.type == "free" else 0)
        for axis in range(3):
            label = f"{joint.name} turn {_AXES[axis]} [rad]"
            found.append(Coordinate(label, number, -np.pi, np.pi, axis=axis, quaternion=quaternion))
    return found


def read_coordinate(sim: Simulator, env: int, coordinate: Coordinate) -> float:
    """The present value of a coordinate."""
    if coordinate.q >= 0:
        return float(sim.q[env, coordinate.q])
    return float(_turn(sim, env, coordinate.quaternion)[coordinate.axis])


def write_coordinate(sim: Simulator, env: int, coordinate: Coordinate, value: float) -> None:
    """Set a coordinate; the joint comes to rest, and the environment's history is cleared."""
    joint = sim.scene.joints[coordinate.joint]
    if coordinate.q >= 0:
        sim.q[env, coordinate.q] = value
    else:
        at = coordinate.quaternion
        turn = _turn(sim, env, at)
        turn[coordinate.axis] = value
        rotation = Rotation.from_rotvec(turn) * _rotation(sim.scene.q0[at : at + 4])
        sim.q[env, at : at + 4] = rotation.as_quat(scalar_first=True)
    sim.v[env, joint.v_start : joint.v_start + joint.nv] = 0
    which = np.zeros(sim.num_envs, dtype=bool)
    which[env] = True
    sim.clear_history(which)


def _turn(sim: Simulator, env: int, at: int) -> Any:
    turned = _rotation(sim.q[env, at : at + 4]) * _rotation(sim.scene.q0[at : at + 4]).inv()
    return turned.as_rotvec()


def _rotation(quaternion: Any) -> Rotation:
    return Rotation.from_quat(np.asarray(quaternion, dtype=float), scalar_first=True)


def control_ranges(scene: Scene) -> list[tuple[float, float, float]]:
    """Start, lower and upper end of the slider of each control."""
    ranges = []
    for actuator, start in zip(scene.actuators, start_controls(scene).tolist(), strict=True):
        low, high = actuator.ctrl_range
        reach = _FREE_MOTOR
        if actuator.kind == "position":
            joints = [joint for joint, _ in scene.driven_joints(actuator)]
            reach = _SLIDE_RANGE if all(joint.type == "slide" for joint in joints) else float(np.pi)
        elif actuator.kind in ("motor", "general") and np.isfinite(actuator.force_range).all():
            reach = max(abs(x) for x in actuator.force_range)
        low, high = (low if np.isfinite(low) else start - reach), (high if np.isfinite(high) else start + reach)
        ranges.append((start, min(low, start), max(high, start)))
    return ranges


class Sliders:
    """Sliders in a folder; `changed(number, value)` is called when a person moves one."""

    def __init__(
        self,
        gui: Any,
        title: str,
        rows: list[tuple[str, float, float, float]],
        changed: Callable[[int, float], None],
        *,
        expanded: bool,
    ) -> None:
        self._handles: list[Any] = []
        self._ends: list[tuple[float, float]] = []
        with gui.add_folder(title, expand_by_default=expanded):
            for number, (label, value, low, high) in enumerate(rows):
                step = max((high - low) / _STEPS, 1e-9)
                end = low + step * _STEPS  # rounded: it may be below `high`
                self._ends.append((low, min(high, end)))
                handle = gui.add_slider(label, low, end, step, min(max(value, low), high, end))
                handle.on_update(self._moved(number, changed))
                self._handles.append(handle)

    @staticmethod
    def _moved(number: int, changed: Callable[[int, float], None]) -> Callable[[Any], None]:
        def moved(event: Any) -> None:
            if event.client is not None:  # a person, not `show`
                changed(number, float(event.target.value))

        return moved

    def show(self, values: list[float]) -> None:
        """Show values; those beyond a slider are shown at its end."""
        for handle, value, (low, high) in zip(self._handles, values, self._ends, strict=True):
            shown = min(max(value, low), high)
            if abs(handle.value - shown) > 0.25 * (high - low) / _STEPS:
                handle.value = shown
