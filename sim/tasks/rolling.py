"""Ball rolling: a soft pad, driven by a force, rolls a ball on the ground to a goal (scene of the paper, B.1).

The paper uses the scene for measurements only; goal, reward and success are of this project.

Action (2): force on the pad along x and y, ±1 is `RollingTask.force`. The vertical force carries most of the weight of
the pad, as in B.1.
Observation: the goal from the pad's centre, the velocity of the pad, and the marker forces of the pad, from
which alone the position of the ball follows.
Terminated: the ball is at rest at its goal (success), or it leaves the pad. Truncated: after `max_steps`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import Grid
from gelflow.sim.drawing.scene_drawing import Polyline
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.control_task import ControlDescription, ControlTask
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, SENSOR_QUANTITIES
from gelflow.sim.tasks.task_batch import Array, Mask, SceneOptions, check_options, option_rows

SETTLE_TIME = 0.5  # [s] until the pad rests on the ball, as in B.1
_STATE = ("q", "v", "anchors", "anchored", "history")


@dataclass(frozen=True)
class RollingTask(ControlDescription):
    """Rolling of a ball below a pad. Lengths in metres, times in seconds, forces in newtons."""

    name: str = "rolling"
    grid: Grid = Grid(rows=10, cols=10, pitch=5.0)  # of the markers on the pad [mm]
    max_steps: int = 80
    force: float = 0.2  # along x and y, for an action of ±1
    lift: float = 0.2  # vertical force on the pad
    goal_distance: tuple[float, float] = (5e-3, 15e-3)  # of the goal from the ball's start
    tolerance: float = 1e-3  # distance of the ball to the goal for success
    rest_speed: float = 0.02  # largest speed of the ball for success
    pad_half_size: float = 0.025  # a ball whose centre is further from the pad's centre along x or y has left the pad
    # Units of the observation, so that its numbers are near 1.
    length_unit: float = 0.01
    speed_unit: float = 0.1
    marker_unit: float = 1e-3  # of marker forces [N]

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_ordered("goal_distance")
        self.check_positive("tolerance", "rest_speed", "pad_half_size", "length_unit", "speed_unit", "marker_unit")

    @property
    def observation_size(self) -> int:
        """Number of values of an observation."""
        return 4 + 3 * self.grid.rows * self.grid.cols

    def rewards(self, error: Array, action: Array, success: Mask) -> Array:
        """Rewards (N,) of a control period for distances to the goal (N,) [m] and actions (N, 2) in ±1."""
        return np.asarray(-((error / self.length_unit) ** 2) - 0.1 * (action**2).sum(1) + 10.0 * success)


ROLLING = RollingTask()
DEFAULT_RANDOMIZATION = Randomization(NO_SENSOR_EFFECTS)
# The deviations of real pads.
FULL_RANDOMIZATION = Randomization(SENSOR_QUANTITIES)
RANDOMIZATIONS = {"default": DEFAULT_RANDOMIZATION, "full": FULL_RANDOMIZATION}


class Rolling(ControlTask):
    """A batch of pads, each on a ball; see the module.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    randomization: deviations of the pads
    options: of the scene "rolling" and its simulator, see `SceneOptions`

    Option of `reset`: "goal" (2,), x and y from the ball's start [m]. Info, with first axis N: "error", distance of the
    ball to the goal [m]; "privileged": goal from the ball, velocity of the ball, ball from the pad, x and y each, in
    units of the task.
    """

    description: RollingTask

    def __init__(
        self,
        num_envs: int,
        *,
        task: RollingTask = ROLLING,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
        **options: Unpack[SceneOptions],
    ) -> None:
        grid = task.grid
        markers = {
            "rows": grid.rows,
            "cols": grid.cols,
            "size": [1e-3 * grid.pitch * n for n in (grid.rows, grid.cols)],
            "center": [1e-3 * value for value in grid.center],
        }
        super().__init__(
            task,
            num_envs,
            randomization,
            scene="rolling",
            actions=2,
            privileged=6,
            overrides={f"pads.pad.{key}": value for key, value in markers.items()},
            **options,
        )
        scene = self.scene
        self._pad_q = [scene.q(joint).start for joint in ("pad_x", "pad_y")]
        self._pad_v = [scene.v(joint).start for joint in ("pad_x", "pad_y")]
        self._ball_q = [scene.q("ball").start + axis for axis in (0, 1)]
        self._ball_v = [scene.v("ball").start + axis for axis in (0, 1)]
        self._force_u = [scene.u(name) for name in ("pad_x", "pad_y")]
        self._lift_u = scene.u("pad_z")
        self._settled = self._settle()
        self.goal: Array = np.zeros((num_envs, 2))  # in the world [m]
        self._action: Array = np.zeros((num_envs, 2))
        self.info["error"] = np.zeros(num_envs)

    def _settle(self) -> dict[str, NDArray[Any]]:
        """The state of one environment with the pad at rest on the ball."""
        sim = Simulator(self.scene, threads=1)
        u = np.zeros(self.scene.nu)
        u[self._lift_u] = self.description.lift
        sim.step(u, max(1, round(SETTLE_TIME / self.scene.step)))
        sim.check()
        return {name: getattr(sim, name)[0].copy() for name in _STATE}

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        task, rows = self.description, np.flatnonzero(which)
        check_options(task.name, options, {"goal": "x, y from the ball's start [m]"})
        given = option_rows("goal", options["goal"], which, (2,)) if "goal" in options else None
        drawn = self.randomization.sample(rng, len(rows), friction=self.scene.friction)
        self._sensors.draw(which, drawn, rng)
        distance, angle = rng.uniform(*task.goal_distance, len(rows)), rng.uniform(-np.pi, np.pi, len(rows))
        goal = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        if given is not None:
            goal = given
        start = {"goal_x": goal[:, 0], "goal_y": goal[:, 1]}
        self._record(which, drawn | start, self.randomization, goal_x="m", goal_y="m")
        self.sim.reset(which)
        for name, values in self._settled.items():
            getattr(self.sim, name)[rows] = values
        self.goal[rows] = goal + self.sim.q[rows][:, self._ball_q]
        self._action[rows] = 0

    def _controls(self, actions: Array, rng: np.random.Generator, active: Mask) -> Array:
        self._action[active] = actions[active]
        controls = np.zeros((self.num_envs, self.scene.nu))
        controls[:, self._force_u] = self.description.force * self._action
        controls[:, self._lift_u] = self.description.lift
        return controls

    def _observe(self, active: Mask, rng: np.random.Generator) -> None:
        task, info = self.description, self.info
        q, v = self.sim.q[active], self.sim.v[active]
        pad, ball, goal = q[:, self._pad_q], q[:, self._ball_q], self.goal[active]
        speed = np.linalg.norm(v[:, self._ball_v], axis=1)
        error = np.linalg.norm(ball - goal, axis=1)
        success = (error < task.tolerance) & (speed < task.rest_speed)
        info["error"][active], info["success"][active] = error, success
        self.terminated[active] = success | (np.abs(ball - pad) > task.pad_half_size).any(1)
        self.reward[active] = task.rewards(error, self._action[active], success)
        parts = [
            (goal - ball) / task.length_unit,
            v[:, self._ball_v] / task.speed_unit,
            (ball - pad) / task.length_unit,
        ]
        info["privileged"][active] = np.concatenate(parts, axis=1)
        readings = self._sensors.read(self.sim.tactile()[active], active, rng, interval=task.control_period)
        flat = readings.swapaxes(1, 2).reshape(len(q), -1) / task.marker_unit
        seen = [(goal - pad) / task.length_unit, v[:, self._pad_v] / task.speed_unit, flat]
        self.observation[active] = np.concatenate(seen, axis=1)

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A picture of environment `index`; a dashed circle with the radius of the ball shows its goal."""
        from gelflow.sim.drawing.renderer import render  # deferred: a policy in training draws nothing

        angle = np.linspace(0, 2 * np.pi, 65)
        radius = float(self.sim.param("ball.size.x")[index])
        circle = self.goal[index] + radius * np.column_stack([np.cos(angle), np.sin(angle)])
        goal = Polyline(np.column_stack([circle, np.full(len(angle), radius)]), "goal")
        title = f"Rolling: ball {1e3 * self.info['error'][index]:.1f} mm from its goal"
        return render(self.sim, index, title=title, polylines=[goal])
