"""How errors fall with the time step on whole scenes, and at what cost: `python benchmarks/order.py`.

Each scene's motion (`reference_motions`: touch is made, slides, sticks, breaks, is made again) is run with steps of
5 ms and of halves, quarters, … of that, by BDF1 and BDF2, under both friction laws. The reference is BDF2 with the
shortest step of all.

When a point touches, slips or sticks is known to a step, and how much of a step is lost is up to chance: one motion,
looked at when it ends, tells little of how errors fall. So each is run in some variants, with its own reference each:
the controls' changes larger or smaller, faster or slower by up to 3 %, by no simple fraction of each other. Errors are
means over all variants and over 128 times of the motion (160 in insertion), relative to the mean of

    q        ‖q_ref − q_start‖
    v        ‖v_ref‖
    tactile  ‖T_ref‖, over all markers

Means of norms, since a force that jumps, or passes from slip to stick within microseconds, is entirely wrong for as
long as the event is early or late: that share of the time shrinks with the step, while a root of mean squares shrinks
with its root. Slopes of the latter are printed too. Slopes are least squares of log error over log step: over all
steps, and over the finest ones. Newton's tolerance is 1e-10 everywhere, so that it is the step that is measured. Then
other implicit schemes: see `schemes.py`.

Exit status: 0 when every slope over the finest steps is at least 0.9, 1 when not.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from order_picture import draw
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from schemes import Scheme, ball_errors, extrapolated_scene

from gelflow.errors import GelflowError
from gelflow.measurement.machine import processor
from gelflow.sim import _core
from gelflow.sim.benchmark import versions
from gelflow.sim.scene import INTEGRATORS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import ReferenceMotion, reference_motion

Array = NDArray[np.float64]
Case = tuple[str, str]  # scene, law

HERE = Path(__file__).parent
LONGEST = 5e-3  # [s], and how far apart errors are taken
# Halvings of the longest step for BDF1, for BDF2 and for the reference, and how many variants. Under the elastic law
# single motions scatter. Under the viscous law they do not, and BDF2 is of second order: its steps may be longer than
# those of BDF1 that it judges, which damps insertion's rattle until steps are very short.
CASES: dict[Case, tuple[int, int, int, int]] = {
    ("rolling", "viscous"): (10, 9, 11, 8),
    ("rolling", "elastic"): (10, 9, 11, 8),
    ("pushing", "viscous"): (11, 9, 11, 8),
    ("pushing", "elastic"): (10, 9, 11, 8),
    ("insertion", "viscous"): (13, 9, 11, 2),
    ("insertion", "elastic"): (11, 10, 12, 8),
}
SPREAD = 0.03  # of their size and pace
FINEST = {"bdf1": 3, "bdf2": 5}  # halvings over which the second slope is taken
REQUIRED = 0.9
TOLERANCE = 1e-10  # of Newton's method: at 1 µs less would be below the rounding of momenta
QUANTITIES = ("q", "v", "tactile")
GRID = {"rolling": {"pads.pad.rows": 20, "pads.pad.cols": 20}}


def variants(moves: ReferenceMotion, count: int) -> list[ReferenceMotion]:
    """The motion itself, then others near it, spread evenly over sizes and paces (an R2 sequence)."""
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    points = (0.5 + np.arange(count)[:, None] * steps) % 1
    return [moves.varied(*(1 + SPREAD * (2 * p - 1))) for p in points]


def simulator(scene: Scene, step: float, integrator: str, tolerance: float, envs: int = 1) -> Simulator:
    spec = scene.describe_to(_core.ModelSpec())
    spec.step, spec.integrator, spec.tolerance = step, integrator, tolerance
    return Simulator(_core.Model(spec), num_envs=envs, threads=1)


@dataclass(frozen=True)
class Course:
    """All variants of a motion, every LONGEST seconds."""

    seen: dict[str, Array]  # by quantity: (frames, variants, numbers)
    iterations: int  # of Newton's method, for the motion itself
    halved: int  # steps that had to be halved, in all variants


def run(scene: Scene, integrator: str, halvings: int, count: int) -> Course:
    """A scene's motions with steps of LONGEST / 2^halvings. Raises SimulationError where a step can't be taken."""
    step, between = LONGEST / 2**halvings, 2**halvings
    moves = reference_motion(scene)
    sim, chosen = simulator(scene, step, integrator, TOLERANCE, count), variants(moves, count)
    sim.q[:] = moves.q0
    seen: dict[str, list[Array]] = {quantity: [] for quantity in QUANTITIES}
    for frame in range(round(moves.duration / LONGEST)):
        times = step * np.arange(frame * between + 1, (frame + 1) * between + 1)
        for u in np.stack([m.controls(times) for m in chosen], axis=1):
            sim.step(u)
        for quantity, now in (("q", sim.q), ("v", sim.v), ("tactile", sim.tactile())):
            seen[quantity].append(now.reshape(count, -1).copy())
    sim.check()
    return Course({k: np.array(v) for k, v in seen.items()}, int(sim.iterations[0]), int(sim.halved.sum()))


@dataclass(frozen=True)
class Errors:
    """What one run is off by, relative: by quantity, for each variant."""

    mean: dict[str, list[float]]  # of norms over time
    rms: dict[str, list[float]]
    end: float  # of q, of the motion itself, at its end
    iterations: int
    halved: int


def judge(course: Course, reference: Course, start: Array) -> Errors:
    mean, rms = {}, {}
    for quantity in QUANTITIES:
        exact = reference.seen[quantity]
        off = np.linalg.norm(course.seen[quantity] - exact, axis=2)
        size = np.linalg.norm(exact - start if quantity == "q" else exact, axis=2)
        mean[quantity] = (off.mean(0) / size.mean(0)).tolist()
        rms[quantity] = np.sqrt((off**2).mean(0) / (size**2).mean(0)).tolist()
    last, right = course.seen["q"][-1, 0], reference.seen["q"][-1, 0]
    end = float(np.linalg.norm(last - right) / np.linalg.norm(right - start))
    return Errors(mean, rms, end, course.iterations, course.halved)


@dataclass(frozen=True)
class Convergence:
    """Errors of one scene under one law by one integrator."""

    scene: str
    law: str
    integrator: str
    steps: list[float]  # [s], longest first
    runs: list[Errors]

    def errors(self, quantity: str, kind: str = "mean") -> list[float]:
        """Over all variants, by step."""
        found = [np.array(getattr(r, kind)[quantity]) for r in self.runs]
        return [float(np.sqrt((e**2).mean()) if kind == "rms" else e.mean()) for e in found]

    def slope(self, quantity: str, kind: str = "mean", *, finest: bool = True) -> float:
        return self._fit(self.errors(quantity, kind), finest)

    def scatter(self, quantity: str) -> tuple[float, float]:
        """The smallest and the largest of the variants' own slopes over the finest steps."""
        single = np.array([r.mean[quantity] for r in self.runs])
        slopes = [self._fit(errors.tolist(), True) for errors in single.T]
        return min(slopes), max(slopes)

    def _fit(self, errors: list[float], finest: bool) -> float:
        chosen = slice(-FINEST[self.integrator] - 1 if finest else None, None)
        return float(np.polyfit(np.log(self.steps[chosen]), np.log(errors[chosen]), 1)[0])


def converge(less: int, threads: int, done: Callable[[float], None]) -> tuple[list[Convergence], dict[Case, Array]]:
    """Every scene, law and integrator; and the end of each reference, (nq,). `done` is told the share that was run."""
    scenes = {(name, law): load_scene(name, friction=law, overrides=GRID.get(name)) for name, law in CASES}
    most = {case: [k - less for k in given[:3]] for case, given in CASES.items()}
    taken = {
        (case, integrator): range(most[case][i] + 1) for case, (i, integrator) in product(CASES, enumerate(INTEGRATORS))
    }
    whole = sum(2**k * CASES[case][3] for (case, _), ks in taken.items() for k in ks)
    whole += sum(2 ** most[case][2] * CASES[case][3] for case in CASES)
    references: dict[Case, Course] = {}

    def course(case: Case, integrator: str, halvings: int) -> Course:
        result = run(scenes[case], integrator, halvings, CASES[case][3])
        done(2**halvings * CASES[case][3] / whole)
        return result

    def errors(job: tuple[Case, str, int]) -> Errors:
        return judge(course(*job), references[job[0]], reference_motion(scenes[job[0]]).q0)

    jobs = sorted(((*kind, k) for kind, ks in taken.items() for k in ks), key=lambda job: -job[2])  # the longest first
    with ThreadPoolExecutor(threads) as pool:
        last = list(reversed(CASES))  # the longest first, here too
        references |= zip(last, pool.map(lambda case: course(case, "bdf2", most[case][2]), last), strict=True)
        found = dict(zip(jobs, pool.map(errors, jobs), strict=True))
    result = [
        Convergence(*case, integrator, [LONGEST / 2**k for k in ks], [found[case, integrator, k] for k in ks])
        for (case, integrator), ks in taken.items()
    ]
    return result, {case: reference.seen["q"][-1, 0] for case, reference in references.items()}


def error_table(name: str, law: str, pair: list[Convergence]) -> Table:
    out = Table(title=f"{name}, {law}: relative errors", title_justify="left")
    out.add_column("step [µs]", justify="right")
    for result in pair:
        for quantity in QUANTITIES:
            out.add_column(f"{result.integrator}\n{quantity}", justify="right")
    columns = [r.errors(quantity) for r in pair for quantity in QUANTITIES]
    for k, step in enumerate(pair[0].steps):
        out.add_row(f"{step * 1e6:.5g}", *(f"{errors[k]:.1e}" if k < len(errors) else "" for errors in columns))
    return out


def slope_table(found: list[Convergence]) -> Table:
    out = Table(title="Slopes: all steps / finest (single motions; of the rms)", title_justify="left")
    for heading in ("scene", "law", "by", *QUANTITIES):
        out.add_column(heading, justify="right" if heading in QUANTITIES else "left")
    for r in found:
        cells = []
        for quantity in QUANTITIES:
            low, high = r.scatter(quantity)
            both = f"{r.slope(quantity, finest=False):.2f} / {r.slope(quantity):.2f}"
            cells.append(f"{both}\n({low:.2f} to {high:.2f}; {r.slope(quantity, 'rms'):.2f})")
        out.add_row(r.scene, r.law, r.integrator, *cells)
    return out


def scheme_table(title: str, schemes: list[Scheme]) -> Table:
    out = Table(title=title, title_justify="left")
    for heading in ("scheme", "order", "solves for 1 %", "for 0.1 %", "for 0.01 %"):
        out.add_column(heading, justify="left" if heading == "scheme" else "right")
    for s in schemes:
        costs = [s.cost_of(error) for error in (1e-2, 1e-3, 1e-4)]
        out.add_row(s.name, f"{s.slope():.2f}", *("–" if c is None else f"{c:.0f}" for c in costs))
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description="How errors fall with the time step on whole scenes, and the cost.")
    parser.add_argument(
        "--less", type=int, choices=range(4), default=0, help="halvings less than usual, for a quick look (%(default)s)"
    )
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="runs at a time (%(default)s)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "order.json", help="file to write")
    parser.add_argument("--picture", type=Path, default=HERE.parent / "docs" / "pictures" / "order.png")
    args = parser.parse_args()
    console = Console(width=80)
    try:
        with Progress(console=Console(stderr=True, width=80)) as progress:
            task = progress.add_task("scenes", total=1.0)
            found, ends = converge(args.less, args.threads, lambda d: progress.advance(task, d))
            task = progress.add_task("schemes", total=1.0)
            ball = ball_errors(lambda d: progress.advance(task, 0.5 * d))
            scenes = scene_schemes(found, ends, lambda d: progress.advance(task, 0.5 * d))
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    for name, law in CASES:
        console.print(error_table(name, law, [r for r in found if (r.scene, r.law) == (name, law)]))
    console.print(slope_table(found))
    console.print(scheme_table("A ball thrown on a penalty plane: Newton solves for an error", ball))
    for title, schemes in scenes.items():
        console.print(scheme_table(f"{title}: Newton iterations for an error of q", schemes))
    slopes = {q: min(r.slope(q) for r in found) for q in QUANTITIES}
    console.print(f"Smallest slope over the finest steps: {', '.join(f'{q} {s:.2f}' for q, s in slopes.items())}")
    if min(slopes.values()) < REQUIRED:
        console.print(f"Some are below {REQUIRED}: docs/reference/accuracy.md says why.")
    record = {
        "format": 1,
        "processor": processor(),
        "versions": versions(),
        "convergence": [asdict(r) | {"slopes": slopes_of(r)} for r in found],
        "ball": [asdict(s) for s in ball],
        "schemes": {title: [asdict(s) for s in schemes] for title, schemes in scenes.items()},
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    draw(found, ball, scenes, args.picture)
    console.print(f"{args.out}\n{args.picture}", soft_wrap=True)
    return 0 if min(slopes.values()) >= REQUIRED else 1


def slopes_of(r: Convergence) -> dict[str, dict[str, float]]:
    return {
        quantity: {
            "all": r.slope(quantity, finest=False),
            "finest": r.slope(quantity),
            "rms, all": r.slope(quantity, "rms", finest=False),
            "rms, finest": r.slope(quantity, "rms"),
        }
        for quantity in QUANTITIES
    }


def scene_schemes(
    found: list[Convergence], ends: dict[Case, Array], done: Callable[[float], None]
) -> dict[str, list[Scheme]]:
    """BDF1, BDF2 and BDF1 extrapolated on two whole scenes, by cost: errors of q at the end over Newton iterations."""
    result = {}
    cases: tuple[Case, ...] = (("rolling", "viscous"), ("pushing", "viscous"), ("pushing", "elastic"))
    for name, law in cases:
        schemes = [
            Scheme(r.integrator.upper(), r.steps[:9], [e.end for e in r.runs[:9]], [e.iterations for e in r.runs[:9]])
            for r in found
            if (r.scene, r.law) == (name, law)
        ]
        scene = load_scene(name, friction=law, overrides=GRID.get(name))
        moves, end = reference_motion(scene), ends[name, law]
        size = float(np.linalg.norm(end - moves.q0))
        steps = [LONGEST / 2**k for k in range(8)]
        errors, iterations = [], []
        for step in steps:
            q, cost = extrapolated_scene(
                simulator(scene, step, "bdf1", TOLERANCE), simulator(scene, step / 2, "bdf1", TOLERANCE), moves
            )
            errors.append(float(np.linalg.norm(q - end)) / size)
            iterations.append(cost)
            done(step / sum(steps) / len(cases))
        result[f"{name}, {law}"] = [*schemes, Scheme("BDF1 extrapolated", steps, errors, iterations)]
    return result


if __name__ == "__main__":
    sys.exit(main())
