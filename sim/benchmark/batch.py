"""N environments side by side: what all cores bring, and what company costs."""

from collections.abc import Sequence

import numpy as np

from gelflow.sim.benchmark import cores
from gelflow.sim.benchmark.runs import check, motion_run, simulator
from gelflow.sim.benchmark.timing import Effort, Report, busy, interleaved, times_as_fast
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

SIZES = (1, 2, 4, 16, 64, 256, 1024)
QUICK_SIZES = SIZES[:4]
SCENE = "insertion"
STEPS = 30


def differ(sim: Simulator) -> None:
    """Let the environments differ, but for the first: another stiffness at each contact, by up to 5 %."""
    rng = np.random.default_rng(0)
    for name in sim.param_index:
        if name.endswith(".kn"):
            sim.param(name)[1:] *= rng.uniform(0.95, 1.05, sim.num_envs - 1)


def measure_batch(effort: Effort, *, sizes: Sequence[int] | None = None, steps: int = STEPS) -> Report:
    """Time the first steps of the insertion's motion, N times, on one core and on all."""
    sizes = sizes or (QUICK_SIZES if effort.quick else SIZES)
    scene = load_scene(SCENE)
    run = motion_run(scene, steps=steps)
    works, checks = [run.work(simulator(scene.describe_to))], []
    for size in sizes:
        for threads in (1, None):
            sim = simulator(scene.describe_to, num_envs=size, threads=threads)
            differ(sim)
            if threads is None:
                checks.append(check(run, sim, scene.describe_to))
            works.append(run.work(sim))
    effort.watch.begin("batch", len(works) * (effort.repeats + 1))
    alone, *taken = interleaved(works, effort)
    rows, results, outside = [], [], []
    for size, one, every, checked in zip(sizes, taken[::2], taken[1::2], checks, strict=True):
        used = min(size, cores())
        per_core = {"one": times_as_fast(one, alone), "all": times_as_fast(every, alone) / used}
        speed_up = times_as_fast(every, one)
        rows.append(
            (
                *(f"{size}", f"{one.rate:.0f}", f"{every.rate:.0f}", f"{speed_up:.2f}"),
                *(f"{per_core['one']:.2f}", f"{per_core['all']:.2f}", f"{every.cpu_share:.2f}"),
            )
        )
        results.append(
            {
                "environments": size,
                "one_core": one.plain(),
                "all_cores": every.plain(),
                "cores": used,
                "speed_up": speed_up,
                "per_core_of_one_alone": per_core,
                "check": checked.plain(),
            }
        )
        outside += checked.broken(f"batch of {size}")
    return Report(
        name="batch",
        title=f"Batches of {SCENE}: environment steps per second",
        columns=("N", "1 core", f"{cores()} cores", "speed-up", "per core: 1", f"{cores()}", "CPU/s"),
        rows=rows,
        note=f"{run.steps} steps; controls change and markers are read every 5. per core: the share of what one "
        f"environment alone reaches, {alone.rate:.0f}/s. CPU/s: processor seconds per second on all cores."
        + busy([alone, *taken[::2]]),
        results=results,
        outside=outside,
    )
