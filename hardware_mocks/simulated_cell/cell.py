"""The simulated cell behind the mock robot: the insertion scene with elastic friction, stepped on the robot's clock.

It is the plant of all mocks (gripper, arm, gels) and it simulates the operator, who presents a part between the open
fingers, holds it until it is gripped, and removes it after its release. The true hole pose differs from the taught
one by a random misalignment for every part; `truth` returns it, the devices do not.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.geometry import Pose, conjugate, rotate, yaw_quaternion
from gelflow.hardware_mocks.simulated_cell.cell_physics import CellPhysics, pad_overrides
from gelflow.hardware_mocks.simulated_cell.gripper_drive import GripperDrive
from gelflow.hardware_mocks.simulated_cell.insertion_progress import InsertionMonitor, InsertionProgress
from gelflow.hardware_mocks.simulated_cell.part_truth import PartTruth, SlipMonitor, is_inside
from gelflow.hardware_mocks.simulated_cell.world import Friction, World, training_world
from gelflow.observation import Grid, interpolation_weights
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.parts import part_geometry, with_part
from gelflow.task import INSERTION, InsertionTask
from gelflow.time_sync import MAX_LEAD, MIN_WAIT, SIMULATED_CELL

Array = NDArray[np.float64]
_PARKED_POSE = np.array([0.0, 0.5, 1.0, 1.0, 0.0, 0.0, 0.0])  # of a part that is not in use [m], w x y z
_LOAD_ABOVE_RIM = 7e-3  # of a presented part's lower face [m]
_OPENING = 25e-3  # of the open fingers beyond the part [m]
_TRUTH_PERIOD = 0.016  # of measurements of a gripped part's slip [s]
_AT_REST = (2e-5, math.radians(0.02))  # largest motion of a tool at rest [m, rad]


@dataclass(frozen=True)
class SimulatedCellConfig:
    """Parameters of the simulated cell. Lengths in metres, angles in radians, times in robot time."""

    world: World = field(default_factory=World)
    hole: Pose = field(default_factory=lambda: Pose(np.array([0.374, 0.05, 0.05]), yaw_quaternion(0.0)))
    tool: Pose = field(default_factory=lambda: Pose(np.array([0.0, 0.0, 0.18]), np.array([0.0, 1.0, 0.0, 0.0])))
    grasp_height: float = 0.030  # of the pad centres above the part's lower face [m]
    load_height: float = 0.032  # of the lower face above the hole's floor when the operator presents a part [m]
    height_error: float = 0.2e-3  # largest height error of a presented part [m]
    step: float = 4e-3  # time step of the simulation [s]; must divide EGM's 4 ms
    start_width: float = 0.060  # between the fingers [m]
    seed: int = 0  # of the first part; incremented for each further part
    preset: str | None = None  # of the insertion scene, except for its step: see `preset_config`
    task: InsertionTask = INSERTION

    def __post_init__(self) -> None:
        if not 0 < self.step <= 4e-3 or abs(4e-3 / self.step - round(4e-3 / self.step)) > 1e-9:
            raise UsageError(f"the time step of the simulated cell must divide 4 ms, got {self.step} s")

    @property
    def grid(self) -> Grid:
        """The grid of the markers printed on the gels [mm]."""
        return self.world.markers.grid

    @property
    def taught_hole(self) -> Pose:
        """The taught pose of the hole in the base frame; `hole` is the true one."""
        return self.hole @ self.world.taught_error.pose

    def start_tool(self) -> tuple[Array, Array]:
        """Initial tool pose, with the gripper ready to be loaded: position [m] and quaternion w x y z."""
        above = Pose(np.array([0.0, 0.0, self.load_height + self.grasp_height]), yaw_quaternion(0.0))
        pose = self.taught_hole @ above @ self.tool.inverse()
        return pose.position, pose.quaternion


def preset_config(
    preset: str | None, *, seed: int, world: World | None = None, task: InsertionTask = INSERTION
) -> SimulatedCellConfig:
    """The cell with a preset of the insertion scene; its step is the longest that divides 4 ms and is not longer.

    Heights and widths follow from the task's part. Raises UsageError when there is no such preset.
    """
    part = task.part
    config = SimulatedCellConfig(
        seed=seed,
        world=world or training_world(part),
        grasp_height=round(part.size[2] / 2 + float(np.clip(0.0, *part.grasp_height)), 9),
        load_height=round(part.depth + _LOAD_ABOVE_RIM, 9),
        start_width=round(part.grasp_width + _OPENING, 9),
        task=task,
    )
    if preset is None:
        return config
    step = load_scene("insertion", preset=preset).step
    return replace(config, preset=preset, step=4e-3 / math.ceil(4e-3 / step - 1e-9))


class SimulatedCell:
    """The simulated cell. All plant methods may be called from any thread."""

    def __init__(self, clock: ScaledClock, config: SimulatedCellConfig | None = None) -> None:
        self.config = config = config or SimulatedCellConfig()
        self._clock, self._task = clock, config.task
        part = replace(config.task.part, clearance=config.world.hole.clearance)
        self._geometry = part_geometry(part)
        if part.hole_mesh and part.clearance != config.task.part.clearance:
            raise UsageError("the hole of this part is a mesh, whose clearance a world cannot change")
        # The walls of a box's hole are moved by `CellPhysics`.
        with_hole = config.task.part if part.shape == "box" else part
        overrides = {"step": config.step, **pad_overrides(config.world)}
        scene = load_scene("insertion", preset=config.preset, friction="elastic", overrides=overrides)
        scene = with_part(scene, with_hole)
        self._sim = sim = Simulator(scene, threads=1)
        self._physics = CellPhysics(sim, config.world, self._geometry.hole)
        self._arm = [sim.joint_q(name) for name in ("arm_x", "arm_y", "arm_z", "arm_yaw")]
        self._part = sim.joint_q("part")
        self._part_v = sim.joint_v("part")
        self._pads = [scene.marker_slice("left"), scene.marker_slice("right")]
        self._weights = [interpolation_weights(grid, config.grid.positions()) for grid in scene.grids]
        self._u = np.zeros(sim.model.nu)
        self._arm_u = [scene.u(name) for name in ("arm_x", "arm_y", "arm_z", "arm_yaw")]
        self._gripper = GripperDrive(sim, scene, self._u, width=config.start_width, closed_on=part.grasp_width)
        self._lock = threading.Lock()
        self._time = clock.now()
        self._still_since = self._time
        self._next_seed = config.seed
        self._hole_to_base = config.hole.inverse()
        self._to_scene = self._hole_to_base  # including the misalignment of the present part
        self._held_pose: Array | None = _PARKED_POSE
        self.parts: list[PartTruth] = []
        self._current: PartTruth | None = None
        self._slip: SlipMonitor | None = None  # while a part is gripped
        self._progress = InsertionMonitor(config.task)
        self._taught_to_base = config.taught_hole.inverse()
        self._height = 0.0  # of the gripper's lower face above the taught hole [m]
        self._truth_due = 0.0  # time of its next measurement [s]
        contacts = enumerate(sim.model.contact_names)
        self._hole_contacts = [i for i, name in contacts if name.startswith(("part_hole", "part_floor"))]
        self._tool = self._rest = self._start = Pose(*config.start_tool())
        self._height = self._gripper_height()
        self._reset_arm()
        self._hold_part()

    # Simulation loop

    def run(self, ending: threading.Event, *, after_step: Callable[[], None] = lambda: None) -> None:
        """Step on the clock until `ending` is set. Raises SimulationError when the simulation fails.

        With time synchronization, robot time waits when this computer cannot simulate as fast.
        """
        step = self.config.step
        self._time = self._clock.now()
        while not ending.is_set():
            self._clock.absorb_delay()
            self._clock.grant(SIMULATED_CELL, self._time + step + MAX_LEAD)
            behind = self._clock.now() - self._time
            if behind < step:
                ending.wait(max(self._clock.wall(step - behind), MIN_WAIT))
                continue
            with self._lock:
                self._step()
            after_step()

    def advance(self, steps: int) -> None:
        """Take `steps` simulation steps without a clock."""
        with self._lock:
            for _ in range(steps):
                self._step()

    # ArmPlant

    def arm_pose(self) -> tuple[Array, Array]:
        """Tool pose measured by the encoders: the commanded pose, because the arm's compliance is behind them."""
        with self._lock:
            return self._tool.position.copy(), self._tool.quaternion.copy()

    def command_arm(self, position: Array, quaternion: Array) -> None:
        """Follow this pose from now on: position [m], shape (3,); quaternion w x y z, shape (4,)."""
        pose = Pose(np.array(position, dtype=float), np.array(quaternion, dtype=float))
        if not (np.isfinite(pose.position).all() and np.isfinite(pose.quaternion).all()):
            raise UsageError(f"the arm cannot move to {pose}")
        with self._lock:
            if not pose.is_near(self._rest, *_AT_REST):
                self._rest, self._still_since = pose, self._time
            if not pose.is_near(self._start, *_AT_REST):
                self._progress.note_command(self._time)
            self._tool = pose
            self._height = self._gripper_height()
            self._u[self._arm_u] = self._in_scene()

    # GripperPlant

    def gripper_state(self) -> tuple[float, float, float]:
        """Width between the fingers [m], speed [m/s, positive opens], pressing force [N]."""
        with self._lock:
            return self._gripper.state()

    def command_gripper(self, *, width: float, speed: float, force: float) -> None:
        """Move towards `width` [m] at `speed` [m/s], pushing with at most `force` [N]."""
        with self._lock:
            self._progress.note_command(self._time)
            self._gripper.command(width=width, speed=speed, force=force)

    # GelPlant

    def marker_displacement(self, finger: int) -> Array:
        """Displacement of the printed markers [mm], shape (markers, 2)."""
        return np.asarray(self.displacements()[finger])

    def displacements(self) -> Array:
        """Displacement of the printed markers on both pads [mm], shape (2, markers, 2)."""
        with self._lock:
            forces = self._layer_forces() if self.config.world.gels.file else None
            moved = 1e3 * self._sim.displacement(forces)[0]
            compliance = self._physics.gel_compliance
        pads = zip(self._weights, self._pads, compliance, strict=True)
        return np.stack([weights @ (soft * moved[pad, :2]) for weights, pad, soft in pads])

    # Ground truth, not available to the devices

    def next_seed(self, seed: int) -> None:
        """Set the seed of the next part that the operator presents."""
        with self._lock:
            self._next_seed = seed

    def truth(self) -> dict[str, Any]:
        """Ground truth as plain data: the parts, robot time and its delay [s], position of tool and fingers [m].

        `pad_forces` are the forces of the part on the left and the right pad [N]: to the tip of the finger, across it
        and into the pad.
        """
        with self._lock:
            if self._current is not None:
                self._measure(self._current)
            return {
                "part": None if self._current is None else asdict(self._current),
                "parts": [asdict(part) for part in self.parts],
                "time": self._time,
                "tool": self._tool.position.tolist(),
                "width": self._gripper.width(),
                "waited": self._clock.delay,
                "pad_forces": self._pad_forces(),
                "pads": [float(np.abs(self._sim.tactile()[0, pad, :2]).max()) for pad in self._pads],
            }

    def progress(self) -> InsertionProgress:
        """Progress of the insertion of the present part."""
        with self._lock:
            return replace(self._progress.progress)

    def change_world(self, *, gel_stiffness: float, pad_friction: float) -> None:
        """Multiply the stiffness of both gels and the friction of the pads by these factors of the world's values."""
        world = self.config.world
        gels = replace(world.gels, left=world.gels.left * gel_stiffness, right=world.gels.right * gel_stiffness)
        friction = Friction(world.friction.pads * pad_friction, world.friction.hole, world.friction.floor)
        with self._lock:
            self._physics.apply(replace(world, gels=gels, friction=friction))

    # Internal; the caller holds the lock

    def _layer_forces(self) -> Array:
        """Forces on the cells of elastic gels, whose sums are the forces of the pads, (1, markers, 3) [N].

        Markers and contact points sample the part differently; the difference of the sums is spread like the pressure.
        """
        forces = np.array(self._sim.tactile())
        for pad, total in zip(self._pads, self._pad_forces(), strict=True):
            pressure = forces[0, pad, 2]
            if pressure.sum() > 0:
                forces[0, pad] += np.outer(pressure / pressure.sum(), total - forces[0, pad].sum(axis=0))
        return forces

    def _pad_forces(self) -> list[list[float]]:
        """See `truth`."""
        wrenches, poses, names = self._sim.wrenches()[0], self._sim.site_poses()[0], self._sim.model.contact_names
        sites = [site.name for site in self._sim.scene.sites]
        forces = []
        for pad in ("pad_left", "pad_right"):
            total = wrenches[[name.startswith(pad) for name in names], 3:].sum(axis=0)
            x, y, z = rotate(conjugate(poses[sites.index(pad), 3:]), total)
            forces.append([float(x), float(y), -float(z)])  # z of the site points out of the pad
        return forces

    def _gripper_height(self) -> float:
        gripper = self._taught_to_base @ (self._tool @ self.config.tool)
        return float(gripper.position[2]) - self.config.grasp_height

    def _in_scene(self) -> Array:
        """Positions of the arm's four joints in the scene for the present tool pose: x, y, z [m], yaw [rad]."""
        gripper = self._to_scene @ (self._tool @ self.config.tool)
        return np.array([*gripper.position, gripper.yaw])

    def _reset_arm(self) -> None:
        self._u[self._arm_u] = self._sim.q[0, self._arm] = self._in_scene()
        self._sim.v[0] = 0.0

    def _hold_part(self) -> None:
        if self._held_pose is not None:
            self._sim.q[0, self._part : self._part + 7] = self._held_pose
            self._sim.v[0, self._part_v : self._part_v + 6] = 0.0
            # Clear the part's history of BDF2: no displacement and zero velocity in the previous step.
            if self._sim.history.size:
                for first in (0, self._sim.model.nv):
                    self._sim.history[0, first + self._part_v : first + self._part_v + 6] = 0.0

    def _step(self) -> None:
        self._time += self.config.step
        self._gripper.drive(self.config.step)
        self._sim.step(self._u)
        self._sim.check()
        self._hold_part()
        self._update_operator()
        self._progress.update(self._time, "none" if self._current is None else self._current.phase, self._height)

    def _update_operator(self) -> None:
        """Simulate the operator: present a part, let it go when it is gripped, remove it after its release."""
        part = self._current
        if part is None:
            if self._ready_to_load():
                self._present_part()
        elif part.phase == "presented":
            if self._gripper.locked:
                self._held_pose, part.phase = None, "gripped"
                self._slip = SlipMonitor(part, gripper=self._gripper_pose(), part=self._part_pose())
        elif part.phase == "gripped":
            if not self._gripper.locked:
                self._measure(part)
                part.phase, self._slip = "released", None
            elif self._time >= self._truth_due:
                self._truth_due = self._time + _TRUTH_PERIOD - 1e-9
                self._monitor_slip()
        elif self._ready_to_load():
            self._held_pose, self._current = _PARKED_POSE, None

    def _ready_to_load(self) -> bool:
        """Whether the fingers are open and the arm is at rest at the hand-over pose."""
        open_wide = self._gripper.width() > self._geometry.part.grasp_width + 0.005
        there = self._tool.is_near(self._start, 1e-3, math.radians(1.0))
        return open_wide and there and self._time - self._still_since > 0.3

    def _present_part(self) -> None:
        """Sample the misalignment of the next part and hold the part between the fingers."""
        rng = np.random.default_rng((self._next_seed, 0x6E1))
        x, y, yaw = self._task.draw_misalignment(rng, 1)[0]
        misaligned = Pose(np.array([x, y, 0.0]), yaw_quaternion(yaw))
        self._to_scene = misaligned @ self._hole_to_base
        self._reset_arm()
        gx, gy, gz, turn = self._in_scene()
        z = (
            gz
            - self.config.grasp_height
            + self._geometry.part.size[2] / 2
            + rng.uniform(-1, 1) * self.config.height_error
        )
        self._held_pose = np.array([gx, gy, z, *yaw_quaternion(turn)])
        self._hold_part()
        self._sim.clear_history()
        taught = misaligned @ self.config.world.taught_error.pose
        where = (float(taught.position[0]), float(taught.position[1]), taught.yaw)
        self._current = PartTruth(self._next_seed, where)
        self.parts.append(self._current)
        self._next_seed += 1

    def _part_pose(self) -> Pose:
        q = self._sim.q[0, self._part : self._part + 7]
        return Pose(q[:3].copy(), q[3:].copy())

    def _gripper_pose(self) -> Pose:
        x, y, z, yaw = (float(v) for v in self._sim.q[0, self._arm])
        return Pose(np.array([x, y, z]), yaw_quaternion(yaw))

    def _monitor_slip(self) -> None:
        assert self._slip is not None
        force = np.linalg.norm(self._sim.wrenches()[0, self._hole_contacts, 3:].sum(axis=0))
        self._slip.update(
            self._time, tool=self._tool, gripper=self._gripper_pose(), part=self._part_pose(), force=float(force)
        )

    def _measure(self, part: PartTruth) -> None:
        """Update the ground truth of a part until its release, so that it describes the pose reached by the robot."""
        if part.phase == "released":
            return
        pose = self._part_pose()
        corners = pose.apply(self._geometry.lower_face)
        part.x, part.y = float(pose.position[0]), float(pose.position[1])
        part.yaw, part.height = pose.yaw, float(corners[:, 2].max())
        slip = self._gripper_pose().inverse() @ pose
        part.slip = float(slip.position[0]), float(slip.position[1]), slip.yaw
        inside = is_inside(corners, self._geometry.hole)
        part.inserted = part.phase == "gripped" and inside and part.height < self._task.success_height
