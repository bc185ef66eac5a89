"""N environments side by side: what all cores bring, and what company costs."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gelflow.measurement.machine import cores
from gelflow.measurement.timing import Effort, Report, Work, busy, interleaved, times_as_fast
from gelflow.sim.benchmark.runs import check, motion_run, simulator
from gelflow.sim.scene.scene import load_scene
from gelflow.sim.simulator import Simulator

SIZES = (1, 2, 4, 16, 64, 256, 1024)
QUICK_SIZES = SIZES[:4]
LARGEST_ROLLOUT = 64  # a rollout keeps every state: larger ones would measure memory
SCENE = "insertion"
STEPS = 30
SETTLED = 3e-3  # threads of a simulator that was timed before have gone to sleep by then [s]


def differ(sim: Simulator) -> None:
    """Let the environments differ, but for the first: another stiffness at each contact, by up to 5 %."""
    rng = np.random.default_rng(0)
    for name in sim.param_index:
        if name.endswith(".kn"):
            sim.param(name)[1:] *= rng.uniform(0.95, 1.05, sim.num_envs - 1)


def in_a_loop(kind: Callable[[Simulator], Work], sim: Simulator) -> Work:
    """As in a loop of calls: nobody else's threads are about, and the simulator's own have just done the same."""
    work = kind(sim)

    def prepare() -> None:
        time.sleep(SETTLED)
        work.prepare()
        work.run()
        work.prepare()

    return replace(work, prepare=prepare)


def measure_batch(effort: Effort, *, sizes: Sequence[int] | None = None, steps: int = STEPS) -> Report:
    """Time the first steps of the insertion's motion, N times, on one core and on all."""
    sizes = sizes or (QUICK_SIZES if effort.quick else SIZES)
    scene = load_scene(SCENE)
    run = motion_run(scene, steps=steps)

    def batch(size: int, threads: int | None) -> Simulator:
        sim = simulator(scene.describe_to, num_envs=size, threads=threads)
        differ(sim)
        return sim

    # By what is called, environments, and threads: all (None), one, or one of an environment alone (0).
    works: dict[tuple[str, int, int | None], Work] = {
        ("step", 1, 0): in_a_loop(run.work, batch(1, 1)),
        ("rollout", 1, 0): in_a_loop(run.rollout_work, batch(1, 1)),
    }
    checks = {}
    for size in sizes:
        every = batch(size, None)
        checks[size] = check(run, every, scene.describe_to)
        works["step", size, 1] = in_a_loop(run.work, batch(size, 1))
        works["step", size, None] = in_a_loop(run.work, every)
        if size <= LARGEST_ROLLOUT:
            works["rollout", size, None] = in_a_loop(run.rollout_work, batch(size, None))
    effort.watch.begin("batch", len(works) * (effort.repeats + 1))
    taken = dict(zip(works, interleaved(list(works.values()), effort), strict=True))
    rows, results, outside = [], [], []
    for size in sizes:
        used, one, all_cores = min(size, cores()), taken["step", size, 1], taken["step", size, None]
        share = {
            "one": times_as_fast(one, taken["step", 1, 0]),
            "all": times_as_fast(all_cores, taken["step", 1, 0]) / used,
        }
        if ("rollout", size, None) in taken:
            share["rollout"] = times_as_fast(taken["rollout", size, None], taken["rollout", 1, 0]) / used
        speed_up = times_as_fast(all_cores, one)
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
        outside += checks[size].broken(f"batch of {size}")
    return Report(
        name="batch",
        title=f"Batches of {SCENE}: environment steps per second",
        columns=("N", "1 core", f"{cores()} cores", "speed-up", "per core: 1", f"{cores()}", "rollout", "CPU/s"),
        rows=rows,
        note=f"{run.steps} steps; controls change and markers are read every 5, one call of Python for each. per core: "
        f"the share of what one environment alone reaches, {taken['step', 1, 0].rate:.0f}/s; rollout: the same where "
        f"all of it is one call ({taken['rollout', 1, 0].rate:.0f}/s alone). CPU/s: processor seconds per second on "
        "all cores." + busy([times for (_, _, threads), times in taken.items() if threads is not None]),
        results=results,
        outside=outside,
    )
