"""Insertion attempts in simulation, many side by side.

A part hangs in the gripper above a hole that it does not quite meet. An attempt lowers the gripper by the task's
descent and reads the pads on the way; a policy then corrects the gripper's pose and tries again. The retreat is not
simulated: each attempt starts from the part at rest in the grasp, as it was when the gripper had just closed on it,
placed over the hole where the gripper is now. What the gripper holds does not depend on where it holds it, so that
state is computed once per part.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import MIN_DIVISORS, normalize
from gelflow.sim.scene.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.randomization import DEFAULT_RANDOMIZATION, Randomization
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]

DESCENT_TIME = 0.225  # of an attempt, as published: 45 steps of 5 ms, about ten times as fast as the robot [s]
SETTLE_TIME = 0.120  # until the part hangs still in the closed gripper [s]
ARMS = ("arm_x", "arm_y", "arm_z", "arm_yaw")
PADS = ("left", "right")
_CLEAR = 0.1  # height of the part where the gripper closes on it: touching nothing [m]
_OUTLINE = 0.3e-3  # an inserted part may press this far into a wall of the hole [m]


@dataclass(frozen=True)
class AttemptResult:
    """What one attempt of every environment brought."""

    image: NDArray[np.float32]  # flow maps, shape (N, frames * sensors * 2, rows, cols)
    divisor: Array  # what each map's forces were divided by [N], shape (N,)
    height: Array  # the highest corner of the part's lower face above the hole's floor [m], shape (N,)
    inserted: NDArray[np.bool_]  # the lower face is in the hole, below the task's success height
    failed: NDArray[np.bool_]  # the simulator could not take a step


def insertion_scene(task: InsertionTask = INSERTION, *, preset: str | None = None, friction: str = "elastic") -> Scene:
    """The insertion scene, its pads with the markers that the task's policy sees, whatever the preset."""
    grid = task.grid
    return load_scene(
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


class InsertionAttempts:
    """`num_envs` parts, each in its gripper, over its hole.

    Parameters
    ----------
    num_envs: how many side by side
    task: the task's description
    scene: `insertion_scene(task)`, or one of the same make
    randomization: from what the physics of a part is drawn
    threads: of the simulator; all cores when None. Results do not depend on it.
    steps: over which an attempt goes down; when None as many as 225 ms have

    `pose` (N, 3) is where each gripper is: x [m], y [m], yaw [rad] in the hole's frame. Write into it between attempts.
    Raises UsageError when task and scene do not fit together.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
        threads: int | None = None,
        steps: int | None = None,
    ) -> None:
        if steps is not None and steps < 1:
            raise UsageError(f"steps must be at least 1, got {steps}")
        self.task = task
        self.scene = insertion_scene(task) if scene is None else scene
        self._steps = max(1, round(DESCENT_TIME / self.scene.step)) if steps is None else steps
        self._settle_steps = max(1, round(SETTLE_TIME / self.scene.step))
        self.randomization = randomization
        if [p.name for p in self.scene.pads] != list(PADS) or any(g != task.grid for g in self.scene.grids):
            raise UsageError(f"the scene's pads must be {', '.join(PADS)} with the task's markers {task.grid}")
        self.sim = Simulator(self.scene, num_envs=num_envs, threads=threads)
        self.num_envs = num_envs
        self._frames = [self._step_at(depth) for depth in task.frame_depths]
        self._reference_at = self._step_at(task.reference_depth)
        self._part_q = self.scene.q("part").start
        self._arm_q = [self.scene.q(name).start for name in ARMS]
        self._arm_u = [self.scene.u(name) for name in ARMS]
        shapes = {shape.name: shape for shape in self.scene.shapes}
        half = shapes["part"].size
        self._corners = half * np.array([[x, y, -1.0] for x in (-1, 1) for y in (-1, 1)])
        self._face = half[2]
        right, back = shapes["wall_right"], shapes["wall_back"]
        self._outline = np.array([right.pose.position[0] - right.size[0], back.pose.position[1] - back.size[1]])
        self.pose: Array = np.zeros((num_envs, 3))
        self._noise: Array = np.zeros(num_envs)
        self._stop_shear: Array = np.full(num_envs, np.inf)
        # The part at rest in the grasp: state, controls, and what the pads feel then.
        self._u: Array = np.zeros((num_envs, self.scene.nu))
        self._held: dict[str, NDArray[Any]] = {
            "q": self.sim.q.copy(),
            "anchors": self.sim.anchors.copy(),
            "anchored": self.sim.anchored.copy(),
            "tactile": np.zeros((num_envs, self.scene.markers, 2)),
        }
        # What an attempt reads lands here, and stays where a frame is due: after which step, then what was felt.
        self._felt = np.zeros_like(self._held["tactile"])
        self._readings = {step: np.zeros_like(self._felt) for step in (self._reference_at, *self._frames)}

    def _step_at(self, depth: float) -> int:
        """After which step of an attempt the gripper's target is `depth` below its start."""
        if not 0 <= depth <= self.task.descent * (1 + 1e-9):
            raise UsageError(f"a frame at depth {depth} m can't be taken: an attempt goes down {self.task.descent} m")
        return int(np.ceil(depth / self.task.descent * self._steps - 1e-6))

    def draw(self, rng: np.random.Generator, *, misalignment: Array | None = None) -> None:
        """New parts everywhere: physics and grasp from the randomization, start from the task (or as given, (N, 3))."""
        drawn = self.randomization.sample(rng, self.num_envs, elastic=self.scene.friction == "elastic")
        for name, values in drawn.params.items():
            self.sim.param(name)[:] = values
        self._noise, self._stop_shear = drawn.noise, drawn.stop_shear
        self.pose = self.task.draw_misalignment(rng, self.num_envs)
        if misalignment is not None:
            self.pose = np.array(np.broadcast_to(misalignment, self.pose.shape), dtype=float)
        self._close(drawn.grasp_force, drawn.grasp_height)

    def _close(self, force: Array, height: Array) -> None:
        """Close the grippers on their parts, high above the holes, and remember the state at rest."""
        sim, scene = self.sim, self.scene
        sim.reset()
        sim.q[:] = scene.q0
        sim.q[:, self._part_q + 2] = _CLEAR
        sim.q[:, self._arm_q[2]] = _CLEAR + height
        # Where the fingers stand in balance: half of a disc's points are on the face that touches.
        touching = {p.name: p.weights.sum() / 2 for p in scene.points}
        for finger, pad in (("finger_left", "pad_left"), ("finger_right", "pad_right")):
            sim.q[:, scene.q(finger)] += (force / (sim.param(f"{pad}.kn") * touching[pad]))[:, None]
            self._u[:, scene.u(finger)] = force
        # The left jaw is held where it closed; the right one follows the force alone.
        self._u[:, scene.u("hold_left")] = sim.q[:, scene.q("finger_left").start]
        sim.param("hold_right.kp")[:] = 0
        sim.param("hold_right.kd")[:] = 0
        self._u[:, self._arm_u] = sim.q[:, self._arm_q]
        weight = -scene.gravity[2] * sum(sim.param(f"{body.name}.mass") for body in scene.bodies)
        self._u[:, self._arm_u[2]] += weight / sim.param("arm_z.kp")  # feed-forward: the arm does not sag
        sim.step(self._u, self._settle_steps)
        self._held["q"][:] = sim.q
        self._held["anchors"][:] = sim.anchors
        self._held["anchored"][:] = sim.anchored
        self._held["tactile"][:] = sim.tactile()[..., :2]

    def attempt(self, rng: np.random.Generator) -> AttemptResult:
        """One attempt of every environment from its `pose`.

        As on the robot, touch stops the descent: frames due later are what was felt then.
        """
        sim, z = self.sim, self._arm_u[2]
        u = self._place(rng)
        start = u[:, z].copy()
        felt = self._felt
        felt[:] = self._held["tactile"]
        readings = self._readings
        if 0 in readings:
            readings[0][:] = felt
        stopped = np.zeros(self.num_envs, dtype=bool)
        for step in range(1, self._steps + 1):
            u[:, z] = start - self.task.descent * step / self._steps
            sim.step(u)
            np.copyto(felt, sim.tactile()[..., :2], where=~stopped[:, None, None])
            if step in readings:
                readings[step][:] = felt
            if step > self._reference_at:
                stopped |= self._mean_shear(felt - readings[self._reference_at]) > self._stop_shear
        noisy = {step: self._with_noise(readings[step], rng) for step in sorted({self._reference_at, *self._frames})}
        stack = np.stack([noisy[step] for step in self._frames], axis=1)
        image, divisor = normalize(stack, noisy[self._reference_at], min_divisor=MIN_DIVISORS["N"])
        height, inserted = self._outcome()
        failed = sim.status != 0
        inserted &= ~failed & ~stopped
        return AttemptResult(image.astype(np.float32), divisor, height, inserted, failed)

    def _mean_shear(self, change: NDArray[Any]) -> Array:
        """Mean change of shear along the finger, of the pad where it is larger [N]; shape (N,)."""
        along = change[..., 0].reshape(self.num_envs, len(PADS), -1)
        return np.asarray(np.abs(along.mean(2)).max(1))

    def _place(self, rng: np.random.Generator) -> Array:
        """Put what each gripper holds at its pose, the lower face at its start height; returns the controls there."""
        sim, at = self.sim, self._part_q
        held = self._held["q"]
        sim.reset()
        part = held[:, at : at + 7]
        jitter = rng.uniform(-1, 1, self.num_envs) * self.randomization.start_height
        lift = self.task.start_height + jitter - (part[:, 2] - self._face)
        x, y, yaw = self.pose.T
        cos, sin = np.cos(yaw), np.sin(yaw)
        sim.q[:] = held
        sim.q[:, self._arm_q] = np.column_stack([x, y, held[:, self._arm_q[2]] + lift, yaw])
        sim.q[:, at] = x + cos * part[:, 0] - sin * part[:, 1]
        sim.q[:, at + 1] = y + sin * part[:, 0] + cos * part[:, 1]
        sim.q[:, at + 2] = part[:, 2] + lift
        sim.q[:, at + 3 : at + 7] = _turned(part[:, 3:], yaw)
        sim.anchors[:] = self._held["anchors"]
        sim.anchored[:] = self._held["anchored"]
        u = self._u.copy()
        u[:, self._arm_u] = np.column_stack([x, y, u[:, self._arm_u[2]] + lift, yaw])
        return u

    def _with_noise(self, reading: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
        noisy = reading + self._noise[:, None, None] * rng.standard_normal(reading.shape)
        grid = self.task.grid
        return noisy.reshape(self.num_envs, len(PADS), grid.rows, grid.cols, 2)

    def _outcome(self) -> tuple[Array, NDArray[np.bool_]]:
        """Height of the lower face's highest corner, and whether the whole face is in the hole."""
        part = self.sim.q[:, self._part_q : self._part_q + 7]
        corners = part[:, None, :3] + np.einsum("nij,kj->nki", _matrices(part[:, 3:]), self._corners)
        height = corners[..., 2].max(1)
        inside = (np.abs(corners[..., :2]) < self._outline + _OUTLINE).all((1, 2))
        return height, inside & (height < self.task.success_height)

    def reward(self) -> Array:
        """Reward of the present poses, shape (N,); see `InsertionTask.reward`."""
        return self.task.reward(self.pose)

    def copy_parts(self, rows: NDArray[np.int64], other: "InsertionAttempts", other_rows: NDArray[np.int64]) -> None:
        """Replace the parts of `rows` by parts of another batch: physics, grasp and pose."""
        self.sim.params[rows] = other.sim.params[other_rows]
        self.pose[rows] = other.pose[other_rows]
        self._noise[rows] = other._noise[other_rows]
        self._stop_shear[rows] = other._stop_shear[other_rows]
        self._u[rows] = other._u[other_rows]
        for name, values in self._held.items():
            values[rows] = other._held[name][other_rows]


def _turned(quat: NDArray[Any], yaw: Array) -> NDArray[Any]:
    """Quaternions (N, 4) turned about the world's z."""
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = quat.T
    return np.column_stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])


def _matrices(quat: NDArray[Any]) -> NDArray[Any]:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4)."""
    w, x, y, z = quat.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
