"""N environments side by side: what all cores bring, and what company costs."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gelflow.measurement.machine import cores
from gelflow.measurement.timing import BenchmarkOptions, Report, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.runs import check_accuracy, motion_run, simulator
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

SIZES = (1, 2, 4, 16, 64, 256, 1024)
QUICK_SIZES = SIZES[:4]
LARGEST_ROLLOUT = 64  # a rollout keeps every state: larger ones would measure memory
SCENE = "insertion"
STEPS = 30
SETTLED = 3e-3  # threads of a simulator that was timed before have gone to sleep by then [s]


def perturb_stiffness(sim: Simulator) -> None:
    """Let the environments differ, but for the first: another stiffness at each contact, by up to 5 %."""
    rng = np.random.default_rng(0)
    for name in sim.param_index:
        if name.endswith(".kn"):
            sim.param(name)[1:] *= rng.uniform(0.95, 1.05, sim.num_envs - 1)


def in_a_loop(kind: Callable[[Simulator], Workload], sim: Simulator) -> Workload:
    """As in a loop of calls: nobody else's threads are about, and the simulator's own have just done the same."""
    work = kind(sim)

    def prepare() -> None:
        time.sleep(SETTLED)
        work.prepare()
        work.run()
        work.prepare()

    return replace(work, prepare=prepare)


def measure_batch(options: BenchmarkOptions, *, sizes: Sequence[int] | None = None, steps: int = STEPS) -> Report:
    """Time the first steps of the insertion's motion, N times, on one core and on all."""
    sizes = sizes or (QUICK_SIZES if options.quick else SIZES)
    scene = load_scene(SCENE)
    run = motion_run(scene, steps=steps)

    def batch(size: int, threads: int | None) -> Simulator:
        sim = simulator(scene.describe_to, num_envs=size, threads=threads)
        perturb_stiffness(sim)
        return sim

    # By what is called, environments, and threads: all (None), one, or one of an environment alone (0).
    workloads: dict[tuple[str, int, int | None], Workload] = {
        ("step", 1, 0): in_a_loop(run.workload, batch(1, 1)),
        ("rollout", 1, 0): in_a_loop(run.rollout_workload, batch(1, 1)),
    }
    checks = {}
    for size in sizes:
        every = batch(size, None)
        checks[size] = check_accuracy(run, every, scene.describe_to)
        workloads["step", size, 1] = in_a_loop(run.workload, batch(size, 1))
        workloads["step", size, None] = in_a_loop(run.workload, every)
        if size <= LARGEST_ROLLOUT:
            workloads["rollout", size, None] = in_a_loop(run.rollout_workload, batch(size, None))
    options.progress.begin("batch", len(workloads) * (options.repeats + 1))
    timings = dict(zip(workloads, time_interleaved(list(workloads.values()), options), strict=True))
    rows, results, violations = [], [], []
    for size in sizes:
        used, one, all_cores = min(size, cores()), timings["step", size, 1], timings["step", size, None]
        share = {
            "one": speedup(one, timings["step", 1, 0]),
            "all": speedup(all_cores, timings["step", 1, 0]) / used,
        }
        if ("rollout", size, None) in timings:
            share["rollout"] = speedup(timings["rollout", size, None], timings["rollout", 1, 0]) / used
        speed_up = speedup(all_cores, one)
        rows.append(
            (
                *(f"{size}", f"{one.rate:.0f}", f"{all_cores.rate:.0f}", f"{speed_up:.2f}"),
                *(f"{share[how]:.2f}" if how in share else "" for how in ("one", "all", "rollout")),
                f"{all_cores.cpu_share:.2f}",
            )
        )
        results.append(
            {
                "environments": size,
                "one_core": one.plain(),
                "all_cores": all_cores.plain(),
                "cores": used,
                "speed_up": speed_up,
                "per_core_of_one_alone": share,
                "check": checks[size].plain(),
            }
        )
        violations += checks[size].violations(f"batch of {size}")
    return Report(
        name="batch",
        title=f"Batches of {SCENE}: environment steps per second",
        columns=("N", "1 core", f"{cores()} cores", "speed-up", "per core: 1", f"{cores()}", "rollout", "CPU/s"),
        rows=rows,
        note=f"{run.steps} steps; controls change and markers are read every 5, one call of Python for each. per core: "
        f"the share of what one environment alone reaches, {timings['step', 1, 0].rate:.0f}/s; rollout: the same where "
        f"all of it is one call ({timings['rollout', 1, 0].rate:.0f}/s alone). CPU/s: processor seconds per second on "
        "all cores." + load_note([times for (_, _, threads), times in timings.items() if threads is not None]),
        results=results,
        violations=violations,
    )
