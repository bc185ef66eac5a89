"""Speed of the ball rolling run for several marker grids, compared with MuJoCo and with the published simulator."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.speed.mujoco_sensor import MujocoRolling
from gelflow.sim.benchmark.speed.redmax import RedMaxRolling, unavailable_reason
from gelflow.sim.benchmark.speed.timed_run import TIMED, AccuracyCheck, TimedRun, check_accuracy, simulator
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.validation.reference_motions import PUBLISHED_ROLLING_FORCES

ROLLING_STEPS = PUBLISHED_ROLLING_FORCES[-1][0]


@dataclass(frozen=True)
class RollingConfig:
    """side × side markers, whose forces are evaluated every `every` steps; 0: never."""

    side: int
    every: int

    @property
    def name(self) -> str:
        return f"{self.side} × {self.side} markers, " + (f"read every {self.every}" if self.every else "not read")


# Configurations, and the rates of the published simulator, fastest build on one core of a recent server [steps/s].
PAPER = {
    RollingConfig(10, 5): 5200.0,
    RollingConfig(50, 5): 4400.0,
    RollingConfig(200, 5): 1400.0,
    RollingConfig(200, 20): 3100.0,
    RollingConfig(10, 0): 5400.0,
}
CONFIGS = tuple(PAPER)


def rolling_scene(side: int, friction: str = "viscous") -> Scene:
    """The rolling scene with side × side markers."""
    return load_scene("rolling", friction=friction, overrides={"pads.pad.rows": side, "pads.pad.cols": side})


def rolling_run(scene: Scene, every: int) -> TimedRun:
    """The published run, in blocks that end where forces change or are evaluated. Raises UsageError if `every` < 0."""
    if every < 0:
        raise UsageError(f"every must be a number of steps, or 0 for no evaluation; got {every}")
    blocks, done = [], 0
    for until, force in PUBLISHED_ROLLING_FORCES:
        while done < until:
            steps = min(until, (done // every + 1) * every if every else until) - done
            done += steps
            blocks.append((steps, np.array(force), every > 0 and done % every == 0))
    return TimedRun(scene.q0, tuple(blocks))


@dataclass
class _Comparison:
    """The run of one configuration in gelflow and in the other simulators."""

    config: RollingConfig
    accuracy: AccuracyCheck
    workloads: dict[str, Workload]
    timings: dict[str, Timing] = field(default_factory=dict)


def measure_rolling(
    options: BenchmarkOptions, *, configs: Sequence[RollingConfig] = CONFIGS, paper_model: Path | None = None
) -> Report:
    """Time the run in each configuration, interleaved with the same run in MuJoCo.

    `paper_model` is the rolling scene of the published simulator, which is timed as well if it is installed.
    """
    reason = unavailable_reason(paper_model)
    comparisons = [_prepare(config, paper_model if reason is None else None) for config in configs]
    options.progress.begin("rolling", sum(len(c.workloads) for c in comparisons) * (options.repeats + 1))
    timings = iter(time_interleaved([work for c in comparisons for work in c.workloads.values()], options))
    rows, results, violations = [], [], []
    for comparison in comparisons:
        comparison.timings = {name: next(timings) for name in comparison.workloads}
        row, result = _summarize(comparison)
        rows.append(row)
        results.append(result)
        violations += comparison.accuracy.violations(f"rolling, {comparison.config.name}")
    return Report(
        name="rolling",
        title="Ball rolling: steps per second of one thread",
        columns=(
            *("markers", "read", "steps/s", "±", "Newton", "× paper", "MuJoCo", "× MuJoCo"),
            *(["× build"] if reason is None else []),
        ),
        rows=rows,
        note="350 steps of 5 ms. read: steps between evaluations of tactile forces. ±: half the interquartile range. "
        f"Newton: iterations per step, with tolerance {TIMED['viscous']:g}. × paper: relative to the published "
        "simulator's fastest build on a comparable core. MuJoCo: same bodies and taxels, rigid contact; its tactile "
        "sensor gives depth and sliding speed; timed in turn with gelflow. "
        + (reason or "× build: the published simulator as installed here, timed in turn with gelflow.")
        + load_note([timing for comparison in comparisons for timing in comparison.timings.values()]),
        results=results,
        violations=violations,
    )


def _prepare(config: RollingConfig, paper_model: Path | None) -> _Comparison:
    """The workloads of one configuration, and the accuracy of gelflow's run."""
    scene = rolling_scene(config.side)
    run, sim = rolling_run(scene, config.every), simulator(scene.model_spec, tolerance=TIMED["viscous"])
    accuracy = check_accuracy(run, sim, scene.model_spec)
    workloads = {"gelflow": run.workload(sim), "mujoco": MujocoRolling(scene, run).workload()}
    if paper_model is not None:
        workloads["paper_build"] = RedMaxRolling(paper_model, config.side, run).workload()
    return _Comparison(config, accuracy, workloads)


def _summarize(comparison: _Comparison) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Table row and record of one configuration."""
    config, accuracy, ours = comparison.config, comparison.accuracy, comparison.timings["gelflow"]
    ratios = {name: speedup(ours, other) for name, other in comparison.timings.items() if name != "gelflow"}
    published = PAPER.get(config)
    row = (
        f"{config.side} × {config.side}",
        f"{config.every or 'never'}",
        f"{ours.rate:.0f}",
        ours.spread,
        f"{accuracy.iterations:.2f}",
        f"{ours.rate / published:.1f}" if published else "",
        f"{comparison.timings['mujoco'].rate:.0f}",
        f"{ratios['mujoco']:.2f}",
        *([f"{ratios['paper_build']:.1f}"] if "paper_build" in ratios else []),
    )
    result = {
        "markers": config.side**2,
        "every": config.every,
        **{name: timing.to_dict() for name, timing in comparison.timings.items()},
        "times_as_fast_as": ratios,
        "paper": published,
        "times_the_paper": ours.rate / published if published else None,
        "check": accuracy.to_dict(),
    }
    return row, result
