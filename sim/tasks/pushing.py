"""Box pushing: a finger pushes a box on the ground to a goal position and orientation (paper, B.3).

Action (3): force of the gripper along its x and y and torque about z, ±1 is `action_scale`.
Observation: the goal in the finger's frame; then, by `PushingTask.observation`, the marker forces of the pad
("tactile"), the pose, size and mass of the box ("privileged"), or nothing ("none").
An episode has `max_steps` control periods; success is a box within the tolerances of its goal.

The functions of reward, observation and controls work on NumPy arrays and on torch tensors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.drawing.scene_drawing import Polyline
from gelflow.sim.tasks.control_task import ControlDescription, ControlTask
from gelflow.sim.tasks.randomization import Fixed, Quantity, Randomization
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, SENSOR_QUANTITIES
from gelflow.sim.tasks.task_batch import Array, Mask, SceneOptions, check_options, option_rows

OBSERVATIONS = ("tactile", "privileged", "none")
_BODIES = ("gripper", "box")
_ACTUATORS = ("gripper_x", "gripper_y", "gripper_yaw", "box_x", "box_y", "box_z")
_RESET_OPTIONS = {
    "goal": "x [m], y [m], yaw [rad] of the box",
    "offset": "of the box along the finger [m]",
    "half_size": "x, y of the box [m]",
    "mass": "of the box [kg]",
}
_START_UNITS = {"goal_x": "m", "goal_y": "m", "goal_yaw": "rad", "offset": "m"}  # drawn beside the randomization


@dataclass(frozen=True)
class PushingTask(ControlDescription):
    """Pushing of a box by one finger. Lengths in metres, angles in radians, times in seconds."""

    name: str = "pushing"
    observation: str = "tactile"  # "tactile", "privileged" or "none"
    history: int = 1  # number of the latest observations that an observation holds, the present one first
    grid: Grid = Grid(rows=13, cols=10, pitch=1.5, center=(2.0, 0.0))  # of the markers [mm]
    # Force and torque for an action of ±1, the limits of the actuators.
    action_scale: tuple[float, float, float] = (1.0, 1.0, 3.0)  # [N, N, N m]
    goal_x: tuple[float, float] = (0.15, 0.25)
    goal_y: tuple[float, float] = (-0.2, 0.2)
    goal_yaw_per_y: float = np.pi  # [rad/m]
    goal_yaw_spread: float = np.pi / 16
    start_offset: float = 0.02  # largest offset of the box along the finger
    # Largest x and y of the external force on the box [N], which changes every `force_period` and is zero with
    # probability `no_force`. The paper prints ±1 N, more than the friction of this box holds (0.8 × 0.735 N = 0.59 N),
    # so that boxes slide away without a push; its released data has 0.2 N, and no force half of the time.
    force: float = 0.2
    force_period: float = 0.25
    no_force: float = 0.5
    position_tolerance: float = 0.01  # of success, and unit of the reward's position error (eq. 25b)
    yaw_tolerance: float = np.pi / 36  # of success, and unit of the reward's orientation error (eq. 25c)
    touch_distance: float = 0.02  # unit of the reward's distance of finger and box (eq. 25d)
    # Units of the observation, so that its numbers are near 1.
    goal_unit: float = 0.1
    yaw_unit: float = 0.5
    # Of marker forces [N]: ten times their usual size, so that feedback through the stiff contact is gentle at first.
    marker_unit: float = 0.1
    box_unit: float = 0.02  # of positions and sizes of the box
    mass_unit: float = 0.1  # [kg]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.observation not in OBSERVATIONS:
            raise UsageError(f"observation must be one of {', '.join(OBSERVATIONS)}, got {self.observation!r}")
        if self.history < 1:
            raise UsageError(f"history must be at least 1, got {self.history}")
        self.check_ordered("goal_x", "goal_y")
        self.check_positive("force_period", "position_tolerance", "yaw_tolerance", "touch_distance")
        self.check_positive("goal_unit", "yaw_unit", "marker_unit", "box_unit", "mass_unit")
        self.check_not_negative("action_scale", "goal_yaw_spread", "start_offset", "force", "no_force")

    @property
    def frame_size(self) -> int:
        """Number of values of one frame of the observation."""
        return 3 + {"tactile": 3 * self.grid.rows * self.grid.cols, "privileged": 6, "none": 0}[self.observation]

    @property
    def observation_size(self) -> int:
        """Number of values of an observation."""
        return self.history * self.frame_size

    def reward(self, state: "PushingState", action: Any) -> Any:
        """Reward of a control period (eq. 25), shape (N,), for actions (N, 3) in ±1."""
        position, yaw = state.goal_error()
        return (
            -0.01 * position / self.position_tolerance**2
            - 0.1 * (yaw / self.yaw_tolerance) ** 2
            - state.squared_gap() / self.touch_distance**2
            - 0.1 * (action**2).sum(1)
        )


PUSHING = PushingTask()

# The box of the paper.
DEFAULT_RANDOMIZATION = Randomization(
    {
        "half_size_x": Quantity(Fixed(0.025), "m", "half size of the box along its x, away from the finger"),
        "half_size_y": Quantity(Fixed(0.025), "m", "half size of the box along its y"),
        "mass": Quantity(Fixed(0.075), "kg", "of the box"),
        "ground_mu": Quantity(Fixed(0.8), "", "friction of box and ground"),
        **NO_SENSOR_EFFECTS,
    }
)
# Boxes of other sizes, masses and friction.
BOXES = DEFAULT_RANDOMIZATION.replace(
    half_size_x=(0.02, 0.035), half_size_y=(0.02, 0.035), mass=(0.05, 0.1), ground_mu=(0.6, 0.9)
)
# As `BOXES`, with the deviations of real pads.
FULL_RANDOMIZATION = Randomization({**BOXES.quantities, **SENSOR_QUANTITIES})
RANDOMIZATIONS = {"default": DEFAULT_RANDOMIZATION, "boxes": BOXES, "full": FULL_RANDOMIZATION}


@dataclass(frozen=True)
class PushingState:
    """Poses in the plane and marker forces of N environments; NumPy arrays or torch tensors."""

    finger: Any  # x, y of the pad's centre [m] and its yaw [rad], (N, 3)
    box: Any  # x, y [m], yaw [rad], (N, 3)
    goal: Any  # of the box, as `box`
    half_size: Any  # of the box along its x and y [m], (N, 2)
    mass: Any  # of the box [kg], (N,)
    forces: Any  # of the markers: shear x, shear y, normal [N], (N, markers, 3)

    def goal_error(self) -> tuple[Any, Any]:
        """Squared distance of the box to the goal [m²] and difference of their yaw angles [rad], (N,) each."""
        error = self.box - self.goal
        return (error[:, :2] ** 2).sum(1), error[:, 2]

    def squared_gap(self) -> Any:
        """Squared distance of the pad's centre to the centre of the closest side of the box [m²], (N,)."""
        xp = _namespace(self.box)
        at = self._seen_from(self.box, self.finger)
        x, y = at[:, 0], at[:, 1]
        half_x, half_y = self.half_size[:, 0], self.half_size[:, 1]
        beside_x = (abs(x) - half_x) ** 2 + y**2
        beside_y = x**2 + (abs(y) - half_y) ** 2
        return xp.minimum(beside_x, beside_y)

    def frame(self, task: PushingTask) -> Any:
        """One frame of the observation, (N, task.frame_size)."""
        xp = _namespace(self.box)
        goal = self._seen_from(self.finger, self.goal)
        parts = [goal[:, :2] / task.goal_unit, goal[:, 2:] / task.yaw_unit]
        if task.observation == "tactile":
            flat = self.forces.swapaxes(1, 2).reshape(len(goal), -1)
            parts.append(flat / task.marker_unit)
        if task.observation == "privileged":
            parts.append(self.privileged(task))
        return xp.concatenate(parts, axis=1)

    def privileged(self, task: PushingTask) -> Any:
        """Pose of the box in the finger's frame, half sizes and mass of the box, in the task's units, (N, 6)."""
        xp = _namespace(self.box)
        box = self._seen_from(self.finger, self.box)
        box = [box[:, :2] / task.box_unit, box[:, 2:] / task.yaw_unit]
        return xp.concatenate([*box, self.half_size / task.box_unit, self.mass[:, None] / task.mass_unit], axis=1)

    @staticmethod
    def _seen_from(frame: Any, pose: Any) -> Any:
        """A pose in the plane, expressed in the frame of another one; (N, 3) each."""
        xp = _namespace(frame)
        x, y, yaw = pose[:, 0] - frame[:, 0], pose[:, 1] - frame[:, 1], pose[:, 2] - frame[:, 2]
        cos, sin = xp.cos(frame[:, 2]), xp.sin(frame[:, 2])
        return xp.stack([cos * x + sin * y, cos * y - sin * x, yaw], axis=1)


def stacked(frames: Any, frame: Any) -> Any:
    """Frames (N, history, size) with the new `frame` (N, size) first and without the oldest one."""
    xp = _namespace(frames)
    return xp.concatenate([frame[:, None], frames[:, :-1]], axis=1)


def _namespace(array: Any) -> Any:
    """The module whose functions take this array: numpy or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch  # deferred: only tensors need it

    return torch


class Pushing(ControlTask):
    """A batch of fingers, each with a box; see the module.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    randomization: distributions of the box
    options: of the scene "pushing" and its simulator, see `SceneOptions`

    Options of `reset`: "goal" (3,) x, y [m] and yaw [rad] of the box; "offset" [m] of the box along the finger;
    "half_size" (2,) [m] and "mass" [kg] of the box. Info, with first axis N: "position_error" [m] and "yaw_error" [rad]
    of the box; "privileged" as in the observation of that name.
    """

    description: PushingTask

    def __init__(
        self,
        num_envs: int,
        *,
        task: PushingTask = PUSHING,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
        **options: Unpack[SceneOptions],
    ) -> None:
        super().__init__(task, num_envs, randomization, scene="pushing", actions=3, privileged=6, **options)
        if self.scene.grids != (task.grid,):
            raise UsageError(f"the scene's pad must have the task's markers {task.grid}, got {self.scene.grids}")
        self._find_indices()
        periods = -(-task.max_steps // self._steps_per_force)
        self.goal: Array = np.zeros((num_envs, 3))
        self.half_size: Array = np.zeros((num_envs, 2))
        self.mass: Array = np.zeros(num_envs)
        self._external_force: Array = np.zeros((num_envs, periods, 2))
        self._action: Array = np.zeros((num_envs, 3))
        self.frames: Array = np.zeros((num_envs, task.history, task.frame_size))
        self.info |= {"position_error": np.zeros(num_envs), "yaw_error": np.zeros(num_envs)}
        self.metrics = {"position error [mm]": np.zeros(num_envs), "yaw error [°]": np.zeros(num_envs)}

    def _find_indices(self) -> None:
        """Indices and sizes of the scene's elements."""
        scene, task = self.scene, self.description
        self._finger_q = [scene.q(joint).start for joint in ("gripper_x", "gripper_y", "gripper_yaw")]
        self._box_q = [scene.q(joint).start for joint in ("box_x", "box_y", "box_yaw")]
        # Column of the controls of `_ACTUATORS` for each actuator of the scene.
        self._order = np.argsort([scene.u(name) for name in _ACTUATORS])
        limits = tuple(float(self.sim.param(f"{name}.force_upper")[0]) for name in _ACTUATORS[:3])
        if any(scale > limit for scale, limit in zip(task.action_scale, limits, strict=True)):
            raise UsageError(
                f"action_scale must be within the limits of the actuators {limits}, got {task.action_scale}"
            )
        self._gripper_base, self._box_base = (scene.bodies[scene.body(name)].pose.position for name in _BODIES)
        self._pad_center = scene.pads[0].pose.position  # in the frame of the gripper
        box = next(shape for shape in scene.shapes if shape.name == "box")
        self._half_size, self._half_height = box.size[:2], float(box.size[2])
        self._steps_per_force = max(1, round(task.force_period / task.control_period))

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        task, rows = self.description, np.flatnonzero(which)
        check_options(task.name, options, _RESET_OPTIONS)
        shapes = {"goal": (3,), "half_size": (2,)}
        given = {name: option_rows(name, value, which, shapes.get(name, ())) for name, value in options.items()}
        drawn = self.randomization.sample(rng, len(rows), friction=self.scene.friction)
        half_size = given.get("half_size", np.column_stack([drawn["half_size_x"], drawn["half_size_y"]]))
        mass = given.get("mass", drawn["mass"])
        if (half_size <= 0).any() or (mass <= 0).any():
            raise UsageError("reset: half_size and mass must be above 0")
        self._sensors.draw(which, drawn, rng)
        self.sim.param("box_ground.mu")[rows] = drawn["ground_mu"]
        y = rng.uniform(*task.goal_y, len(rows))
        yaw = task.goal_yaw_per_y * y + rng.uniform(-task.goal_yaw_spread, task.goal_yaw_spread, len(rows))
        values = {
            "goal": np.column_stack([rng.uniform(*task.goal_x, len(rows)), y, yaw]),
            "offset": rng.uniform(-task.start_offset, task.start_offset, len(rows)),
        } | given
        drawn |= dict(zip(_START_UNITS, (*values["goal"].T, values["offset"]), strict=True))
        drawn |= {"half_size_x": half_size[:, 0], "half_size_y": half_size[:, 1], "mass": mass}
        self._record(which, drawn, self.randomization, **_START_UNITS)
        periods = self._external_force.shape[1]
        force = rng.uniform(-task.force, task.force, (len(rows), periods, 2))
        self._external_force[rows] = force * (rng.random((len(rows), periods, 1)) >= task.no_force)
        self.goal[rows], self.half_size[rows], self.mass[rows] = values["goal"], half_size, mass
        self._action[rows] = 0
        self._set_box(rows)
        self.sim.reset(which)
        # The side of a box of any size is at the same distance from the finger.
        self.sim.q[rows, self._box_q[0]] += half_size[:, 0] - self._half_size[0]
        self.sim.q[rows, self._box_q[1]] = values["offset"]

    def _set_box(self, rows: NDArray[np.int64]) -> None:
        """Parameters of the boxes in the environments `rows`."""
        param = self.sim.param
        for axis, half, own in zip("xy", self.half_size[rows].T, self._half_size, strict=True):
            param(f"box.size.{axis}")[rows] = half
            param(f"box.points.scale.{axis}")[rows] = half / own
        param("box.mass")[rows] = self.mass[rows]
        squares = np.column_stack([self.half_size[rows], np.full(len(rows), self._half_height)]) ** 2
        for k, axis in enumerate("xyz"):
            param(f"box.inertia.{axis}{axis}")[rows] = self.mass[rows] * (squares.sum(1) - squares[:, k]) / 3

    def controls(self, actions: Any, steps: NDArray[np.int64]) -> Any:
        """Controls (N, nu) for actions (N, 3) in ±1, after `steps` (N,) control periods of the episodes."""
        xp = _namespace(actions)
        period = np.minimum(steps // self._steps_per_force, self._external_force.shape[1] - 1)
        external = xp.asarray(self._external_force[np.arange(self.num_envs), period])
        forces = actions * xp.asarray(np.array(self.description.action_scale))
        columns = xp.concatenate([forces, external, xp.zeros_like(external[:, :1])], axis=1)
        return columns[:, self._order]

    def state(self, q: Any, forces: Any) -> PushingState:
        """The state at positions q (N, nq) and marker forces (N, markers, 3)."""
        xp = _namespace(q)
        x, y, yaw = (q[:, index] for index in self._finger_q)
        x, y = x + self._pad_center[0], y + self._pad_center[1]
        cos, sin = xp.cos(yaw), xp.sin(yaw)
        finger = [self._gripper_base[0] + cos * x - sin * y, self._gripper_base[1] + sin * x + cos * y, yaw]
        box = [q[:, index] for index in self._box_q]
        box = [self._box_base[0] + box[0], self._box_base[1] + box[1], box[2]]
        goal, half_size, mass = (xp.asarray(values) for values in (self.goal, self.half_size, self.mass))
        return PushingState(xp.stack(finger, axis=1), xp.stack(box, axis=1), goal, half_size, mass, forces)

    def read(self, forces: Array, which: Mask, rng: np.random.Generator) -> Array:
        """Readings (N, markers, 3) of the pads in the environments `which` for marker forces; others are copied."""
        readings = forces.copy()
        readings[which] = self._sensors.read(forces[which], which, rng, interval=self.description.control_period)
        return readings

    def _controls(self, actions: Array, rng: np.random.Generator, active: Mask) -> Array:
        self._action[active] = actions[active]
        return np.asarray(self.controls(self._action, self.info["steps"]))

    def _observe(self, active: Mask, rng: np.random.Generator) -> None:
        task, info = self.description, self.info
        state = self.state(self.sim.q, self.read(self.sim.tactile(), active, rng))
        squared, yaw = state.goal_error()
        info["position_error"][active] = np.sqrt(squared)[active]
        info["yaw_error"][active] = np.abs(yaw)[active]
        self.metrics["position error [mm]"][active] = 1e3 * info["position_error"][active]
        self.metrics["yaw error [°]"][active] = np.degrees(info["yaw_error"][active])
        near = (info["position_error"] < task.position_tolerance) & (info["yaw_error"] < task.yaw_tolerance)
        info["success"][active] = near[active]
        info["privileged"][active] = state.privileged(task)[active]
        self.reward[active] = task.reward(state, self._action)[active]
        frame = state.frame(task)
        started = active & (info["steps"] == 0)
        self.frames[active] = stacked(self.frames, frame)[active]
        self.frames[started] = frame[started, None]
        self.observation[active] = self.frames.reshape(self.num_envs, -1)[active]

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A picture of environment `index`; a dashed outline shows the goal of the box."""
        from gelflow.sim.drawing.renderer import render  # deferred: a policy in training draws nothing

        x, y, yaw = self.goal[index]
        corners = self.half_size[index] * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        cos, sin = np.cos(yaw), np.sin(yaw)
        outline = corners @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
        goal = Polyline(np.column_stack([outline, np.zeros(len(outline))]), "goal")
        apart = 1e3 * self.info["position_error"][index], np.degrees(self.info["yaw_error"][index])
        title = "Pushing: box {:.0f} mm and {:.0f}° from its goal".format(*apart)
        return render(self.sim, index, title=title, polylines=[goal])
