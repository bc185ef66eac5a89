"""Speed of the simulator on the ball rolling run: steps per second, one environment, one thread."""

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

# The run of the paper's appendix B.1: the force on the pad [N], and the step until which it holds.
ROLLING_FORCES = (
    (100, (0.0, 0.0, 0.2)),
    (150, (0.1, 0.0, 0.2)),
    (200, (-0.2, 0.0, 0.2)),
    (250, (0.0, 0.1, 0.2)),
    (350, (0.0, -0.2, 0.2)),
)
ROLLING_STEPS = ROLLING_FORCES[-1][0]

# The paper's own simulator on this run, measured on one core of a recent server: (markers, every) → steps/s.
PAPER_SIMULATOR = {(100, 5): 5200.0, (2500, 5): 4400.0, (40000, 5): 1400.0, (40000, 20): 3100.0}


@dataclass(frozen=True)
class Speed:
    """How fast the rolling run went with one grid of markers, read at one interval.

    The runs are timed in turn with those of the other grids and intervals, so that a disturbance of the machine hits
    all alike; the figures are medians over them.
    """

    markers: int  # how many in all
    every: int  # markers were read after so many steps, again and again
    steps_per_second: float  # by the clock on the wall, reading included
    steps_per_cpu_second: float  # by the processor time that the thread got: tells a busy machine from a slow one
    quartiles: tuple[float, float]  # of steps_per_second: a quarter of the runs was slower, a quarter faster
    repeats: int
    paper_simulator: float | None  # steps/s of the paper's own simulator, where that was measured
    newton_iterations: float  # per step
    halved_steps: int  # that needed substeps, of all in a run
    end_position: tuple[float, ...]  # q at the end of the run: pad x y z [m], ball's position [m] and quaternion
    compression: float  # sum over the markers, at the reading where it is largest [N]

    @property
    def ratio(self) -> float | None:
        """How many times as fast as the paper's own simulator; None where that was not measured."""
        return self.steps_per_second / self.paper_simulator if self.paper_simulator else None


def _blocks(every: int) -> Iterator[tuple[int, tuple[float, float, float], bool]]:
    """The run cut at each reading and each change of force: steps to take, force [N], whether to read after them."""
    done = 0
    for until, force in ROLLING_FORCES:
        while done < until:
            steps = min(until, (done // every + 1) * every) - done
            done += steps
            yield steps, force, done % every == 0


@dataclass
class _Cell:
    """One grid of markers, read at one interval, and the times that its runs took."""

    sim: Simulator
    every: int

    def __post_init__(self) -> None:
        self.start = np.array(self.sim.scene.q0)
        self.blocks = [(steps, np.array(force), read) for steps, force, read in _blocks(self.every)]
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []
        self.compression = 0.0

    def inspect(self) -> None:
        """One run that is not timed: warms the memory, keeps what the run did. Raises SimulationError on failure."""
        sim = self._at_start()
        iterations, halved = int(sim.iterations[0]), int(sim.halved[0])
        for steps, force, read in self.blocks:
            sim.step(force, steps)
            if read:
                self.compression = max(self.compression, float(sim.tactile()[0, :, 2].sum()))
        sim.check()
        self.iterations = (int(sim.iterations[0]) - iterations) / ROLLING_STEPS
        self.halved = int(sim.halved[0]) - halved

    def time(self) -> None:
        """One timed run."""
        sim = self._at_start()
        clock, cpu = time.perf_counter(), time.thread_time()
        for steps, force, read in self.blocks:
            sim.step(force, steps)
            if read:
                sim.tactile()
        self.cpu_seconds.append(time.thread_time() - cpu)
        self.seconds.append(time.perf_counter() - clock)

    def _at_start(self) -> Simulator:
        self.sim.reset()
        self.sim.q[:] = self.start
        return self.sim

    def result(self) -> Speed:
        markers = int(self.sim.model.markers)
        rates = [ROLLING_STEPS / t for t in self.seconds]
        low, high = np.percentile(rates, (25, 75))
        return Speed(
            markers=markers,
            every=self.every,
            steps_per_second=statistics.median(rates),
            steps_per_cpu_second=ROLLING_STEPS / statistics.median(self.cpu_seconds),
            quartiles=(float(low), float(high)),
            repeats=len(rates),
            paper_simulator=PAPER_SIMULATOR.get((markers, self.every)),
            newton_iterations=self.iterations,
            halved_steps=self.halved,
            end_position=tuple(self.sim.q[0].tolist()),
            compression=self.compression,
        )


def rolling_speed(
    *,
    sides: Sequence[int] = (10, 50, 200),
    every: Sequence[int] = (5, 20),
    repeats: int = 15,
    friction: str = "viscous",
    done: Callable[[], None] = lambda: None,
) -> list[Speed]:
    """Time the ball rolling run (350 steps of 5 ms, five forces on the pad), as a user would step and read it.

    Parameters
    ----------
    sides: the pads carry side × side markers
    every: markers are read every so many steps
    repeats: timed runs for each grid and interval, after one that is not
    friction: "viscous" or "elastic"
    done: called after each run, repeats + 1 times for each grid and interval

    Raises UsageError on a number below 1.
    """
    if not sides or not every or min(*sides, *every, repeats) < 1:
        raise UsageError(f"sides, every and repeats must be at least 1, got {sides}, {every}, {repeats}")
    cells = [
        _Cell(Simulator(scene, threads=1), interval)
        for side in sides
        for scene in [load_scene("rolling", friction=friction, overrides=_grid(side))]
        for interval in every
    ]
    for cell in cells:
        cell.inspect()
        done()
    for _ in range(repeats):
        for cell in cells:
            cell.time()
            done()
    return [cell.result() for cell in cells]


def _grid(side: int) -> dict[str, int]:
    return {"pads.pad.rows": side, "pads.pad.cols": side}


def processor() -> str:
    """Name of this machine's processor, and how many of its cores are ours."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}, {cores} cores"
