"""Cap rotation: three fingers turn a cap of unknown position, size and resistance by touch (paper, B.4).

Action (9): change of the commanded joint angles, or with `use_target=False` of the measured ones, from which the next
command then starts; ±1 is `action_scale`. The fingers are position controlled.
Observation: joint angles, fingertip positions; with touch the force, contact and centre of pressure of each fingertip;
and, if the task has them, the commanded minus the measured angles. The last are a sense of touch too, because a servo
lags where its finger is blocked.
Terminated: the cap is turned by `goal_angle` (success), or a fingertip is above the cap. Truncated: after `max_steps`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.drawing.scene_drawing import Polyline
from gelflow.sim.reductions import TactileReduction, pad_forces, pad_pressures
from gelflow.sim.scene import Scene
from gelflow.sim.tasks.control_task import ControlDescription, ControlTask
from gelflow.sim.tasks.randomization import Quantity, Randomization, Uniform
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, SENSOR_QUANTITIES
from gelflow.sim.tasks.task_batch import Array, Mask, SceneOptions, check_options, option_rows

FINGERS = (1, 2, 3)
JOINTS = tuple(f"{joint}{finger}" for finger in FINGERS for joint in ("swing", "bend", "curl"))
TIPS = tuple(f"tip{finger}" for finger in FINGERS)  # names of the pads and of their sites
REWARDS = ("paper", "progress")
# Settings of the oracle. The direction of a finger is that from the centre of the cap to the base of the finger.
_FIRST_TOUCH = 0.3  # angle between the first contact point and the direction of the finger, against the rotation [rad]
_CLEARANCE = 0.004  # gap between fingertip and wall before the first contact [m]
_PRESS = 0.02  # depth of the commanded position inside the wall [m]
_LEAD = 0.02  # distance of the commanded position ahead of the fingertip, along the wall [m]
_TIP_STEP = 0.007  # largest step of the commanded position in a control period [m]
_RESET_OPTIONS = {"center": "x, y of the cap [m]", "radius": "of the cap [m]", "damping": "of the cap [N m s]"}


@dataclass(frozen=True)
class CapRotationTask(ControlDescription):
    """Rotation of a cap by three fingers. Lengths in metres, angles in radians, times in seconds."""

    name: str = "cap"
    touch: bool = True  # the observation has the readings of the fingertips
    commanded: bool = False  # the observation has the commanded minus the measured joint angles
    goal_angle: float = np.pi / 4
    reward: str = "paper"  # "paper", eq. 26, or "progress", see `CapRotationTask.rewards`
    use_target: bool = True  # an action changes the commanded joint angles; False: the measured ones
    action_scale: float = 0.06  # change of the joint angles for an action of ±1
    # Joint angles (swing, bend, curl) of each finger at the start: the fingertips are 122 mm from the axis of the hand,
    # outside of the largest cap at its largest distance from that axis, at half the height of the cap.
    start_angles: tuple[float, float, float] = (0.0, -0.88568, 1.01035)
    contact_force: float = 0.02  # smallest sum of the normal forces of a fingertip in contact [N], above the noise
    # Units of the observation, so that its numbers are near 1.
    length_unit: float = 0.1  # of fingertip positions
    pressure_unit: float = 0.01  # of centres of pressure
    force_unit: float = 1.0  # [N]
    command_unit: float = 0.1  # of differences between commanded and measured angles

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reward not in REWARDS:
            raise UsageError(f"reward must be one of {', '.join(REWARDS)}, got {self.reward!r}")
        self.check_positive("goal_angle", "length_unit", "pressure_unit", "force_unit", "command_unit")
        self.check_not_negative("action_scale", "contact_force")

    @property
    def observation_size(self) -> int:
        """Number of values of an observation."""
        return 18 + (21 if self.touch else 0) + (9 if self.commanded else 0)

    def rewards(self, angle: Array, last_angle: Array, touching: Mask, action: Array, above: Mask) -> Array:
        """Rewards of a control period, shape (N,).

        "paper" is eq. 26. It pays about −2 per period until the cap is turned, so that a policy which does not yet turn
        caps earns more by lifting a finger above the cap at once (−50). "progress" replaces the cost of the remaining
        angle by a gain for the angle turned in the period, and lowers the cost of fingers that do not touch.

        Parameters
        ----------
        angle, last_angle: of the cap after and before the period [rad], (N,)
        touching: fingertips that touch the cap, (N, 3)
        action: in ±1, (N, 9)
        above: a fingertip is above the cap, (N,)
        """
        goal = self.goal_angle
        common = -0.005 * (action**2).sum(1) - 50.0 * above + 50.0 * (angle > goal)
        if self.reward == "paper":
            return np.asarray(common - 0.5 * (~touching).sum(1) - np.minimum(angle - goal, 0) ** 2)
        gained = np.minimum(angle, goal) - np.minimum(last_angle, goal)
        return np.asarray(common - 0.2 * (~touching).sum(1) + 200.0 * gained)


CAP_ROTATION = CapRotationTask()

# Ranges of the paper; its appendix prints a radius of 0.2 to 0.8 m, its released code has 0.02 to 0.08 m.
DEFAULT_RANDOMIZATION = Randomization(
    {
        "center_x": Quantity(Uniform(-0.02, 0.02), "m", "cap's centre from the axis of the hand, along x"),
        "center_y": Quantity(Uniform(-0.02, 0.02), "m", "cap's centre from the axis of the hand, along y"),
        "radius": Quantity(Uniform(0.02, 0.08), "m", "of the cap"),
        "damping": Quantity(Uniform(0.01, 0.7), "N m s", "of the cap's joint"),
        **NO_SENSOR_EFFECTS,
    }
)

# As the default, with the deviations of real pads.
FULL_RANDOMIZATION = Randomization({**DEFAULT_RANDOMIZATION.quantities, **SENSOR_QUANTITIES})
RANDOMIZATIONS = {"default": DEFAULT_RANDOMIZATION, "full": FULL_RANDOMIZATION}


class CapRotation(ControlTask):
    """A batch of hands, each with a cap; see the module.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    randomization: distributions of the cap
    options: of the scene "dclaw" and its simulator, see `SceneOptions`

    Options of `reset`: "center" (2,) [m], "radius" [m] and "damping" [N m s] of the cap. Info, with first axis N:
    "angle" [rad] and "rate" [rad/s] of the cap, "touching" (3) fingertips, "above": a fingertip is above the cap;
    "privileged": centre (2), radius, damping, angle and rate of the cap, in the order and units given here.
    """

    description: CapRotationTask

    def __init__(
        self,
        num_envs: int,
        *,
        task: CapRotationTask = CAP_ROTATION,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
        **options: Unpack[SceneOptions],
    ) -> None:
        super().__init__(task, num_envs, randomization, scene="dclaw", actions=len(JOINTS), privileged=6, **options)
        self._find_indices()
        self._reduction = _fingertip_rows(self.scene)
        self._commanded: Array = np.zeros((num_envs, len(JOINTS)))
        self._action: Array = np.zeros((num_envs, len(JOINTS)))
        self.info |= {
            "angle": np.zeros(num_envs),
            "rate": np.zeros(num_envs),
            "touching": np.zeros((num_envs, len(FINGERS)), dtype=bool),
            "above": np.zeros(num_envs, dtype=bool),
        }
        self.metrics = {"largest rate [rad/s]": np.zeros(num_envs), "turned without touch [°]": np.zeros(num_envs)}

    def _find_indices(self) -> None:
        """Indices, limits and sizes of the scene's elements."""
        scene = self.scene
        self._joint_q = [scene.q(joint).start for joint in JOINTS]
        self._joint_u = [scene.u(joint) for joint in JOINTS]
        ranges = {joint.name: joint.range for joint in scene.joints}
        limits = np.array([ranges[joint] or (-np.inf, np.inf) for joint in JOINTS])
        self._lower, self._upper = limits[:, 0], limits[:, 1]
        self._tip_sites = [scene.site(tip) for tip in TIPS]
        self._cap_q, self._cap_v = scene.q("cap").start, scene.v("cap").start
        cap = next(shape for shape in scene.shapes if shape.name == "cap")
        body = scene.bodies[scene.body("cap")]
        self._top = body.pose.position[2] + cap.pose.position[2] + cap.size[1]
        self._thickness = 2 * cap.size[1]
        self._density = body.mass / (np.pi * cap.size[0] ** 2 * self._thickness)
        self._fingers = [scene.bodies[scene.body(f"finger{finger}")].pose for finger in FINGERS]
        self._link = -scene.bodies[scene.body(TIPS[0])].pose.position[2]  # length of both links of a finger
        self._tip_radius = np.linalg.norm(scene.pads[0].positions - scene.pads[0].pose.position, axis=1).max()

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        check_options(self.description.name, options, _RESET_OPTIONS)
        sim, rows = self.sim, np.flatnonzero(which)
        given = {
            name: option_rows(name, value, which, (2,) if name == "center" else ()) for name, value in options.items()
        }
        drawn = self.randomization.sample(rng, len(rows), friction=self.scene.friction)
        center = given.get("center", np.column_stack([drawn["center_x"], drawn["center_y"]]))
        radius, damping = given.get("radius", drawn["radius"]), given.get("damping", drawn["damping"])
        if (radius <= 0).any() or (damping < 0).any():
            raise UsageError("reset: radius must be above 0, and damping at least 0")
        self._sensors.draw(which, drawn, rng)
        drawn |= {"center_x": center[:, 0], "center_y": center[:, 1], "radius": radius, "damping": damping}
        self._record(which, drawn, self.randomization)
        mass = self._density * np.pi * radius**2 * self._thickness
        across = mass * (3 * radius**2 + self._thickness**2) / 12
        values = {
            "cap.pos.x": center[:, 0],
            "cap.pos.y": center[:, 1],
            "cap.size.x": radius,
            "cap.damping": damping,
            "cap.mass": mass,
            "cap.inertia.xx": across,
            "cap.inertia.yy": across,
            "cap.inertia.zz": mass * radius**2 / 2,
        }
        for name, value in values.items():
            sim.param(name)[rows] = value
        sim.reset(which)
        start = np.tile(self.description.start_angles, len(FINGERS))
        sim.q[np.ix_(rows, self._joint_q)] = start
        self._commanded[rows] = start
        self._action[rows] = 0
        self.info["privileged"][rows, :4] = np.column_stack([center, radius, damping])

    def _controls(self, actions: Array, rng: np.random.Generator, active: Mask) -> Array:
        self._action[active] = actions[active]
        change = self.description.action_scale * actions
        self._commanded[active] = np.clip(self._changed_angles() + change, self._lower, self._upper)[active]
        controls = np.zeros((self.num_envs, self.scene.nu))
        controls[:, self._joint_u] = self._commanded
        return controls

    def _changed_angles(self) -> Array:
        """Joint angles that an action changes, (N, 9)."""
        return self._commanded if self.description.use_target else self.sim.q[:, self._joint_q]

    def _observe(self, active: Mask, rng: np.random.Generator) -> None:
        task, info = self.description, self.info
        tips = self.fingertips()[active]
        readings = touch = self._by_fingertip(self.sim.tactile(active=active, reduction=self._reduction)[active])
        if task.touch and not self._sensors.ideal:
            forces = self.sim.tactile(active=active)[active]
            forces = self._sensors.read(forces, active, rng, interval=task.control_period)
            readings = self._by_fingertip(self._reduction(forces))
        last_angle, last_touching = info["angle"].copy(), np.asarray(info["touching"].any(1))
        info["angle"][active] = self.sim.q[active, self._cap_q]
        info["rate"][active] = self.sim.v[active, self._cap_v]
        info["touching"][active] = touch[..., 3] > 0
        self._add_metrics(active, last_angle, last_touching)
        info["above"][active] = (tips[..., 2] > self._top).any(1)
        info["privileged"][active, 4] = info["angle"][active]
        info["privileged"][active, 5] = info["rate"][active]
        info["success"][active] = (info["angle"] > task.goal_angle)[active]
        rewards = task.rewards(info["angle"], last_angle, info["touching"], self._action, info["above"])
        self.reward[active] = rewards[active]
        self.terminated[active] = (info["success"] | info["above"])[active]
        self.observation[active] = self._observation(active, tips, readings)

    def _add_metrics(self, active: Mask, last_angle: Array, last_touching: Mask) -> None:
        """Largest rate of the cap, and its rotation in periods that begin and end without touch: a thrown cap."""
        rate, coasted = self.metrics.values()
        info = self.info
        started = active & (info["steps"] == 0)
        rate[active] = np.maximum(rate, np.abs(info["rate"]))[active]
        free = active & ~last_touching & ~info["touching"].any(1)
        coasted[free] += np.degrees(np.abs(info["angle"] - last_angle))[free]
        rate[started] = coasted[started] = 0

    def _observation(self, active: Mask, tips: Array, readings: Array) -> Array:
        """Observations of the environments `active` (n): fingertips (n, 3, 3) [m], readings (n, 3, 7)."""
        task = self.description
        measured = self.sim.q[active][:, self._joint_q]
        parts = [measured, tips.reshape(len(tips), -1) / task.length_unit]
        if task.touch:
            force, pressure, moment = readings[..., :3], readings[..., 3:4], readings[..., 4:]
            center = moment / np.maximum(pressure, task.contact_force)
            readouts = [force / task.force_unit, pressure > task.contact_force, center / task.pressure_unit]
            parts.append(np.concatenate(readouts, axis=2).reshape(len(tips), -1))
        if task.commanded:
            parts.append((self._commanded[active] - measured) / task.command_unit)
        return np.concatenate(parts, axis=1)

    def fingertips(self) -> Array:
        """Positions of the fingertips in the world, (N, 3, 3) [m]."""
        return np.asarray(self.sim.site_poses()[:, self._tip_sites, :3])

    @staticmethod
    def _by_fingertip(rows: Array) -> Array:
        """Rows (n, 21) of `_fingertip_rows` as (n, 3, 7)."""
        return rows.reshape(len(rows), len(TIPS), -1)

    def oracle(self) -> Array:
        """Actions of a hand that knows centre and radius of the cap: its fingertips close on it and push along it.

        Each fingertip first goes to a point beside the wall. Then its commanded position is inside of the wall and
        ahead of the fingertip, so that the servo presses and pushes. Where actions change the measured angles a
        fingertip presses less, and caps that are small and hard to turn remain.
        """
        task, privileged = self.description, self.info["privileged"]
        center, radius = privileged[:, None, :2], privileged[:, None, 2]
        base = np.array([finger.position for finger in self._fingers])
        middle = np.full((self.num_envs, len(FINGERS), 1), self._top - self._thickness / 2)
        outward = base[:, :2] - center
        first = np.arctan2(outward[..., 1], outward[..., 0]) - _FIRST_TOUCH
        wall = radius + self._tip_radius

        def beside(direction: Array, distance: Array, ahead: float) -> Array:
            cos, sin = np.cos(direction)[..., None], np.sin(direction)[..., None]
            out, along = np.concatenate([cos, sin], axis=2), np.concatenate([-sin, cos], axis=2)
            return np.concatenate([center + distance[..., None] * out + ahead * along, middle], axis=2)

        start = self._tips(np.tile(task.start_angles, (1, len(FINGERS))))
        clear = beside(first, wall + _CLEARANCE, 0.0)
        periods = np.ceil(np.linalg.norm(clear - start, axis=2).max(1) / _TIP_STEP) + 1
        closing = (self.info["steps"] < periods)[:, None, None]
        reached = self.fingertips()[..., :2] - center
        direction = np.arctan2(reached[..., 1], reached[..., 0])
        target = np.where(closing, clear, beside(direction, wall - _PRESS, _LEAD))
        commanded = self._tips(self._commanded)
        step = target - commanded
        step *= np.minimum(1, _TIP_STEP / np.maximum(np.linalg.norm(step, axis=2, keepdims=True), 1e-9))
        change = self._joint_angles(commanded + step) - self._changed_angles()
        actions = change.reshape(self.num_envs, len(FINGERS), -1) / task.action_scale
        actions /= np.maximum(np.abs(actions).max(2, keepdims=True), 1)  # a finger keeps its direction
        return np.asarray(actions.reshape(self.num_envs, -1))

    def _tips(self, angles: Array) -> Array:
        """Positions (n, 3, 3) [m] of the fingertips at joint angles (n, 9)."""
        swing, bend, curl = np.moveaxis(angles.reshape(len(angles), len(FINGERS), 3), 2, 0)
        x = -self._link * (np.sin(bend) + np.sin(bend + curl))
        down = self._link * (np.cos(bend) + np.cos(bend + curl))
        local = np.stack([x, down * np.sin(swing), -down * np.cos(swing)], axis=2)
        return np.stack([pose.apply(local[:, i]) for i, pose in enumerate(self._fingers)], axis=1)

    def _joint_angles(self, tips: Array) -> Array:
        """Joint angles (n, 9) at which the fingertips are at `tips` (n, 3, 3) [m]; the inverse of `_tips`."""
        x, y, z = np.stack([pose.inverse().apply(tips[:, i]) for i, pose in enumerate(self._fingers)], axis=1).T
        down = np.hypot(y, z)
        half = np.arccos(np.clip(np.hypot(x, down) / (2 * self._link), 0, 1))
        return np.stack([np.arctan2(y, -z), np.arctan2(-x, down) - half, 2 * half]).T.reshape(len(tips), -1)

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A picture of environment `index`; a dashed line on the cap shows its rotation."""
        from gelflow.sim.drawing.renderer import render  # deferred: a policy in training draws nothing

        x, y, radius = (float(self.sim.param(f"cap.{name}")[index]) for name in ("pos.x", "pos.y", "size.x"))
        angle = float(self.info["angle"][index])
        ends = [(x, y), (x + radius * np.cos(angle), y + radius * np.sin(angle))]
        polyline = Polyline(np.array([(*end, self._top) for end in ends]), "cap")
        goal = np.degrees(self.description.goal_angle)
        title = f"Cap rotation: turned {np.degrees(angle):.0f}° of {goal:.0f}°"
        return render(self.sim, index, title=title, polylines=[polyline])


def _fingertip_rows(scene: Scene) -> TactileReduction:
    """Force (3) [N], sum of the normal forces (1) [N] and its first moment (3) [N m] of each fingertip."""
    parts = [part(scene, [tip]) for tip in TIPS for part in (pad_forces, pad_pressures)]
    return TactileReduction.concatenate(parts)
