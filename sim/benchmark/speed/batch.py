"""Speed of batches: scaling with the number of environments and with the number of cores."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gelflow.measurement.machine import cores
from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.speed.timed_run import AccuracyCheck, check_accuracy, motion_run, simulator
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

SIZES = (1, 2, 4, 16, 64, 256, 1024)
QUICK_SIZES = SIZES[:4]
LARGEST_ROLLOUT = 64  # a rollout stores every state: larger ones would measure memory
SCENE = "insertion"
STEPS = 30
SLEEP_DELAY = 3e-3  # idle worker threads of another simulator sleep after this time [s]

Key = tuple[str, int, int | None]  # "step" or "rollout", environments, threads: None all, 1 one, 0 a single environment


def perturb_stiffness(sim: Simulator) -> None:
    """Scale the stiffness of each contact by up to ±5 %, differently in all environments except the first."""
    rng = np.random.default_rng(0)
    for name in sim.param_index:
        if name.endswith(".kn"):
            sim.param(name)[1:] *= rng.uniform(0.95, 1.05, sim.num_envs - 1)


def warmed_up(make: Callable[[Simulator], Workload], sim: Simulator) -> Workload:
    """The workload in the state of a running loop: other threads asleep, the simulator's own threads awake."""
    workload = make(sim)

    def prepare() -> None:
        time.sleep(SLEEP_DELAY)
        workload.prepare()
        workload.run()
        workload.prepare()

    return replace(workload, prepare=prepare)


def measure_batch(options: BenchmarkOptions, *, sizes: Sequence[int] | None = None, steps: int = STEPS) -> Report:
    """Time the first steps of the insertion motion for several batch sizes, on one core and on all cores."""
    sizes = sizes or (QUICK_SIZES if options.quick else SIZES)
    workloads, checks = _workloads(sizes, steps)
    options.progress.begin("batch", len(workloads) * (options.repeats + 1))
    timings = dict(zip(workloads, time_interleaved(list(workloads.values()), options), strict=True))
    rows, results, violations = [], [], []
    for size in sizes:
        row, result = _compare(size, timings)
        rows.append(row)
        results.append(result | {"check": checks[size].to_dict()})
        violations += checks[size].violations(f"batch of {size}")
    step, rollout = timings["step", 1, 0], timings["rollout", 1, 0]
    return Report(
        name="batch",
        title=f"Batches of {SCENE}: environment steps per second",
        columns=("N", "1 core", f"{cores()} cores", "speed-up", "per core: 1", f"{cores()}", "rollout", "CPU/s"),
        rows=rows,
        note=f"{steps} steps; controls change and tactile forces are evaluated every 5 steps, each a Python call. per "
        f"core: rate relative to a single environment ({step.rate:.0f}/s); rollout: the same for one rollout call "
        f"({rollout.rate:.0f}/s alone). CPU/s: processor seconds per second on all cores."
        + load_note([timing for (_, _, threads), timing in timings.items() if threads is not None]),
        results=results,
        violations=violations,
    )


def _workloads(sizes: Sequence[int], steps: int) -> tuple[dict[Key, Workload], dict[int, AccuracyCheck]]:
    """The workloads of all sizes, and the accuracy of each batch."""
    scene = load_scene(SCENE)
    run = motion_run(scene, steps=steps)

    def batch(size: int, threads: int | None) -> Simulator:
        sim = simulator(scene.model_spec, num_envs=size, threads=threads)
        perturb_stiffness(sim)
        return sim

    workloads: dict[Key, Workload] = {
        ("step", 1, 0): warmed_up(run.workload, batch(1, 1)),
        ("rollout", 1, 0): warmed_up(run.rollout_workload, batch(1, 1)),
    }
    checks = {}
    for size in sizes:
        all_cores = batch(size, None)
        checks[size] = check_accuracy(run, all_cores, scene.model_spec)
        workloads["step", size, 1] = warmed_up(run.workload, batch(size, 1))
        workloads["step", size, None] = warmed_up(run.workload, all_cores)
        if size <= LARGEST_ROLLOUT:
            workloads["rollout", size, None] = warmed_up(run.rollout_workload, batch(size, None))
    return workloads, checks


def _compare(size: int, timings: Mapping[Key, Timing]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Table row and record of one batch size."""
    used, one, all_cores = min(size, cores()), timings["step", size, 1], timings["step", size, None]
    share = {
        "one": speedup(one, timings["step", 1, 0]),
        "all": speedup(all_cores, timings["step", 1, 0]) / used,
    }
    if ("rollout", size, None) in timings:
        share["rollout"] = speedup(timings["rollout", size, None], timings["rollout", 1, 0]) / used
    ratio = speedup(all_cores, one)
    row = (
        *(f"{size}", f"{one.rate:.0f}", f"{all_cores.rate:.0f}", f"{ratio:.2f}"),
        *(f"{share[how]:.2f}" if how in share else "" for how in ("one", "all", "rollout")),
        f"{all_cores.cpu_share:.2f}",
    )
    result = {
        "environments": size,
        "one_core": one.to_dict(),
        "all_cores": all_cores.to_dict(),
        "cores": used,
        "speed_up": ratio,
        "per_core_of_one_alone": share,
    }
    return row, result
