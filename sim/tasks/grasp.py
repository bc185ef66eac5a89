"""Stable grasp (paper, appendix B.2): a gripper finds the centre of mass of a bar by touch.

An attempt closes the gripper on the bar, lifts it and reads the pads; a step moves the gripper along the bar and makes
the next attempt. The bar is put down between attempts; this is not simulated.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import MIN_DIVISORS, Grid, normalize
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.gripper.attempt_task import AttemptTask
from gelflow.sim.tasks.gripper.bar import BLOCK, SCENE_BLOCKS, Bar, with_load
from gelflow.sim.tasks.gripper.pads import NOMINAL_PADS, PAD_QUANTITIES, PADS, pad_parameters
from gelflow.sim.tasks.randomization import Fixed, Quantity, Randomization, Uniform
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, SENSOR_QUANTITIES, SensorModel
from gelflow.sim.tasks.task_batch import (
    Array,
    Mask,
    SceneOptions,
    check_option_names,
    check_options,
    option_rows,
)
from gelflow.task import TaskDescription

_CHUNK = 64  # environments of one rollout: bounds the memory of its trajectory
_FIRST_FORCE = 3.0  # [N] of the fingers at first touch
_GAP = 0.2e-3  # [m] between each pad and the bar at the start
_RESET_OPTIONS = {"center_of_mass": "along the bar [m]", "mass": "of the bar [kg]", "start": "first grasp [m]"}


@dataclass(frozen=True)
class GraspTask(TaskDescription):
    """Description of the grasp task. Lengths in metres along the bar, from its middle; times in seconds."""

    name: str = "grasp"
    sensors: int = 2
    grid: Grid = Grid(rows=13, cols=10, pitch=1.5, center=(2.0, 0.0))  # of the flow map on each pad [mm]
    attempts: int = 10
    action_scale: float = 50e-3  # displacement of the gripper for an action of 1
    workspace: float = 110e-3  # largest |y| of the gripper
    lift: float = 30e-3  # commanded height of the lift
    close_time: float = 0.1
    lift_time: float = 0.25
    hold_time: float = 0.1  # between the end of the lift and the reading
    success_lift: float = 5e-3  # the middle of the bar is lifted more than this
    success_tilt: float = 0.02  # and the bar is rotated less than this [rad]
    force_range: tuple[float, float] | None = None  # of the fingers [N]; with it, a second action chooses the force
    force_cost: float = 1.0  # reward for success falls by this for each N of a chosen force

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sensors != len(PADS) or self.attempts < 1:
            given = f"{self.sensors} and {self.attempts}"
            raise UsageError(f"sensors must be {len(PADS)} and attempts at least 1, got {given}")
        if min(times := (self.close_time, self.lift_time, self.hold_time)) < 0 or not self.lift_time > 0:
            raise UsageError(f"close_time, lift_time and hold_time must not be negative, lift_time not 0, got {times}")
        if self.force_range is not None and len(self.force_range) != 2:
            raise UsageError(f"force_range must be (low, high), got {self.force_range}")
        if self.force_range is not None and not 0 < self.force_range[0] < self.force_range[1] <= 80:
            raise UsageError(f"force_range must be 0 < low < high ≤ 80 N, got {self.force_range}")

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Shape of the flow map's image: (sensors * 2, rows, cols)."""
        return (self.sensors * 2, self.grid.rows, self.grid.cols)


GRASP = GraspTask()

DEFAULT_RANDOMIZATION = Randomization(
    {
        "mass": Quantity(Uniform(51e-3, 120e-3), "kg", "of the bar"),
        "center_of_mass": Quantity(Uniform(-1.0, 1.0), "", "along the bar, as part of its largest value"),
        "start": Quantity(Fixed(0.0), "", "gripper of the first attempt, as part of its workspace"),
        "grasp_force": Quantity(Fixed(10.0), "N", "of each finger, unless the action chooses it"),
        "load_share": Quantity(Uniform(0.2, 0.5), "", "mass of a moving load, as part of the mass"),
        "load_travel": Quantity(Uniform(10e-3, 40e-3), "m", "of a moving load to both sides of its start"),
        "load_friction": Quantity(Uniform(0.0, 0.05), "", "of a moving load in the bar: sliding to rolling"),
        **NOMINAL_PADS,
        **NO_SENSOR_EFFECTS,
        "noise": SENSOR_QUANTITIES["noise"],
    }
)
FULL_RANDOMIZATION = Randomization(
    {
        **DEFAULT_RANDOMIZATION.quantities,
        "start": Quantity(Uniform(-1.0, 1.0), "", "gripper of the first attempt, as part of its workspace"),
        "grasp_force": Quantity(Uniform(5.0, 16.0), "N", "of each finger, unless the action chooses it"),
        **PAD_QUANTITIES,
        **SENSOR_QUANTITIES,
    }
)
RANDOMIZATIONS = {"default": DEFAULT_RANDOMIZATION, "full": FULL_RANDOMIZATION}


class Grasp(AttemptTask):
    """A batch of grippers, each with a bar.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    blocks: of the bar, 25 mm each
    moving_load: a part of the mass slides inside the bar where the bar tilts, and stays there
    randomization: distributions of bar, pads and sensors
    options: of the scene "grasp" and its simulator, see `SceneOptions`

    Observation: normalized flow map of the lifted bar against the closed grasp. Action: displacement along the bar, and
    the force of the fingers if the task has a `force_range`. Reward: 100 on success (less the cost of a chosen force),
    otherwise −10 |tilt|. Info, with first axis N: "tilt" [rad], "lift" [m], "divisor" of the flow map [N], "position"
    of the gripper [m], "force" [N]; "privileged": the gripper's position minus the centre of mass [m], and the mass
    [kg].
    """

    description: GraspTask

    def __init__(
        self,
        num_envs: int,
        *,
        task: GraspTask = GRASP,
        blocks: int = SCENE_BLOCKS,
        moving_load: bool = False,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
        **options: Unpack[SceneOptions],
    ) -> None:
        super().__init__(
            task,
            num_envs,
            observation_space=Box(-1, 1, task.observation_shape, np.float32),
            action_space=Box(-1, 1, (1 if task.force_range is None else 2,), np.float32),
            privileged=2,
            attempts=task.attempts,
        )
        check_option_names(task.name, type(self), options)
        self.randomization = randomization
        self.bar = Bar(blocks)
        self.scene = _scene(task, options, moving_load)
        self.sim = Simulator(self.scene, num_envs=min(num_envs, _CHUNK), threads=options.get("threads"))
        self._moving_load = moving_load
        self._workspace = min(task.workspace, self.bar.half_length - BLOCK / 2)
        self._sensors = SensorModel([pad.positions for pad in self.scene.pads], num_envs)
        self._params = np.tile(self.sim.params[:1], (num_envs, 1))
        self._set_geometry()
        self._mass: Array = np.zeros(num_envs)
        self._shell_center: Array = np.zeros(num_envs)  # centre of mass without the load [m]
        self._load_mass: Array = np.zeros(num_envs)
        self._load_at: Array = np.zeros(num_envs)  # [m]
        self._lifted = {  # state at the end of the last attempt
            name: np.repeat(getattr(self.sim, name)[:1], num_envs, axis=0) for name in ("q", "v", "anchors", "anchored")
        }
        self._steps = tuple(
            max(1, round(time / self.scene.step)) for time in (task.close_time, task.lift_time, task.hold_time)
        )
        self.info |= {name: np.zeros(num_envs) for name in ("tilt", "lift", "divisor", "position", "force")}
        if task.force_range is not None:
            self.metrics = {"force [N]": self.info["force"]}

    def oracle(self) -> Array:
        """Actions to the centre of mass."""
        actions = np.zeros((self.num_envs, *self.action_space.shape))
        actions[:, 0] = np.clip(-self.info["privileged"][:, 0] / self.description.action_scale, -1, 1)
        return actions

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """The lifted bar of environment `index` and its pads."""
        from gelflow.sim.drawing.renderer import render  # deferred: a policy in training draws nothing

        self.sim.reset()
        self.sim.params[0] = self._params[index]
        for name, values in self._lifted.items():
            getattr(self.sim, name)[0] = values[index]
        info = {name: self.info[name][index] for name in ("attempts", "position", "tilt")}
        title = f"attempt {info['attempts']} at {info['position'] * 1e3:.0f} mm: tilt {info['tilt'] * 1e3:.0f} mrad"
        return render(self.sim, 0, title=title)

    def _set_geometry(self) -> None:
        """Length of the bar, and the tables below its ends."""
        self._param("bar.size.y")[:] = self.bar.half_length
        self._param("bar.points.scale.y")[:] *= self.bar.blocks / SCENE_BLOCKS
        self._param("table_front.shape.pos.y")[:] = -self.bar.table_y
        self._param("table_back.shape.pos.y")[:] = self.bar.table_y

    def _param(self, name: str) -> Array:
        """Values of a parameter of the simulator in all environments: a writable view, (N,)."""
        return self._params[:, self.sim.param_index[name]]

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        check_options(self.description.name, options, _RESET_OPTIONS)
        count = int(which.sum())
        drawn = self.randomization.sample(rng, count, friction=self.scene.friction)
        drawn["center_of_mass"] *= min(self.description.workspace, self.bar.max_center_of_mass)
        drawn["start"] *= self._workspace
        for name in options:
            drawn[name] = option_rows(name, options[name], which)
        limit = self.bar.max_center_of_mass
        if (np.abs(drawn["center_of_mass"]) > limit + 1e-9).any() or (drawn["mass"] <= 0).any():
            raise UsageError(f"reset: center_of_mass must be within ±{limit:.4g} m, and mass positive")
        if (np.abs(drawn["start"]) > self._workspace + 1e-9).any():
            raise UsageError(f"reset: start must be within the workspace of ±{self._workspace:.4g} m")
        self._sensors.draw(which, drawn, rng)
        self._record(which, drawn, self.randomization, center_of_mass="m", start="m")
        params = pad_parameters(drawn, elastic=self.scene.friction == "elastic")
        params |= self._draw_bar(which, drawn)
        for name, values in params.items():
            self._param(name)[which] = values
        self.info["position"][which] = np.clip(drawn["start"], -self._workspace, self._workspace)
        self.info["force"][which] = drawn["grasp_force"]
        if self.description.force_range is not None:
            self.info["force"][which] = np.mean(self.description.force_range)

    def _draw_bar(self, which: Mask, drawn: Mapping[str, Array]) -> dict[str, Array]:
        """Set mass and centre of mass of the bars and their loads; returns parameters of the simulator."""
        mass, center = drawn["mass"], drawn["center_of_mass"]
        load = mass * drawn["load_share"] if self._moving_load else np.zeros_like(mass)
        blocks = self.bar.block_masses(mass - load, center)
        center, across, along = self.bar.inertia(blocks)
        self._mass[which], self._shell_center[which] = mass, center
        self._load_mass[which], self._load_at[which] = load, center
        params = {
            "bar.mass": mass - load,
            "bar.com.y": center,
            "bar.inertia.xx": across,
            "bar.inertia.yy": along,
            "bar.inertia.zz": across,
        }
        if self._moving_load:
            # The bar does not tip on its tables wherever the load rests.
            end, share = self.bar.max_center_of_mass, drawn["load_share"]
            params |= {f"load.inertia.{axis}": load * BLOCK**2 / 6 for axis in ("xx", "yy", "zz")}
            params |= {
                "load.mass": load,
                "load.lower": center - np.minimum(drawn["load_travel"], (end + center) / share),
                "load.upper": center + np.minimum(drawn["load_travel"], (end - center) / share),
                "load.frictionloss": -self.scene.gravity[2] * load * drawn["load_friction"],
            }
        return params

    def _move(self, actions: Array, active: Mask) -> None:
        position, task = self.info["position"], self.description
        moved = position + task.action_scale * actions[:, 0]
        position[active] = np.clip(moved, -self._workspace, self._workspace)[active]
        if task.force_range is not None:
            low, high = task.force_range
            self.info["force"][active] = ((low + high) / 2 + (high - low) / 2 * actions[:, 1])[active]

    def _attempt(self, active: Mask, rng: np.random.Generator) -> None:
        rows = np.flatnonzero(active)
        forces = np.zeros((2, len(rows), self.scene.num_markers, 2))  # closed, lifted
        for first in range(0, len(rows), _CHUNK):
            part = slice(first, first + _CHUNK)
            forces[:, part] = self._simulate(rows[part])
        self._sensors.clear(active)
        grid, interval = self.description.grid, (sum(self._steps) - self._steps[0]) * self.scene.step
        closed, lifted = (
            self._sensors.read(reading, active, rng, interval=interval).reshape(
                len(rows), len(PADS), grid.rows, grid.cols, 2
            )
            for reading in forces
        )
        image, divisor = normalize(lifted[:, None], closed, min_divisor=MIN_DIVISORS["N"])
        self.observation[rows], self.info["divisor"][rows] = image, divisor
        self._evaluate(rows)

    def _evaluate(self, rows: NDArray[np.int64]) -> None:
        """Success, reward and true quantities of the attempts in `rows`."""
        task, info = self.description, self.info
        success = (info["lift"] > task.success_lift) & (info["tilt"] < task.success_tilt) & ~info["failed"]
        info["success"][rows] = success[rows]
        gain = 100 - (0 if task.force_range is None else task.force_cost * info["force"])
        self.reward[rows] = np.where(success, gain, -10 * info["tilt"])[rows]
        mass, load = self._mass[rows], self._load_mass[rows]
        center = ((mass - load) * self._shell_center[rows] + load * self._load_at[rows]) / mass
        info["privileged"][rows] = np.column_stack([info["position"][rows] - center, mass])

    def _simulate(self, rows: NDArray[np.int64]) -> Array:
        """Close and lift in the environments `rows`; returns the shear forces (closed and lifted, rows, markers, 2)."""
        sim, scene, count = self.sim, self.scene, len(rows)
        q, rest_height = self._start(rows)
        sim.params[:count] = self._params[rows]
        full = np.tile(scene.q0, (sim.num_envs, 1))
        full[:count] = q
        close, total = self._steps[0], sum(self._steps)
        sim.reset()
        trajectory = sim.rollout(
            self._controls(rows),
            q=full,
            read_after=(close, total),
            active=np.arange(sim.num_envs) < count,
            end_only=True,
        )
        end = trajectory.q[-1, :count]
        for name, values in self._lifted.items():
            values[rows] = getattr(trajectory, name)[-1, :count]
        bar = end[:, scene.q("bar")]
        self.info["lift"][rows] = bar[:, 2] - rest_height
        self.info["tilt"][rows] = 2 * np.arctan2(np.linalg.norm(bar[:, 4:], axis=1), np.abs(bar[:, 3]))
        self.info["failed"][rows] = trajectory.status[:count] != 0
        if self._moving_load:
            self._load_at[rows] = end[:, scene.q("load").start]
        return np.asarray(trajectory.tactile[:, :count, :, :2], dtype=float)

    def _start(self, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """Positions (n, nq) with the bar at rest and the open gripper around it, and the height of the bar (n,)."""
        scene = self.scene
        q = np.tile(scene.q0, (len(rows), 1))
        q[:, scene.q("arm_y").start] = self.info["position"][rows]
        bar = scene.q("bar").start
        for finger in ("finger_left", "finger_right"):
            q[:, scene.q(finger).start] = -BLOCK / 2 - _GAP
        shell = self._mass[rows] - self._load_mass[rows]
        moment = shell * self._shell_center[rows] + self._load_mass[rows] * self._load_at[rows]
        height, turn = self.bar.rest(scene, self._mass[rows], moment / self._mass[rows])
        q[:, bar + 2] += height
        q[:, bar + 3], q[:, bar + 4] = np.cos(turn / 2), np.sin(turn / 2)
        if self._moving_load:
            q[:, scene.q("load").start] = self._load_at[rows]
        return q, q[:, bar + 2]

    def _controls(self, rows: NDArray[np.int64]) -> Array:
        """Controls of the steps of an attempt, (steps, environments of the simulator, nu)."""
        scene, (close, lift, hold) = self.scene, self._steps
        step = np.arange(1, close + lift + hold + 1)
        u = np.zeros((len(step), self.sim.num_envs, scene.nu))
        closing, lifting = _ramp(step / close), _ramp((step - close) / lift)
        force = _FIRST_FORCE + (self.info["force"][rows] - _FIRST_FORCE) * closing[:, None]
        for finger in ("finger_left", "finger_right"):
            u[:, : len(rows), scene.u(finger)] = force
        u[:, :, scene.u("arm_z")] = (scene.q0[scene.q("arm_z")] + self.description.lift * lifting[:, None])[:, :1]
        u[:, : len(rows), scene.u("arm_y")] = self.info["position"][rows]
        return u


def _scene(task: GraspTask, options: SceneOptions, moving_load: bool) -> Scene:
    """The grasp scene with the marker grid of the task's observations."""
    grid = task.grid
    overrides = {
        "pads.*.rows": grid.rows,
        "pads.*.cols": grid.cols,
        "pads.*.pitch": grid.pitch * 1e-3,
        "pads.*.center": [grid.center[0] * 1e-3, grid.center[1] * 1e-3],
    }
    preset, friction = options.get("preset"), options.get("friction")
    scene = load_scene("grasp", preset=preset, friction=friction, overrides=overrides)
    return with_load(scene) if moving_load else scene


def _ramp(x: Array) -> Array:
    """Smooth ramp from 0 at x = 0 to 1 at x = 1."""
    x = np.clip(x, 0, 1)
    return np.asarray(x * x * (3 - 2 * x))
