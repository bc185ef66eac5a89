"""Reference motions of the included scenes: contact is made, slides, sticks, breaks, and is made again.

Controls are smooth functions of time, so that the motion does not depend on the time step. The controls of a step are
those at its end.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene import Scene

Array = NDArray[np.float64]

# The published ball rolling run (paper, appendix B.1): last step of a phase, and the force on the pad during it [N].
PUBLISHED_ROLLING_FORCES = (
    (100, (0.0, 0.0, 0.2)),
    (150, (0.1, 0.0, 0.2)),
    (200, (-0.2, 0.0, 0.2)),
    (250, (0.0, 0.1, 0.2)),
    (350, (0.0, -0.2, 0.2)),
)


@dataclass(frozen=True)
class ReferenceMotion:
    """Start configuration, at rest, and controls over time."""

    q0: Array  # (nq,)
    duration: float  # [s]
    evaluation_time: float  # time of evaluation, while contact is held [s]
    controls: Callable[[ArrayLike], Array]  # times (K,) [s] → u (K, nu)

    def step_controls(self, step: float) -> Array:
        """Controls of all steps of length `step` [s], (steps, nu). Raises UsageError if none fits in the duration."""
        count = round(self.duration / step)
        if count < 1:
            raise UsageError(f"a step of {step} s is longer than the motion, {self.duration} s")
        return self.controls(step * np.arange(1, count + 1))

    def varied(self, amplitude: float, speed: float) -> "ReferenceMotion":
        """The motion with control changes scaled by `amplitude`, `speed` times as fast, for the same duration."""
        rest = self.controls(0.0)

        def controls(times: ArrayLike) -> Array:
            return rest + amplitude * (self.controls(speed * np.asarray(times, float)) - rest)

        return ReferenceMotion(self.q0, self.duration, min(self.evaluation_time / speed, self.duration), controls)


def reference_motion(scene: Scene) -> ReferenceMotion:
    """Reference motion of an included scene. Raises UsageError for another scene."""
    if scene.name not in _MOTIONS:
        raise UsageError(f"scene {scene.name!r} has no reference motion; there are {', '.join(_MOTIONS)}")
    return _MOTIONS[scene.name](scene)


def _ramp(times: ArrayLike, start: float, end: float) -> Array:
    """Smooth ramp from 0 to 1 between two times."""
    x = np.clip((np.asarray(times, float) - start) / (end - start), 0, 1)
    return np.asarray(x * x * (3 - 2 * x))


def _follow(scene: Scene, tracks: dict[str, list[tuple[float, float]]]) -> Callable[[ArrayLike], Array]:
    """Controls with smooth ramps between (time, value) points; actuators without a track have control 0."""

    def controls(times: ArrayLike) -> Array:
        t = np.atleast_1d(np.asarray(times, float))
        u = np.zeros((len(t), scene.nu))
        for name, points in tracks.items():
            column = np.full(len(t), points[0][1])
            for (start, before), (end, after) in pairwise(points):
                column += (after - before) * _ramp(t, start, end)
            u[:, scene.u(name)] = column
        return u

    return controls


def _rolling(scene: Scene) -> ReferenceMotion:
    """The pad descends on the ball, rolls it, lifts off while the ball rolls on, and makes contact again."""
    q0 = scene.q0.copy()
    q0[scene.q("pad_z")] = -0.0145  # 0.5 mm above the ball
    ball = next(b for b in scene.bodies if b.name == "ball")
    ground = next(c for c in scene.contacts if c.name == "ball_ground")
    q0[scene.q("ball").start + 2] += (
        scene.gravity[2] * ball.mass / ground.params["kn"]
    )  # static equilibrium: no bounce at the start
    tracks = {  # the pad weighs 0.245 N
        "pad_z": [(0.0, 0.18), (0.1, 0.16), (0.3, 0.16), (0.34, 0.30), (0.38, 0.30), (0.42, 0.17)],
        "pad_x": [(0.1, 0.0), (0.18, 0.1), (0.26, 0.1), (0.34, 0.04), (0.45, 0.04), (0.55, -0.05)],
        "pad_y": [(0.15, 0.0), (0.25, 0.05), (0.35, 0.0)],
    }
    return ReferenceMotion(q0, 0.64, 0.64, _follow(scene, tracks))


def _pushing(scene: Scene) -> ReferenceMotion:
    """The finger pushes and rotates the box on the ground, retracts, and pushes again."""
    tracks = {
        "gripper_x": [(0.0, 0.3), (0.1, 1.0), (0.3, 0.9), (0.34, -0.6), (0.4, -0.6), (0.44, 0.9)],
        "gripper_y": [(0.1, 0.0), (0.2, 0.3), (0.3, 0.0)],
        "gripper_yaw": [(0.12, 0.0), (0.2, 0.1), (0.3, -0.05), (0.4, 0.0)],
    }
    return ReferenceMotion(scene.q0.copy(), 0.64, 0.28, _follow(scene, tracks))


def _insertion(scene: Scene) -> ReferenceMotion:
    """A grasped part descends on the rim beside its hole, slides, is lifted, inserted, and pressed on a wall."""
    q0, force, lift, shift = scene.q0.copy(), 5.0, 0.5e-3, 4.5e-3
    q0[scene.q("arm_z")] += lift
    q0[scene.q("part").start + 2] += lift
    for joint in ("arm_x", "part"):
        q0[scene.q(joint).start] += shift
    touching = {p.name: p.weights.sum() / 2 for p in scene.points}  # half of a disc's points are on the face
    numbers = {c.points: c.params for c in scene.contacts}
    for finger, pad in (("finger_left", "pad_left"), ("finger_right", "pad_right")):
        q0[scene.q(finger)] += force / (numbers[pad]["kn"] * touching[pad])
    servo = next(a for a in scene.actuators if a.name == "arm_z")
    weight = -scene.gravity[2] * sum(body.mass for body in scene.bodies)
    top = float(q0[scene.q("arm_z")][0]) + weight / servo.kp  # the servo does not sag
    tracks = {
        "finger_left": [(0.0, force)],
        "finger_right": [(0.0, force)],
        "hold_left": [(0.0, q0[scene.q("finger_left").start])],
        "hold_right": [(0.0, q0[scene.q("finger_right").start])],
        "arm_x": [
            (0.0, shift),
            (0.2, shift),
            (0.35, 2.7e-3),
            (0.42, 2.7e-3),
            (0.5, 2.0e-3),
            (0.64, 2.0e-3),
            (0.72, 2.7e-3),
        ],
        "arm_yaw": [(0.3, 0.0), (0.35, 0.01), (0.42, 0.0)],
        "arm_z": [(0.0, top), (0.2, top - 1.6e-3), (0.36, top - 1.6e-3), (0.44, top), (0.48, top), (0.66, top - 3e-3)],
    }
    return ReferenceMotion(q0, 0.8, 0.8, _follow(scene, tracks))


def _grasp(scene: Scene) -> ReferenceMotion:
    """The fingers close on the bar off its middle, lift it, set it down, and open."""
    q0 = scene.q0.copy()
    q0[scene.q("arm_y")] = 0.02
    servo = next(a for a in scene.actuators if a.name == "arm_z")
    q0[scene.q("arm_z")] += scene.gravity[2] * sum(b.mass for b in scene.bodies if b.name != "bar") / servo.kp
    q0[scene.q("bar").start + 2] -= _sag(scene)
    q0[[scene.q("finger_left").start, scene.q("finger_right").start]] = -0.0127
    close = [(0.0, 3.0), (0.1, 10.0), (0.52, 10.0), (0.58, -1.0)]
    tracks = {
        "arm_y": [(0.0, 0.02)],
        "arm_z": [(0.1, 0.06), (0.3, 0.075), (0.34, 0.075), (0.5, 0.056)],
        "finger_left": close,
        "finger_right": close,
    }
    return ReferenceMotion(q0, 0.64, 0.34, _follow(scene, tracks))


def _sag(scene: Scene) -> float:
    """Static penetration of the bar into its tables [m]; without it the bar vibrates during the whole motion."""
    cloud = next(p for p in scene.points if p.name == "bar")
    kn = next(c.params["kn"] for c in scene.contacts if c.points == "bar")
    places, weights = cloud.points + scene.q0[scene.q("bar")][:3], cloud.weights * (cloud.points[:, 2] < 0)
    tables = [s for s in scene.shapes if s.name.startswith("table")]
    resting = sum(weights[(np.abs(places - t.pose.position) <= t.size)[:, :2].all(1)].sum() for t in tables)
    return float(-scene.gravity[2] * scene.bodies[scene.body("bar")].mass / (kn * resting))


def _dclaw(scene: Scene) -> ReferenceMotion:
    """Three fingers close on the cap, rotate it, open, swing back, and close again."""
    q0 = scene.q0.copy()
    start = dict(zip((a.name for a in scene.actuators), q0, strict=False))
    tracks: dict[str, list[tuple[float, float]]] = {}
    for finger in (1, 2, 3):
        bend = start[f"bend{finger}"]
        tracks |= {
            f"swing{finger}": [(0.15, 0.0), (0.35, 0.15), (0.42, 0.15), (0.5, 0.0)],
            f"bend{finger}": [(0.0, bend), (0.15, bend + 0.12), (0.37, bend + 0.12), (0.43, bend), (0.5, bend + 0.1)],
            f"curl{finger}": [(0.0, start[f"curl{finger}"])],
        }
    return ReferenceMotion(q0, 0.64, 0.64, _follow(scene, tracks))


_MOTIONS: dict[str, Callable[[Scene], ReferenceMotion]] = {
    "rolling": _rolling,
    "pushing": _pushing,
    "insertion": _insertion,
    "grasp": _grasp,
    "dclaw": _dclaw,
}
SCENES = tuple(_MOTIONS)
