"""Batched simulation of insertion attempts.

The gripper holds a part above a hole, with a misalignment. An attempt lowers the gripper by the task's descent and
records the marker forces; then a policy corrects the gripper's pose, and the next attempt starts. The retreat is not
simulated: each attempt starts from the grasp at rest, placed above the hole at the present gripper pose. The grasp does
not depend on that pose, so it is simulated once per part.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import apply_planar, rotation_matrices, turned_about_z
from gelflow.observation import MIN_DIVISORS, normalize
from gelflow.sim.arguments import check_type
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.gripper.pads import PADS
from gelflow.sim.tasks.insertion_randomization import ARM_JOINTS, insertion_randomization, simulator_parameters
from gelflow.sim.tasks.parts.grasp import indentation, pad_gaps
from gelflow.sim.tasks.parts.part_scene import hole_parameters, with_part
from gelflow.sim.tasks.parts.registry import part_geometry
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.sensor_model import SensorModel
from gelflow.sim.trajectory import TouchStop, Trajectory
from gelflow.task import INSERTION, InsertionTask

if TYPE_CHECKING:
    from gelflow.sim.drawing.scene_drawing import SceneDrawing

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

# [m/s] of an attempt, as in Xu et al. (CoRL 2022): 1.1 mm in 45 steps of 5 ms, about ten times faster than the robot.
DESCENT_SPEED = 1.1e-3 / 0.225
_LARGEST_SLIDE = 2e-3  # of a part while the gripper closes [m]; one that slides farther is not held
SETTLE_TIME = 0.120  # [s] until the part is at rest in the closed gripper
ROLLOUT_SIZE = 64  # environments of one rollout
_GRASP_STATE = ("q", "anchors", "anchored")
_STATE = ("v", *_GRASP_STATE)
_CLEAR_HEIGHT = 0.1  # [m] height of the part while the gripper closes, clear of the hole
_OUTLINE_TOLERANCE = 0.3e-3  # [m] penetration of the hole's walls that is allowed for an inserted part
_CONTACT_SHARE = 1 / 3  # shear that counts as contact at the end of a descent / `stop_shear`, as in a lab file


@dataclass(frozen=True)
class AttemptResult:
    """Results of one attempt, one row for each of the n environments that made it."""

    image: NDArray[np.float32]  # flow maps, shape (n, frames * sensors * 2, rows, cols)
    divisor: Array  # shape (n,), in newtons: normalization of the flow maps
    height: Array  # [m], shape (n,): highest corner of the part's lower face above the hole's floor
    # Shape (n,): the lower face is inside the hole and below the task's success height, contact did not stop the
    # descent, there is no contact at its end, and no step failed.
    inserted: NDArray[np.bool_]
    failed: NDArray[np.bool_]  # shape (n,): a simulation step failed
    depth: Array  # [m], shape (n,): of the gripper's target below its start when the descent ended, by contact or not
    offset: Array  # [m], shape (n,): of the lower face at the start, above the task's start height


def insertion_scene(task: InsertionTask = INSERTION, *, preset: str | None = None, friction: str = "elastic") -> Scene:
    """The insertion scene with the task's part and the marker grid of its observations, which presets do not change."""
    check_type("task", task, InsertionTask, "an InsertionTask")
    grid = task.grid
    scene = load_scene(
        "insertion",
        preset=preset,
        friction=friction,
        overrides={
            "pads.*.rows": grid.rows,
            "pads.*.cols": grid.cols,
            "pads.*.pitch": grid.pitch * 1e-3,
            "pads.*.center": [grid.center[0] * 1e-3, grid.center[1] * 1e-3],
        },
    )
    return with_part(scene, task.part)


def descent_steps(task: InsertionTask, scene: Scene) -> int:
    """Simulation steps of a descent at `DESCENT_SPEED`."""
    return max(1, round(task.descent / DESCENT_SPEED / scene.step))


class InsertionAttempts:
    """`num_envs` grippers, each holding a part above its hole.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    scene: `insertion_scene(task)`, or a scene with the same bodies, actuators and pads
    randomization: distribution of the physical parameters; None: the default table of the task
    threads: of the simulator; None uses all available cores. Results do not depend on it.
    steps: simulation steps of a descent; None gives `DESCENT_SPEED`

    `sensors` are the pads. `pose` (N, 3) holds the gripper poses in the hole's frame: x [m], y [m], yaw [rad];
    `stop_shear` (N,) is the mean shear of the markers at which contact stops a descent [N]. Both are drawn with a part;
    write to them between attempts. An attempt is one rollout of at most `ROLLOUT_SIZE` environments, which bounds the
    memory of its trajectory; `sim` simulates that many, and holds the end of the last attempt. Raises UsageError when
    the scene does not match the task.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        randomization: Randomization | None = None,
        threads: int | None = None,
        steps: int | None = None,
    ) -> None:
        if steps is not None and steps < 1:
            raise UsageError(f"steps must be at least 1, got {steps}")
        self.task = task
        self.scene = insertion_scene(task) if scene is None else scene
        self._steps = descent_steps(task, self.scene) if steps is None else steps
        self._settle_steps = max(1, round(SETTLE_TIME / self.scene.step))
        self.randomization = insertion_randomization("default", task) if randomization is None else randomization
        if [p.name for p in self.scene.pads] != list(PADS) or any(g != task.grid for g in self.scene.grids):
            raise UsageError(f"the scene's pads must be {', '.join(PADS)} with the task's markers {task.grid}")
        self.sim = Simulator(self.scene, num_envs=min(num_envs, ROLLOUT_SIZE), threads=threads)
        self.num_envs = num_envs
        self._frames = [self._step_at(depth) for depth in task.frame_depths]
        self._reference_at = self._step_at(task.reference_depth)
        self._part_q = self.scene.q("part").start
        self._arm_q = [self.scene.q(name).start for name in ARM_JOINTS]
        self._arm_u = [self.scene.u(name) for name in ARM_JOINTS]
        self._geometry = part_geometry(task.part)
        self._clear_height = max(_CLEAR_HEIGHT, task.part.depth + task.part.size[2])
        self.pose: Array = np.zeros((num_envs, 3))
        self.stop_shear: Array = np.full(num_envs, np.inf)
        self.drawn: dict[str, Array] = {}  # quantities of the latest `draw`, one value for each of its environments
        self.sensors = SensorModel([pad.positions for pad in self.scene.pads], num_envs)
        self._jitter: Array = np.zeros(num_envs)  # of the start height in the last attempt [m]
        self._last_step = np.zeros(num_envs, dtype=int)  # at which the last attempt ended
        self._start_height: Array = np.zeros(num_envs)  # half-range of the start height per attempt [m]
        self._params = np.repeat(self.sim.params[:1], num_envs, axis=0)
        # The right jaw is force controlled; the left one holds its position.
        self._param("hold_right.kp")[:] = self._param("hold_right.kd")[:] = 0
        # The grasp at rest: controls, state and shear forces.
        self._u: Array = np.zeros((num_envs, self.scene.nu))
        self._grasp = {name: np.repeat(getattr(self.sim, name)[:1], num_envs, axis=0) for name in _GRASP_STATE}
        self._end = {name: np.repeat(getattr(self.sim, name)[:1], num_envs, axis=0) for name in _STATE}
        self._not_grasped: Mask = np.zeros(num_envs, bool)  # the closing could not be simulated, or the part slid
        self._grasp_shear: Array = np.zeros((num_envs, self.scene.num_markers, 2))

    def _step_at(self, depth: float) -> int:
        """Number of steps after which the gripper's target is `depth` [m] below its start."""
        if not 0 <= depth <= self.task.descent * (1 + 1e-9):
            raise UsageError(f"frame depth {depth} m is outside the descent of {self.task.descent} m")
        return int(np.ceil(depth / self.task.descent * self._steps - 1e-6))

    def _param(self, name: str) -> Array:
        """Values of a parameter of the simulator in all environments: a writable view, (N,)."""
        return self._params[:, self.sim.param_index[name]]

    def draw(self, rng: np.random.Generator, *, which: Mask | None = None, misalignment: Array | None = None) -> None:
        """Start new parts in the environments `which` (N,), or in all.

        Physics and grasp come from the randomization, `pose` from the task unless `misalignment` is given, (3,) or one
        for each of these environments.
        """
        chosen = np.ones(self.num_envs, dtype=bool) if which is None else which
        rows = np.flatnonzero(chosen)
        self.drawn = sampled = self.randomization.sample(rng, len(rows), friction=self.scene.friction)
        params = simulator_parameters(sampled, elastic=self.scene.friction == "elastic")
        for name, values in hole_parameters(self.scene, params).items():
            self._param(name)[rows] = values
        self.stop_shear[rows], self._start_height[rows] = sampled["stop_shear"], sampled["start_height"]
        self.pose[rows] = self.task.draw_misalignment(rng, len(rows))
        if misalignment is not None:
            self.pose[rows] = misalignment
        for part in _parts(len(rows)):
            self._close(rows[part], sampled["grasp_force"][part], sampled["grasp_height"][part])
        self.sensors.draw(chosen, sampled, rng)

    def _close(self, rows: Rows, force: Array, height: Array) -> None:
        """Close the grippers `rows` on their parts, far above the holes, and store the state at rest."""
        sim, scene, n = self.sim, self.scene, len(rows)
        sim.reset()
        sim.params[:n] = self._params[rows]
        q, u = np.tile(scene.q0, (n, 1)), np.zeros((sim.num_envs, scene.nu))
        q[:, self._part_q + 2] = self._clear_height
        q[:, self._arm_q[2]] = self._clear_height + height
        for finger, pad in (("finger_left", "pad_left"), ("finger_right", "pad_right")):
            gaps = pad_gaps(scene, self._geometry, pad, height)
            q[:, scene.q(finger)] += indentation(gaps, force, self._param(f"{pad}.kn")[rows])[:, None]
            u[:n, scene.u(finger)] = force
        u[:n, scene.u("hold_left")] = q[:, scene.q("finger_left").start]
        u[:n, self._arm_u] = q[:, self._arm_q]
        weight = -scene.gravity[2] * sum(self._param(f"{body.name}.mass")[rows] for body in scene.bodies)
        u[:n, self._arm_u[2]] += weight / self._param("arm_z.kp")[rows]  # gravity compensation
        sim.q[:n] = q
        sim.step(u, self._settle_steps, active=np.arange(sim.num_envs) < n)
        slid = np.abs(sim.q[:n, self._part_q + 2] - self._clear_height) > _LARGEST_SLIDE
        self._not_grasped[rows] = (sim.status[:n] != 0) | slid
        self._u[rows] = u[:n]
        for name, values in self._grasp.items():
            values[rows] = getattr(sim, name)[:n]
        self._grasp_shear[rows] = sim.tactile()[:n, :, :2]

    def attempt(self, rng: np.random.Generator, *, which: Mask | None = None) -> AttemptResult:
        """Simulate one attempt in the environments `which` (N,), or in all, starting from `pose`.

        As on the robot, contact stops the descent at `stop_shear`: later frames repeat the forces at the stop. The
        first axis of the results counts the environments in `which`.
        """
        chosen = np.ones(self.num_envs, dtype=bool) if which is None else which
        rows = np.flatnonzero(chosen)
        jitter = rng.uniform(-1, 1, len(rows)) * self._start_height[rows]
        self._jitter[rows] = jitter
        shown = sorted({self._reference_at, *self._frames})
        steps = sorted({*shown, self._steps})
        shear = np.zeros((len(steps), len(rows), self.scene.num_markers, 2))
        height, inserted, failed = np.zeros(len(rows)), np.zeros(len(rows), bool), np.zeros(len(rows), bool)
        depth = np.full(len(rows), self.task.descent)
        for part in _parts(len(rows)):
            trajectory = self._simulate(rows[part], jitter[part], steps)
            n = len(rows[part])
            for k, step in enumerate(steps):
                # The markers of the start are those of the closed grasp.
                shear[k, part] = trajectory.tactile[k, :n, :, :2] if step else self._grasp_shear[rows[part]]
            height[part], inserted[part] = self._outcome(trajectory.q[-1, :n])
            failed[part] = (trajectory.status[:n] != 0) | self._not_grasped[rows[part]]
            stopped = trajectory.stopped_at[:n]
            self._last_step[rows[part]] = np.where(stopped < 0, self._steps, stopped)
            inserted[part] &= ~failed[part] & (stopped < 0)
            depth[part] = np.where(stopped < 0, self.task.descent, self.task.descent * stopped / self._steps)
        at = dict(zip(steps, shear, strict=True))
        inserted &= ~self._in_contact(rows, at[self._steps] - at[self._reference_at])
        readings = self._readings({step: at[step] for step in shown}, chosen, rng)
        stack = np.stack([readings[step] for step in self._frames], axis=1)
        image, divisor = normalize(stack, readings[self._reference_at], min_divisor=MIN_DIVISORS["N"])
        return AttemptResult(image.astype(np.float32), divisor, height, inserted, failed, depth, jitter)

    def _in_contact(self, rows: Rows, change: Array) -> Mask:
        """Whether the shear along a finger shows contact, after its `change` (n, markers, 2) [N] in a descent."""
        along = change[..., 0].reshape(len(rows), len(PADS), -1).mean(2)
        return np.asarray(np.abs(along).max(1) > _CONTACT_SHARE * self.stop_shear[rows])

    def _simulate(self, rows: Rows, jitter: Array, steps: list[int]) -> Trajectory:
        """The descent of the grippers `rows`, read after `steps`."""
        sim, n, z = self.sim, len(rows), self._arm_u[2]
        start = self._start(rows, jitter)
        u = np.repeat(start[None], self._steps, axis=0)
        u[:, :n, z] = start[:n, z] - (self.task.descent * np.arange(1, self._steps + 1) / self._steps)[:, None]
        threshold = np.full(sim.num_envs, np.inf)
        threshold[:n] = self.stop_shear[rows]
        can_stop = self._reference_at < self._steps
        trajectory = sim.rollout(
            u,
            read_after=steps,
            active=np.arange(sim.num_envs) < n,
            stop=TouchStop(threshold, reference_step=self._reference_at) if can_stop else None,
            end_only=True,
        )
        for name, values in self._end.items():
            getattr(sim, name)[:] = getattr(trajectory, name)[-1]
            values[rows] = getattr(sim, name)[:n]
        return trajectory

    def show_end(self, index: int) -> Simulator:
        """The simulator, with the end of the last attempt of environment `index` in its first place."""
        self.sim.params[0] = self._params[index]
        for name, values in self._end.items():
            getattr(self.sim, name)[0] = values[index]
        return self.sim

    def drawings(self, index: int, count: int) -> "list[SceneDrawing]":
        """Drawings of the last attempt of environment `index`, `count` of them evenly spread from its start to its end.

        The attempt is simulated again, from the present pose. Raises SimulationError where it failed.
        """
        from gelflow.sim.drawing.film import record_rollout  # deferred: a policy in training draws nothing

        rows, last = np.array([index]), max(int(self._last_step[index]), 1)
        u = np.repeat(self._start(rows, self._jitter[rows])[None], last, axis=0)
        u[:, 0, self._arm_u[2]] -= self.task.descent * np.arange(1, last + 1) / self._steps
        return record_rollout(self.sim, u, np.linspace(0, last, count).round().astype(int).tolist())

    def _start(self, rows: Rows, jitter: Array) -> Array:
        """Set the state to the grasps `rows` at `pose`, the lower face at its start height; returns the controls."""
        sim, at, n = self.sim, self._part_q, len(rows)
        sim.reset()
        sim.params[:n] = self._params[rows]
        grasp = self._grasp["q"][rows]
        part = grasp[:, at : at + 7]
        lift = self.task.start_height + jitter - (part[:, 2] - self.task.part.size[2] / 2)
        x, y, yaw = self.pose[rows].T
        sim.q[:n] = grasp
        sim.q[:n, self._arm_q] = np.column_stack([x, y, grasp[:, self._arm_q[2]] + lift, yaw])
        sim.q[:n, at : at + 2] = apply_planar(self.pose[rows], part[:, :2])
        sim.q[:n, at + 2] = part[:, 2] + lift
        sim.q[:n, at + 3 : at + 7] = turned_about_z(part[:, 3:], yaw)
        sim.anchors[:n] = self._grasp["anchors"][rows]
        sim.anchored[:n] = self._grasp["anchored"][rows]
        u = np.zeros((sim.num_envs, self.scene.nu))
        u[:n] = self._u[rows]
        u[:n, self._arm_u] = np.column_stack([x, y, u[:n, self._arm_u[2]] + lift, yaw])
        return u

    def _readings(self, frames: Mapping[int, Array], which: Mask, rng: np.random.Generator) -> dict[int, Array]:
        """Readings of the pads after the given numbers of steps, (n, pads, rows, cols, 2) each."""
        grid = self.task.grid
        self.sensors.clear(which)
        readings, last = {}, 0
        for step, shear in frames.items():
            reading = self.sensors.read(shear, which, rng, interval=(step - last) * self.scene.step)
            readings[step] = reading.reshape(len(shear), len(PADS), grid.rows, grid.cols, 2)
            last = step
        return readings

    def _outcome(self, q: Array) -> tuple[Array, Mask]:
        """Height of the highest corner of the part's lower face [m], and whether the face is inside the hole."""
        part = q[:, self._part_q : self._part_q + 7]
        corners = part[:, None, :3] + np.einsum(
            "nij,kj->nki", rotation_matrices(part[:, 3:]), self._geometry.lower_face
        )
        height = corners[..., 2].max(1)
        inside = (self._geometry.hole.distance(corners[..., :2]) < _OUTLINE_TOLERANCE).all(1)
        return height, inside & (height < self.task.success_height)

    def reward(self) -> Array:
        """Reward of the present poses, shape (N,); see `InsertionTask.reward`."""
        return self.task.reward(self.pose)


def _parts(count: int) -> list[slice]:
    """Slices of at most `ROLLOUT_SIZE` of `count` environments."""
    return [slice(first, min(first + ROLLOUT_SIZE, count)) for first in range(0, count, ROLLOUT_SIZE)]
