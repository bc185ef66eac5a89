"""Scaling of the step time with the numbers of bodies, contact points, markers and environments."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, time_interleaved
from gelflow.sim import _core
from gelflow.sim.benchmark.speed.batch import perturb_stiffness
from gelflow.sim.benchmark.speed.rolling import rolling_run, rolling_scene
from gelflow.sim.benchmark.speed.timed_run import (
    AccuracyCheck,
    SpecFactory,
    TimedRun,
    check_accuracy,
    motion_run,
    simulator,
)
from gelflow.sim.scene import load_scene

Array = NDArray[np.float64]

STEPS = 40
ONE_THREAD = "one thread"
UPPER = 0.5  # the exponent is fitted over this share of the sizes, the largest ones: constant costs dominate below
RADIUS = 0.01  # [m] of the balls


@dataclass(frozen=True)
class Sweep:
    """A quantity that is varied."""

    name: str
    unit: str  # name of the counted quantity
    sizes: tuple[int, ...]
    quick: tuple[int, ...]
    prepare: Callable[[int], tuple[Workload, AccuracyCheck]]
    threads: str = ONE_THREAD


@dataclass(frozen=True)
class SweepResult:
    """Timings of a sweep."""

    sweep: Sweep
    sizes: tuple[int, ...]
    times: list[Timing]  # of one step of the whole batch
    checks: list[AccuracyCheck]
    exponent: float

    @property
    def rates(self) -> list[float]:
        """Steps of the whole batch per second."""
        return [times.rate for times in self.times]


def exponent(sizes: Sequence[int], seconds: Sequence[float]) -> float:
    """Slope of log time over log size for the largest sizes (at least 2): 1 for time proportional to size."""
    fitted = fitted_sizes(len(sizes))
    return float(np.polyfit(np.log(sizes[fitted]), np.log(seconds[fitted]), 1)[0])


def fitted_sizes(count: int) -> slice:
    """The sizes among `count` ascending ones to which the exponent is fitted: the larger ones, at least 2."""
    return slice(-max(2, round(UPPER * count)), None)


def balls(count: int) -> SpecFactory:
    """Independent balls at rest on the ground, each on its own slide joint."""

    def make_spec() -> _core.ModelSpec:
        spec = _core.ModelSpec()
        ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane"))
        for i in range(count):
            body = _body(spec, f"ball{i}", -1, (3 * RADIUS * i, 0, RADIUS))
            spec.add_joint(_core.JointDef(name=f"z{i}", body=body, type="slide", damping=0.01))
            points = spec.add_points(_core.PointsDef(name=f"lowest{i}", body=body, points=np.array([[0, 0, -RADIUS]])))
            spec.add_contact(
                _core.ContactDef(name=f"ground{i}", points=points, shape=ground, kn=1e4, kt=1.0, mu=0.5, kd=1e3)
            )
        return spec

    return make_spec


def chain(count: int) -> SpecFactory:
    """A swinging chain of balls on hinge joints whose last ball slides on a wall."""

    def make_spec() -> _core.ModelSpec:
        spec = _core.ModelSpec()
        wall = spec.add_shape(
            _core.ShapeDef(name="wall", kind="plane", pos=(-1e-4, 0, 0), quat=(np.sqrt(0.5), 0, np.sqrt(0.5), 0))
        )
        parent = -1
        for i in range(count):
            parent = _body(spec, f"link{i}", parent, (0, 0, -2 * RADIUS if i else 0.0))
            spec.add_joint(
                _core.JointDef(
                    name=f"hinge{i}", body=parent, type="hinge", pos=(0, 0, RADIUS), axis=(0, 1, 0), damping=1e-4
                )
            )
        points = spec.add_points(_core.PointsDef(name="end", body=parent, points=np.array([[0, 0, -RADIUS]])))
        spec.add_contact(_core.ContactDef(name="wall", points=points, shape=wall, kn=1e2, kt=0.1, mu=0.3, kd=1e2))
        return spec

    return make_spec


def plate(count: int) -> SpecFactory:
    """A plate that slides on the ground, with `count` contact points."""

    def make_spec() -> _core.ModelSpec:
        spec = _core.ModelSpec()
        ground = spec.add_shape(_core.ShapeDef(name="ground", kind="plane"))
        body = _body(spec, "plate", -1, (0, 0, 0))
        for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1))):
            joint = spec.add_joint(_core.JointDef(name=name, body=body, type="slide", axis=axis, damping=0.01))
            if name == "x":
                spec.add_actuator(_core.ActuatorDef(name="x", joint=joint, kind="motor"))
        turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
        spread = 0.05 * np.sqrt((np.arange(count) + 0.5) / count)
        at = np.stack([spread * np.cos(turn), spread * np.sin(turn), np.full(count, -1e-5)], axis=1)
        points = spec.add_points(
            _core.PointsDef(name="face", body=body, points=at, weights=np.full(count, 1.0 / count))
        )
        spec.add_contact(_core.ContactDef(name="ground", points=points, shape=ground, kn=1e4, kt=1.0, mu=0.5, kd=1e3))
        return spec

    return make_spec


def _body(spec: _core.ModelSpec, name: str, parent: int, pos: tuple[float, float, float]) -> int:
    inertia = 4e-6 * RADIUS  # a ball of 10 g
    return spec.add_body(
        _core.BodyDef(name=name, parent=parent, pos=pos, mass=0.01, inertia=(inertia,) * 3 + (0, 0, 0))
    )


def _pushed(make_spec: SpecFactory, push: float) -> tuple[Workload, AccuracyCheck]:
    """A model whose actuators all apply `push` [N]."""
    sim = simulator(make_spec)
    q0 = sim.q[0].copy()
    q0[0] += 0.02 if sim.model.joint_names[0] == "hinge0" else 0.0
    run = TimedRun(q0, ((STEPS, np.full(sim.model.nu, push), False),))
    return run.workload(sim), check_accuracy(run, sim, make_spec)


def _bodies(count: int) -> tuple[Workload, AccuracyCheck]:
    return _pushed(balls(count), 0.0)


def _links(count: int) -> tuple[Workload, AccuracyCheck]:
    return _pushed(chain(count), 0.0)


def _points(count: int) -> tuple[Workload, AccuracyCheck]:
    return _pushed(plate(count), 0.02)


def _markers(count: int) -> tuple[Workload, AccuracyCheck]:
    """The ball rolling run; tactile forces are evaluated every 5 steps."""
    scene = rolling_scene(round(count**0.5))
    run, sim = rolling_run(scene, 5), simulator(scene.model_spec)
    return run.workload(sim), check_accuracy(run, sim, scene.model_spec)


def _environments(count: int) -> tuple[Workload, AccuracyCheck]:
    """The first steps of pushing, on all cores."""
    scene = load_scene("pushing")
    run, sim = motion_run(scene, steps=STEPS), simulator(scene.model_spec, num_envs=count, threads=None)
    perturb_stiffness(sim)
    return Workload(lambda: run.execute(sim), run.steps, lambda: run.start(sim)), check_accuracy(
        run, sim, scene.model_spec
    )


SWEEPS = (
    Sweep("bodies", "independent bodies", (1, 4, 16, 64, 128, 300, 1000), (1, 4, 32), _bodies),
    Sweep("chain", "bodies in a chain", (1, 2, 4, 8, 16, 32, 64, 100), (1, 4, 16), _links),
    Sweep("contacts", "contact points", (1, 10, 100, 1000, 3000, 10_000, 30_000, 100_000), (1, 100, 1000), _points),
    Sweep("markers", "markers", (100, 1024, 10_000, 30_625, 99_856, 300_304, 1_000_000), (100, 1024, 10_000), _markers),
    Sweep("environments", "environments", (1, 4, 16, 64, 256, 1024, 4096), (1, 4, 16), _environments, "all cores"),
)


def measure_sweep(sweep: Sweep, options: BenchmarkOptions) -> SweepResult:
    """Time a sweep."""
    sizes = sweep.quick if options.quick else sweep.sizes
    options.progress.begin(f"scaling: {sweep.unit}", len(sizes) * (options.repeats + 2))
    workloads, checks = [], []
    for size in sizes:
        work, accuracy = sweep.prepare(size)
        workloads.append(work)
        checks.append(accuracy)
        options.progress.advance()
    times = time_interleaved(workloads, options)
    return SweepResult(sweep, sizes, times, checks, exponent(sizes, [t.median for t in times]))


def measure_scaling(options: BenchmarkOptions) -> Report:
    """Time all sweeps. `scaling_picture.draw` draws the results of the report."""
    sweeps = [measure_sweep(sweep, options) for sweep in SWEEPS]
    rows, records, violations = [], [], []
    for result in sweeps:
        name, sizes = result.sweep.name, result.sizes
        rows.append(
            (
                *(result.sweep.unit, f"{sizes[0]} - {sizes[-1]}"),
                *(f"{result.rates[i]:.0f}" for i in (0, len(sizes) // 2, -1)),
                f"{result.exponent:.2f}",
            )
        )
        records.append(
            {
                "of": name,
                "exponent": result.exponent,
                "threads": result.sweep.threads,
                "sizes": [
                    {"size": size, **times.to_dict(), "check": accuracy.to_dict()}
                    for size, times, accuracy in zip(sizes, result.times, result.checks, strict=True)
                ],
            }
        )
        for size, accuracy in zip(sizes, result.checks, strict=True):
            violations += accuracy.violations(f"scaling, {size} {name}")
    return Report(
        name="scaling",
        title="Growth: steps per second",
        columns=("number of", "from - to", "first", "middle", "last", "time ~ n^"),
        rows=rows,
        note="One thread; environments: all cores, one step of the whole batch. The exponent is fitted over the "
        "larger half of the sizes. A chain has a dense mass matrix: up to n³."
        + load_note([times for result in sweeps for times in result.times if result.sweep.threads == ONE_THREAD]),
        results=records,
        violations=violations,
    )
