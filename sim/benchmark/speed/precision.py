"""Single against double precision: errors of motions, tactile forces and gradients, and the speed-up."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import angles_between
from gelflow.measurement.timing import BenchmarkOptions, Report, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.speed.timed_run import HOLD, motion_run, simulator
from gelflow.sim.scene import FRICTION_LAWS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import SCENES, reference_motion

Array = NDArray[np.float64]

READ_EVERY = 4 * HOLD  # steps


@dataclass(frozen=True)
class _Motion:
    """A recorded motion."""

    poses: Array  # (reads, bodies, 7)
    tactile: Array  # (reads, markers, 3)
    gradient: Array  # of all forces with random weights, with respect to the controls (steps, nu)


def measure_precision(options: BenchmarkOptions) -> Report:
    """Compare precisions on all scenes and friction laws, forward and backward."""
    cases = [(name, law) for name in SCENES for law in FRICTION_LAWS]
    steps = 4 * READ_EVERY if options.quick else None
    workloads, found = [], []
    for name, law in cases:
        scene = load_scene(name, friction=law)
        run = motion_run(scene, steps=steps)
        double, single = (_record(scene, precision, steps) for precision in ("double", "single"))
        found.append(_differences(single, double))
        for precision in ("double", "single"):
            workloads.append(run.workload(simulator(scene.model_spec, precision=precision)))
    options.progress.begin("precision", len(workloads) * (options.repeats + 1))
    timings = time_interleaved(workloads, options)
    rows, results = [], []
    for (name, law), apart, double_times, single_times in zip(cases, found, timings[::2], timings[1::2], strict=True):
        ratio = speedup(single_times, double_times)
        errors = (f"{value:.0e}" for value in apart.values())
        rows.append((name, law, *errors, f"{single_times.rate:.0f}", f"{ratio:.2f}"))
        results.append(
            {"scene": name, "friction": law, **apart, "single": single_times.to_dict(), "times_double": ratio}
        )
    return Report(
        name="precision",
        title="Single against double precision: a whole motion",
        columns=("scene", "friction", "m", "rad", "readings", "gradient", "steps/s", "× double"),
        rows=rows,
        note="m, rad: largest difference of a body's position and orientation. readings: largest norm of a difference "
        f"of tactile forces over their largest norm. gradient: of the forces every {READ_EVERY} steps with random "
        "weights, with respect to all controls, relative. Gradients are computed in double, at the states of single "
        "precision, except for the share of viscous marker forces." + load_note(timings),
        results=results,
        violations=[],
    )


def _record(scene: Scene, precision: Any, steps: int | None) -> _Motion:
    moves, sim = reference_motion(scene), Simulator(scene, threads=1, precision=precision)
    u = moves.step_controls(scene.step)[:steps]
    sim.q[:] = moves.q0
    run = sim.rollout(u[:, None], read_after=tuple(range(READ_EVERY, len(u) + 1, READ_EVERY)))
    weights = np.random.default_rng(0).normal(size=run.tactile.shape)
    gradient = sim.rollout_gradient(run, tactile=weights).u[:, 0]
    poses = []
    for at in run.read_after:
        sim.q[:] = run.q[at]
        poses.append(sim.poses()[0].astype(float))
    return _Motion(np.array(poses), run.tactile[:, 0].astype(float), gradient.astype(float))


def _differences(single: _Motion, double: _Motion) -> dict[str, float]:
    """Largest differences: positions [m], rotations [rad], and relative ones of tactile forces and gradient."""
    norms = np.linalg.norm(double.tactile, axis=(1, 2))
    return {
        "position": float(np.linalg.norm(single.poses[..., :3] - double.poses[..., :3], axis=-1).max()),
        "turn": float(angles_between(single.poses[..., 3:], double.poses[..., 3:]).max()),
        "readings": float(np.linalg.norm(single.tactile - double.tactile, axis=(1, 2)).max() / norms.max()),
        "gradient": float(np.linalg.norm(single.gradient - double.gradient) / np.linalg.norm(double.gradient)),
    }
