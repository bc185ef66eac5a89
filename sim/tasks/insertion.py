"""Batched simulation of insertion attempts.

The gripper holds a part above a hole, with a misalignment. An attempt lowers the gripper by the task's descent and
records the marker forces; then a policy corrects the gripper's pose, and the next attempt starts. The retreat is not
simulated: each attempt starts from the grasp at rest, placed above the hole at the present gripper pose. The grasp does
not depend on that pose, so it is simulated once per part.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import rotation_matrices
from gelflow.observation import MIN_DIVISORS, normalize
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.parts.geometry import part_geometry
from gelflow.sim.tasks.parts.grasp import indentation, pad_gaps
from gelflow.sim.tasks.parts.part_scene import hole_parameters, with_part
from gelflow.sim.tasks.randomization import Fixed, LogUniform, Quantity, Randomization, Uniform
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, SENSOR_QUANTITIES, SensorModel
from gelflow.task import INSERTION, InsertionTask

Array = NDArray[np.float64]

DESCENT_TIME = (
    0.225  # [s] of an attempt, as in Xu et al. (CoRL 2022): 45 steps of 5 ms, about ten times faster than the robot
)
SETTLE_TIME = 0.120  # [s] until the part is at rest in the closed gripper
ARM_JOINTS = ("arm_x", "arm_y", "arm_z", "arm_yaw")
PADS = ("left", "right")
_CLEAR_HEIGHT = 0.1  # [m] height of the part while the gripper closes, clear of the hole
_OUTLINE_TOLERANCE = 0.3e-3  # [m] penetration of the hole's walls that is allowed for an inserted part

# Relaxation times k_t / k_s of the elastic law: long enough to damp vibration, short enough that a frame of the fast
# simulated descent equals one of the slow descent of the robot.
CONTACT_RELAXATION = 10e-3  # [s]
MARKER_RELAXATION = 5e-3  # [s]

# The ranges of contact, pad and grasp parameters are published (paper, appendix, Table 7). Quantities that the
# published simulator does not have are chosen here.
DEFAULT_RANDOMIZATION = Randomization(
    {
        "pad_kn": Quantity(Uniform(2e3, 1.4e4), "N/m", "contact of pad and part, per point"),
        "pad_mu": Quantity(Uniform(0.5, 2.5), "", "friction of pad and part"),
        "marker_kn": Quantity(Uniform(50.0, 450.0), "N/m", "normal stiffness of a marker"),
        "marker_mu": Quantity(Uniform(0.5, 2.5), "", "friction of a marker"),
        "marker_kd": Quantity(Uniform(0.0, 100.0), "N s/m²", "normal damping of a marker"),
        "hole_kn": Quantity(LogUniform(2.5e3, 2e4), "N/m", "contact of part and hole, per point"),
        "hole_mu": Quantity(Uniform(0.3, 1.5), "", "friction of part and hole, down to printed plastic"),
        "pad_ks": Quantity(LogUniform(100.0, 1000.0), "N/m", "shear stiffness of the pads, soft to stiff", "elastic"),
        "marker_ks": Quantity(LogUniform(50.0, 450.0), "N/m", "shear stiffness of a marker", "elastic"),
        "pad_kt": Quantity(Uniform(20.0, 140.0), "N s/m", "shear damping of the pads", "viscous"),
        "marker_kt": Quantity(Uniform(0.2, 2.3), "N s/m", "shear damping of a marker", "viscous"),
        "arm_stiffness": Quantity(LogUniform(200.0, 3e5), "N/m", "of the arm, published servo to industrial arm"),
        "grasp_force": Quantity(Uniform(2.5, 16.0), "N", "of each finger"),
        "grasp_height": Quantity(Uniform(-10e-3, 5e-3), "m", "of the pad centres above the part's centre"),
        # The robot stops at a marker displacement; the force at that displacement depends on the gel.
        "stop_shear": Quantity(LogUniform(5e-3, 0.1), "N", "mean shear of the markers at which a descent stops"),
        **NO_SENSOR_EFFECTS,
        # From the published 1e-5 N to the noise of image tracking.
        "noise": SENSOR_QUANTITIES["noise"],
        "start_height": Quantity(Fixed(0.2e-3), "m", "half-range of the lower face's start height, per attempt"),
    }
)

# As the default, with the deviations of real pads.
FULL_RANDOMIZATION = Randomization({**DEFAULT_RANDOMIZATION.quantities, **SENSOR_QUANTITIES})

# Fixed parameters of the scene file, with the arm stiffness of a robot; for tests and pictures.
NOMINAL = DEFAULT_RANDOMIZATION.replace(
    pad_kn=8e3,
    pad_mu=1.5,
    marker_kn=250.0,
    marker_mu=1.5,
    marker_kd=25.0,
    hole_kn=5e3,
    hole_mu=1.5,
    pad_ks=250.0,
    marker_ks=150.0,
    pad_kt=80.0,
    marker_kt=1.25,
    arm_stiffness=1e5,
    grasp_force=12.0,
    grasp_height=0.0,
    stop_shear=0.1,
    noise=1e-5,
    start_height=0.0,
)
RANDOMIZATIONS = {"nominal": NOMINAL, "default": DEFAULT_RANDOMIZATION, "full": FULL_RANDOMIZATION}


@dataclass(frozen=True)
class AttemptResult:
    """Results of one attempt in every environment."""

    image: NDArray[np.float32]  # flow maps, shape (N, frames * sensors * 2, rows, cols)
    divisor: Array  # [N], shape (N,): normalization of the flow maps
    height: Array  # [m], shape (N,): highest corner of the part's lower face above the hole's floor
    # Shape (N,): the lower face is inside the hole and below the task's success height, contact did not stop the
    # descent, and no step failed.
    inserted: NDArray[np.bool_]
    failed: NDArray[np.bool_]  # shape (N,): a simulation step failed


def insertion_scene(task: InsertionTask = INSERTION, *, preset: str | None = None, friction: str = "elastic") -> Scene:
    """The insertion scene with the task's part and the marker grid of its observations, which presets do not change."""
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


class InsertionAttempts:
    """`num_envs` grippers, each holding a part above its hole.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    scene: `insertion_scene(task)`, or a scene with the same bodies, actuators and pads
    randomization: distribution of the physical parameters; None: the default, with the grasp height of the task's part
    threads: of the simulator; None uses all available cores. Results do not depend on it.
    steps: simulation steps of a descent; None gives 225 ms

    `pose` (N, 3) holds the gripper poses in the hole's frame: x [m], y [m], yaw [rad]. Write to it between attempts.
    Raises UsageError when the scene does not match the task.
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
        self._steps = max(1, round(DESCENT_TIME / self.scene.step)) if steps is None else steps
        self._settle_steps = max(1, round(SETTLE_TIME / self.scene.step))
        if randomization is None:
            randomization = DEFAULT_RANDOMIZATION.replace(grasp_height=task.part.grasp_height)
        self.randomization = randomization
        if [p.name for p in self.scene.pads] != list(PADS) or any(g != task.grid for g in self.scene.grids):
            raise UsageError(f"the scene's pads must be {', '.join(PADS)} with the task's markers {task.grid}")
        self.sim = Simulator(self.scene, num_envs=num_envs, threads=threads)
        self.num_envs = num_envs
        self._frames = [self._step_at(depth) for depth in task.frame_depths]
        self._reference_at = self._step_at(task.reference_depth)
        self._part_q = self.scene.q("part").start
        self._arm_q = [self.scene.q(name).start for name in ARM_JOINTS]
        self._arm_u = [self.scene.u(name) for name in ARM_JOINTS]
        self._geometry = part_geometry(task.part)
        self._corners = self._geometry.lower_face
        self._hole = self._geometry.hole
        self._clear_height = max(_CLEAR_HEIGHT, task.part.depth + task.part.size[2])
        self.pose: Array = np.zeros((num_envs, 3))
        self._sensors = SensorModel([pad.positions for pad in self.scene.pads], num_envs)
        self._start_height: Array = np.zeros(num_envs)  # half-range of the start height per attempt [m]
        self._stop_shear: Array = np.full(num_envs, np.inf)
        # The grasp at rest: controls, state and shear forces.
        self._u: Array = np.zeros((num_envs, self.scene.nu))
        self._grasp: dict[str, NDArray[Any]] = {
            "q": self.sim.q.copy(),
            "anchors": self.sim.anchors.copy(),
            "anchored": self.sim.anchored.copy(),
            "tactile": np.zeros((num_envs, self.scene.num_markers, 2)),
        }
        # Shear forces of the present attempt, and their copies after the steps at which a frame is due.
        self._shear = np.zeros_like(self._grasp["tactile"])
        self._frame_shear = {step: np.zeros_like(self._shear) for step in (self._reference_at, *self._frames)}

    def _step_at(self, depth: float) -> int:
        """Number of steps after which the gripper's target is `depth` [m] below its start."""
        if not 0 <= depth <= self.task.descent * (1 + 1e-9):
            raise UsageError(f"frame depth {depth} m is outside the descent of {self.task.descent} m")
        return int(np.ceil(depth / self.task.descent * self._steps - 1e-6))

    def draw(self, rng: np.random.Generator, *, misalignment: Array | None = None) -> None:
        """Start new parts in all environments.

        Physics and grasp come from the randomization, `pose` from the task unless `misalignment` (N, 3) is given.
        """
        sampled = self.randomization.sample(rng, self.num_envs, friction=self.scene.friction)
        params = simulator_parameters(sampled, elastic=self.scene.friction == "elastic")
        for name, values in hole_parameters(self.scene, params).items():
            self.sim.param(name)[:] = values
        self._stop_shear, self._start_height = sampled["stop_shear"], sampled["start_height"]
        self.pose = self.task.draw_misalignment(rng, self.num_envs)
        if misalignment is not None:
            self.pose = np.array(np.broadcast_to(misalignment, self.pose.shape), dtype=float)
        self._close(sampled["grasp_force"], sampled["grasp_height"])
        self._sensors.draw(np.ones(self.num_envs, dtype=bool), sampled, rng)

    def _close(self, force: Array, height: Array) -> None:
        """Close the grippers on their parts, far above the holes, and store the state at rest."""
        sim, scene = self.sim, self.scene
        sim.reset()
        sim.q[:] = scene.q0
        sim.q[:, self._part_q + 2] = self._clear_height
        sim.q[:, self._arm_q[2]] = self._clear_height + height
        for finger, pad in (("finger_left", "pad_left"), ("finger_right", "pad_right")):
            gaps = pad_gaps(scene, self._geometry, pad, height)
            sim.q[:, scene.q(finger)] += indentation(gaps, force, sim.param(f"{pad}.kn"))[:, None]
            self._u[:, scene.u(finger)] = force
        # The left jaw holds its position; the right one is force controlled.
        self._u[:, scene.u("hold_left")] = sim.q[:, scene.q("finger_left").start]
        sim.param("hold_right.kp")[:] = 0
        sim.param("hold_right.kd")[:] = 0
        self._u[:, self._arm_u] = sim.q[:, self._arm_q]
        weight = -scene.gravity[2] * sum(sim.param(f"{body.name}.mass") for body in scene.bodies)
        self._u[:, self._arm_u[2]] += weight / sim.param("arm_z.kp")  # gravity compensation
        sim.step(self._u, self._settle_steps)
        self._grasp["q"][:] = sim.q
        self._grasp["anchors"][:] = sim.anchors
        self._grasp["anchored"][:] = sim.anchored
        self._grasp["tactile"][:] = sim.tactile()[..., :2]

    def attempt(self, rng: np.random.Generator) -> AttemptResult:
        """Simulate one attempt in every environment, starting from `pose`.

        As on the robot, contact stops the descent: later frames repeat the forces at the stop.
        """
        sim, z = self.sim, self._arm_u[2]
        u = self._start(rng)
        start = u[:, z].copy()
        shear = self._shear
        shear[:] = self._grasp["tactile"]
        frames = self._frame_shear
        if 0 in frames:
            frames[0][:] = shear
        stopped = np.zeros(self.num_envs, dtype=bool)
        for step in range(1, self._steps + 1):
            u[:, z] = start - self.task.descent * step / self._steps
            sim.step(u)
            np.copyto(shear, sim.tactile()[..., :2], where=~stopped[:, None, None])
            if step in frames:
                frames[step][:] = shear
            if step > self._reference_at:
                stopped |= self._mean_shear(shear - frames[self._reference_at]) > self._stop_shear
        readings = self._readings(frames, rng)
        stack = np.stack([readings[step] for step in self._frames], axis=1)
        image, divisor = normalize(stack, readings[self._reference_at], min_divisor=MIN_DIVISORS["N"])
        height, inserted = self._outcome()
        failed = sim.status != 0
        inserted &= ~failed & ~stopped
        return AttemptResult(image.astype(np.float32), divisor, height, inserted, failed)

    def _mean_shear(self, change: NDArray[Any]) -> Array:
        """Mean change of the shear along the finger, maximum over the pads [N], shape (N,)."""
        along = change[..., 0].reshape(self.num_envs, len(PADS), -1)
        return np.asarray(np.abs(along.mean(2)).max(1))

    def _start(self, rng: np.random.Generator) -> Array:
        """Set the state to the grasp at `pose`, the lower face at its start height; returns the controls."""
        sim, at = self.sim, self._part_q
        grasp = self._grasp["q"]
        sim.reset()
        part = grasp[:, at : at + 7]
        jitter = rng.uniform(-1, 1, self.num_envs) * self._start_height
        lift = self.task.start_height + jitter - (part[:, 2] - self.task.part.size[2] / 2)
        x, y, yaw = self.pose.T
        cos, sin = np.cos(yaw), np.sin(yaw)
        sim.q[:] = grasp
        sim.q[:, self._arm_q] = np.column_stack([x, y, grasp[:, self._arm_q[2]] + lift, yaw])
        sim.q[:, at] = x + cos * part[:, 0] - sin * part[:, 1]
        sim.q[:, at + 1] = y + sin * part[:, 0] + cos * part[:, 1]
        sim.q[:, at + 2] = part[:, 2] + lift
        sim.q[:, at + 3 : at + 7] = _rotated_z(part[:, 3:], yaw)
        sim.anchors[:] = self._grasp["anchors"]
        sim.anchored[:] = self._grasp["anchored"]
        u = self._u.copy()
        u[:, self._arm_u] = np.column_stack([x, y, u[:, self._arm_u[2]] + lift, yaw])
        return u

    def _readings(self, frames: Mapping[int, Array], rng: np.random.Generator) -> dict[int, Array]:
        """Readings of the pads after the given numbers of steps, (N, pads, rows, cols, 2) each."""
        everyone, grid = np.ones(self.num_envs, dtype=bool), self.task.grid
        self._sensors.clear(everyone)
        readings, last = {}, 0
        for step in sorted(frames):
            reading = self._sensors.read(frames[step], everyone, rng, interval=(step - last) * self.scene.step)
            readings[step] = reading.reshape(self.num_envs, len(PADS), grid.rows, grid.cols, 2)
            last = step
        return readings

    def _outcome(self) -> tuple[Array, NDArray[np.bool_]]:
        """Height of the highest corner of the part's lower face [m], and whether the face is inside the hole."""
        part = self.sim.q[:, self._part_q : self._part_q + 7]
        corners = part[:, None, :3] + np.einsum("nij,kj->nki", rotation_matrices(part[:, 3:]), self._corners)
        height = corners[..., 2].max(1)
        inside = (self._hole.distance(corners[..., :2]) < _OUTLINE_TOLERANCE).all(1)
        return height, inside & (height < self.task.success_height)

    def reward(self) -> Array:
        """Reward of the present poses, shape (N,); see `InsertionTask.reward`."""
        return self.task.reward(self.pose)

    def copy_parts(self, rows: NDArray[np.int64], other: "InsertionAttempts", other_rows: NDArray[np.int64]) -> None:
        """Copy parts (physics, grasp and pose) from `other_rows` of another batch to `rows`."""
        self.sim.params[rows] = other.sim.params[other_rows]
        self.pose[rows] = other.pose[other_rows]
        self._start_height[rows] = other._start_height[other_rows]
        self._sensors.copy(rows, other._sensors, other_rows)
        self._stop_shear[rows] = other._stop_shear[other_rows]
        self._u[rows] = other._u[other_rows]
        for name, values in self._grasp.items():
            values[rows] = other._grasp[name][other_rows]


def _rotated_z(quat: NDArray[Any], yaw: Array) -> NDArray[Any]:
    """Quaternions (N, 4) rotated by `yaw` (N,) [rad] about the world's z axis."""
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = quat.T
    return np.column_stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])


def simulator_parameters(sampled: Mapping[str, Array], *, elastic: bool) -> dict[str, Array]:
    """Parameters of the simulator, name → (n,), for sampled quantities."""
    pad = {"kn": sampled["pad_kn"], "mu": sampled["pad_mu"]}
    marker = {"kn": sampled["marker_kn"], "mu": sampled["marker_mu"], "kd": sampled["marker_kd"]}
    hole = {"kn": sampled["hole_kn"], "mu": sampled["hole_mu"]}
    if elastic:
        pad["ks"], marker["ks"], hole["ks"] = sampled["pad_ks"], sampled["marker_ks"], hole["kn"] / 2
        pad["kt"], marker["kt"] = CONTACT_RELAXATION * pad["ks"], MARKER_RELAXATION * marker["ks"]
    else:
        pad["kt"], marker["kt"] = sampled["pad_kt"], sampled["marker_kt"]
    params = {f"pad_{side}.{key}": values for side in PADS for key, values in pad.items()}
    params |= {f"{side}.{key}": values for side in PADS for key, values in marker.items()}
    walls = ("left", "right", "front", "back")
    params |= {f"part_hole/wall_{wall}.{key}": values for wall in walls for key, values in hole.items()}
    # Published ratios to the stiffness: damping 1/200 s, yaw servo 0.05 m².
    for arm, scale in zip(ARM_JOINTS, (1.0, 1.0, 1.0, 0.05), strict=True):
        params[f"{arm}.kp"] = sampled["arm_stiffness"] * scale
        params[f"{arm}.kd"] = sampled["arm_stiffness"] * scale / 200
    return params
