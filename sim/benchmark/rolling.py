"""The ball rolling run: five pairs of a grid of markers and an interval of reading, beside two other simulators."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gelflow.errors import UsageError
from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.mujoco_sensor import MujocoRolling
from gelflow.sim.benchmark.paper_build import PaperRolling, unavailable_reason
from gelflow.sim.benchmark.runs import TIMED, TimedRun, check_accuracy, simulator
from gelflow.sim.scene import Scene, load_scene

# The run of the paper's appendix B.1: the force on the pad [N], and the step until which it holds.
ROLLING_FORCES = (
    (100, (0.0, 0.0, 0.2)),
    (150, (0.1, 0.0, 0.2)),
    (200, (-0.2, 0.0, 0.2)),
    (250, (0.0, 0.1, 0.2)),
    (350, (0.0, -0.2, 0.2)),
)
ROLLING_STEPS = ROLLING_FORCES[-1][0]


@dataclass(frozen=True)
class RollingConfig:
    """side × side markers, read after so many steps, again and again; 0: never."""

    side: int
    every: int

    @property
    def name(self) -> str:
        return f"{self.side} × {self.side} markers, " + (f"read every {self.every}" if self.every else "not read")


CONFIGS = (
    RollingConfig(10, 5),
    RollingConfig(50, 5),
    RollingConfig(200, 5),
    RollingConfig(200, 20),
    RollingConfig(10, 0),
)

# The paper's own simulator, its best build on one core of a recent server [steps/s].
PAPER = {CONFIGS[0]: 5200.0, CONFIGS[1]: 4400.0, CONFIGS[2]: 1400.0, CONFIGS[3]: 3100.0, CONFIGS[4]: 5400.0}


def rolling_scene(side: int, friction: str = "viscous") -> Scene:
    """The scene with side × side markers."""
    return load_scene("rolling", friction=friction, overrides={"pads.pad.rows": side, "pads.pad.cols": side})


def rolling_run(scene: Scene, every: int) -> TimedRun:
    """The run, cut at each reading and each change of force. Raises UsageError for `every` below 0."""
    if every < 0:
        raise UsageError(f"markers are read every so many steps, or never: 0; got {every}")
    blocks, done = [], 0
    for until, force in ROLLING_FORCES:
        while done < until:
            steps = min(until, (done // every + 1) * every if every else until) - done
            done += steps
            blocks.append((steps, np.array(force), every > 0 and done % every == 0))
    return TimedRun(scene.q0, tuple(blocks))


@dataclass
class _Contest:
    """One cell: our run, and those of the others."""

    cell: RollingConfig
    workloads: dict[str, Workload] = field(default_factory=dict)
    times: dict[str, Timing] = field(default_factory=dict)


def measure_rolling(
    options: BenchmarkOptions, *, configs: Sequence[RollingConfig] = CONFIGS, paper_model: Path | None = None
) -> Report:
    """Time the run in each cell, and MuJoCo's with its own tactile sensor in turn with it.

    `paper_model` is the rolling scene of the paper's simulator, which is timed too where its Python module is there.
    """
    reason = unavailable_reason(paper_model)
    checks, contests = [], []
    for cell in configs:
        scene = rolling_scene(cell.side)
        run, sim = rolling_run(scene, cell.every), simulator(scene.describe_to, tolerance=TIMED["viscous"])
        checks.append(check_accuracy(run, sim, scene.describe_to))
        workloads = {"gelflow": run.workload(sim), "mujoco": MujocoRolling(scene, run).work()}
        if paper_model is not None and reason is None:
            workloads["paper_build"] = PaperRolling(paper_model, cell.side, run).work()
        contests.append(_Contest(cell, workloads))
    options.progress.begin("rolling", sum(len(c.workloads) for c in contests) * (options.repeats + 1))
    timings = iter(time_interleaved([work for c in contests for work in c.workloads.values()], options))
    for contest in contests:
        contest.times = {name: next(timings) for name in contest.workloads}
    rows, results, violations = [], [], []
    for contest, accuracy in zip(contests, checks, strict=True):
        cell, ours = contest.cell, contest.times["gelflow"]
        ratios = {name: speedup(ours, other) for name, other in contest.times.items() if name != "gelflow"}
        published = PAPER.get(cell)
        rows.append(
            (
                f"{cell.side} × {cell.side}",
                f"{cell.every or 'never'}",
                f"{ours.rate:.0f}",
                ours.spread,
                f"{accuracy.iterations:.2f}",
                f"{ours.rate / published:.1f}" if published else "",
                f"{contest.times['mujoco'].rate:.0f}",
                f"{ratios['mujoco']:.2f}",
                *([f"{ratios['paper_build']:.1f}"] if "paper_build" in ratios else []),
            )
        )
        results.append(
            {
                "markers": cell.side**2,
                "every": cell.every,
                **{name: times.plain() for name, times in contest.times.items()},
                "times_as_fast_as": ratios,
                "paper": published,
                "times_the_paper": ours.rate / published if published else None,
                "check": accuracy.plain(),
            }
        )
        violations += accuracy.violations(f"rolling, {cell.name}")
    return Report(
        name="rolling",
        title="Ball rolling: steps per second of one thread",
        columns=(
            *("markers", "read", "steps/s", "±", "Newton", "× paper", "MuJoCo", "× MuJoCo"),
            *(["× build"] if reason is None else []),
        ),
        rows=rows,
        note="350 steps of 5 ms. read: after so many steps, again and again. ±: half of what lies between the "
        f"quartiles. Newton: iterations per step, to {TIMED['viscous']:g} of the forces. × paper: as its "
        "simulator's best build ran on a comparable core. "
        "MuJoCo: the same bodies and taxels, rigid, its tactile sensor gives depth and sliding speed; timed in turn "
        "with ours. "
        + (reason or "× build: the paper's simulator as it is installed here, timed in turn with ours.")
        + load_note([times for contest in contests for times in contest.times.values()]),
        results=results,
        violations=violations,
    )
