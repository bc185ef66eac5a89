"""Runs to time, and their accuracy relative to a fully converged reference."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import angles_between
from gelflow.measurement.timing import Workload
from gelflow.sim import _core
from gelflow.sim.scene import Scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

Array = NDArray[np.float64]
SpecFactory = Callable[[], _core.ModelSpec]  # such as `Scene.model_spec`

CONVERGED = 1e-12  # Newton tolerance of the reference
# Newton tolerances of runs timed against other simulators: the loosest ones that meet the bounds below.
TIMED = {"viscous": 2e-4, "elastic": 2e-5}
POSITION, ROTATION, FORCE = 1e-6, 1e-6, 1e-4  # largest differences to the reference: [m], [rad], relative
HOLD = 5  # steps with the same controls, after which tactile forces are evaluated


@dataclass(frozen=True)
class TimedRun:
    """Steps from a start configuration, in blocks of constant controls."""

    q0: Array  # (nq,)
    blocks: tuple[tuple[int, Array, bool], ...]  # steps, controls (nu,), evaluate tactile forces after the block

    @property
    def steps(self) -> int:
        return sum(block[0] for block in self.blocks)

    def start(self, sim: Simulator) -> None:
        """Reset all environments to the start."""
        sim.reset()
        sim.q[:] = self.q0

    def execute(self, sim: Simulator) -> None:
        """Execute the run; tactile forces are written to the simulator's own array."""
        for steps, u, read in self.blocks:
            sim.step(u, steps)
            if read:
                sim.tactile()

    def workload(self, sim: Simulator) -> Workload:
        """The run as a workload; a unit is a step of one environment."""
        return Workload(lambda: self.execute(sim), self.steps * sim.num_envs, lambda: self.start(sim))

    def rollout_workload(self, sim: Simulator) -> Workload:
        """The run as one rollout call that reuses the arrays of a first call; a unit is a step of one environment."""
        controls = np.concatenate([np.tile(u, (steps, 1)) for steps, u, _ in self.blocks])
        u = np.repeat(controls[:, None], sim.num_envs, axis=1)
        ends = np.cumsum([steps for steps, _, _ in self.blocks])
        reads = [int(end) for end, (_, _, read) in zip(ends, self.blocks, strict=True) if read]
        self.start(sim)
        kept = sim.rollout(u, read_after=reads)
        return Workload(lambda: sim.rollout(u, read_after=reads, out=kept), self.steps * sim.num_envs)


def motion_run(scene: Scene, *, steps: int | None = None) -> TimedRun:
    """The reference motion of a scene, or its first `steps`, in blocks of `HOLD` steps."""
    moves = reference_motion(scene)
    u = moves.step_controls(scene.step)[:steps]
    ends = range(HOLD, len(u) + 1, HOLD)
    return TimedRun(moves.q0, tuple((HOLD, u[end - 1], True) for end in ends))


def simulator(
    make_spec: SpecFactory,
    *,
    num_envs: int = 1,
    threads: int | None = 1,
    tolerance: float | None = None,
    precision: Literal["double", "single"] = "double",
) -> Simulator:
    """Simulator of a specification, with its own Newton tolerance or another one."""
    spec = make_spec()
    if tolerance is not None:
        spec.tolerance = tolerance
    return Simulator(_core.Model(spec), num_envs=num_envs, threads=threads, precision=precision)


def converged_reference(sim: Simulator, make_spec: SpecFactory) -> Simulator:
    """A copy of the simulator with the same parameters and a fully converged solver."""
    reference = simulator(make_spec, num_envs=sim.num_envs, threads=None, tolerance=CONVERGED)
    reference.params[:] = sim.params
    return reference


@dataclass(frozen=True)
class AccuracyCheck:
    """Results of a run and its differences to the converged reference."""

    position: float  # largest position difference of a body after any block [m]
    turn: float  # largest rotation difference [rad]
    force: float  # largest norm of a difference of tactile forces over their largest norm
    iterations: float  # Newton iterations per step
    halved: int  # steps that were split into substeps
    end: tuple[float, ...]  # q of the first environment at the end
    force_sum: tuple[float, ...]  # sum over its markers (shear x, shear y, normal) where normal is largest [N]

    @property
    def holds(self) -> bool:
        return self.position <= POSITION and self.turn <= ROTATION and self.force <= FORCE

    def to_dict(self) -> dict[str, Any]:
        """JSON data of the check."""
        return asdict(self) | {"holds": self.holds}

    def violations(self, name: str) -> list[str]:
        """A message if a difference exceeds its bound, else nothing."""
        if self.holds:
            return []
        return [
            f"{name}: {self.position:.1e} m, {self.turn:.1e} rad, {self.force:.1e} of the marker forces away from "
            f"the converged reference; allowed are {POSITION:g} m, {ROTATION:g} rad, {FORCE:g}"
        ]


def check_accuracy(run: TimedRun, sim: Simulator, make_spec: SpecFactory) -> AccuracyCheck:
    """Execute the run together with its reference. Raises SimulationError when a step fails."""
    reference = converged_reference(sim, make_spec)
    position = turn = difference = largest = 0.0
    force_sum: Array = np.zeros(3)
    for one in (sim, reference):
        run.start(one)
    for steps, u, read in run.blocks:
        for one in (sim, reference):
            one.step(u, steps)
        here, there = sim.poses(), reference.poses()
        position = max(position, float(np.linalg.norm(here[..., :3] - there[..., :3], axis=-1).max()))
        turn = max(turn, float(angles_between(here[..., 3:], there[..., 3:]).max()))
        if read:
            forces, exact = sim.tactile(), reference.tactile()
            difference = max(difference, float(np.linalg.norm(forces - exact, axis=(1, 2)).max()))
            largest = max(largest, float(np.linalg.norm(exact, axis=(1, 2)).max()))
            total = forces[0].sum(0)
            force_sum = max(force_sum, total, key=lambda forces: float(forces[2]))
    for one in (sim, reference):
        one.check()
    return AccuracyCheck(
        position=position,
        turn=turn,
        force=difference / largest if largest > 0 else 0.0,
        iterations=float(sim.iterations.mean()) / run.steps,
        halved=int(sim.halved.sum()),
        end=tuple(sim.q[0].tolist()),
        force_sum=tuple(force_sum.tolist()),
    )
