"""Speed of gradients: rollouts without and with the reverse pass."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.measurement.timing import BenchmarkOptions, Report, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.speed.rolling import rolling_scene
from gelflow.sim.benchmark.speed.timed_run import (
    AccuracyCheck,
    TimedRun,
    check_accuracy,
    converged_reference,
    motion_run,
    simulator,
)
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.trajectory import Trajectory, TrajectoryGradient

Array = NDArray[np.float64]

START = 30  # steps before the recorded ones, so that these are in the middle of contact
GRADIENT = 1e-4  # largest relative difference to the gradient of the converged reference


@dataclass(frozen=True)
class GradientBenchmark:
    """A rollout whose final state, or whose marker forces after every step, are differentiated."""

    scene: str
    side: int | None  # markers along each side of the rolling pad
    read: bool
    paper: tuple[float, float] | None = None  # forward and backward times of the published simulator [µs per step]

    @property
    def name(self) -> str:
        return self.scene + (f" {self.side} × {self.side}" if self.side else "")


BENCHMARKS = (
    GradientBenchmark("rolling", 10, read=False),
    GradientBenchmark("pushing", None, read=False),
    GradientBenchmark("insertion", None, read=False),
    GradientBenchmark("pushing", None, read=True, paper=(556.0, 7.0)),
    GradientBenchmark("rolling", 200, read=True, paper=(49_200.0, 1268.0)),
)


class _Setup:
    """A benchmark with its simulator, recorded controls, and random weights of the differentiated scalar."""

    def __init__(self, case: GradientBenchmark, steps: int) -> None:
        self.scene: Scene = rolling_scene(case.side) if case.side else load_scene(case.scene, friction="viscous")
        self.run: TimedRun = motion_run(self.scene, steps=START + steps)
        self.sim = simulator(self.scene.model_spec)
        rows = [u for count, u, _ in self.run.blocks for _ in range(count)]
        self._before, self._u = rows[:START], np.array(rows[START:])[:, np.newaxis]
        self._reads = range(1, len(rows) - START + 1) if case.read else ()
        self.start(self.sim)
        self.trajectory = self.forward(self.sim)
        rng = np.random.default_rng(0)
        self._by: dict[str, Any] = {"q": np.zeros(self.trajectory.q.shape)}
        if case.read:
            self._by["tactile"] = rng.normal(size=self.trajectory.tactile.shape)
        else:
            self._by["q"][-1] = rng.normal(size=self._by["q"][-1].shape)

    @property
    def steps(self) -> int:
        return len(self._u)

    def start(self, sim: Simulator) -> None:
        self.run.start(sim)
        for u in self._before:
            sim.step(u)

    def forward(self, sim: Simulator, out: Trajectory | None = None) -> Trajectory:
        return sim.rollout(self._u, read_after=self._reads, out=out)

    def backward(self, sim: Simulator, trajectory: Trajectory) -> TrajectoryGradient:
        return sim.rollout_gradient(trajectory, **self._by)

    def both(self) -> TrajectoryGradient:
        return self.backward(self.sim, self.forward(self.sim, self.trajectory))

    def workloads(self) -> list[Workload]:
        """The rollout alone, and the rollout with its reverse pass."""
        return [Workload(partial(self.forward, self.sim, self.trajectory), self.steps), Workload(self.both, self.steps)]

    def checks(self) -> tuple[AccuracyCheck, float]:
        """Accuracy of the run, and relative difference of the gradient to that of the converged reference."""
        reference = converged_reference(self.sim, self.scene.model_spec)
        accuracy = check_accuracy(self.run, simulator(self.scene.model_spec), self.scene.model_spec)
        self.start(reference)
        right = self.backward(reference, self.forward(reference))
        found = self.both()
        apart, size = np.linalg.norm(found.u - right.u), np.linalg.norm(right.u)
        return accuracy, float(apart / size)


def measure_gradients(options: BenchmarkOptions, *, steps: int | None = None) -> Report:
    """Time rollouts in the middle of contact, without and with the reverse pass."""
    steps = steps or (10 if options.quick else 50)
    setups = [_Setup(case, steps) for case in BENCHMARKS]
    checks = [setup.checks() for setup in setups]
    options.progress.begin("gradients", 2 * len(setups) * (options.repeats + 1))
    timings = time_interleaved([work for setup in setups for work in setup.workloads()], options)
    rows, results, violations = [], [], []
    for case, forward, both, (accuracy, off) in zip(BENCHMARKS, timings[::2], timings[1::2], checks, strict=True):
        ratio = speedup(forward, both)
        output = "each reading" if case.read else "end state"
        paper = sum(case.paper) if case.paper else None
        rows.append(
            (
                *(case.name, output, f"{forward.median * 1e6:.1f}", f"{both.median * 1e6:.1f}", f"{ratio:.2f}"),
                *(f"{case.paper[0]:.0f} + {case.paper[1]:.0f}" if case.paper else "",),
                f"{paper / (both.median * 1e6):.0f}" if paper else "",
            )
        )
        results.append(
            {
                "scene": case.scene,
                "side": case.side,
                "of": output,
                "forward": forward.to_dict(),
                "forward_and_backward": both.to_dict(),
                "ratio": ratio,
                "paper_us": case.paper,
                "check": accuracy.to_dict(),
                "gradient_off": off,
            }
        )
        violations += accuracy.violations(f"gradients, {case.name}")
        if not off <= GRADIENT:
            violations.append(
                f"gradients, {case.name}: {off:.1e} from the converged reference; allowed is {GRADIENT:g}"
            )
    return Report(
        name="gradients",
        title="Gradients: µs per step of one thread",
        columns=("scene", "of", "forward", "+ back", "ratio", "paper", "× paper"),
        rows=rows,
        note=f"of: differentiated output, with respect to all controls and the start. {steps} recorded steps in the "
        "middle of contact, viscous friction. + back: forward and backward; ratio: relative to forward. paper: "
        "published simulator, forward + backward; pushing has 130 markers." + load_note(timings),
        results=results,
        violations=violations,
    )
