"""How errors fall with the time step on whole scenes, and at what cost: `python benchmarks/order.py`.

Each scene's motion (`gelflow.sim.motions`: touch is made, slides, sticks, breaks, is made again) is run with steps of
5 ms and of halves, quarters, … of that, by BDF1 and BDF2, under both friction laws. The reference is BDF2 with the
shortest step of all. Errors are relative:

    q        ‖q − q_ref‖ / ‖q_ref − q_start‖         at the end
    v        ‖v − v_ref‖ / max over time of ‖v_ref‖   at the end
    tactile  ‖T − T_ref‖ / ‖T_ref‖                    over all markers, at 32 times

Slopes are least squares of log error over log step: once over all steps, once over the finest ones. Newton's tolerance
is 1e-10 everywhere, so that it is the step that is measured. Then other implicit schemes: see `schemes.py`.

Exit status: 0 when every slope over the finest steps is at least 0.9, 1 when not.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from order_picture import draw
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from schemes import Scheme, ball_errors, extrapolated_scene

from gelflow.errors import GelflowError
from gelflow.sim import _core
from gelflow.sim.benchmark import processor, versions
from gelflow.sim.motions import motion
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]

HERE = Path(__file__).parent
SCENES, LAWS, INTEGRATORS = ("rolling", "pushing", "insertion"), ("viscous", "elastic"), ("bdf1", "bdf2")
LONGEST = 5e-3  # [s]
FRAMES = 32
HALVINGS = 12  # of the longest step, for BDF1; the reference has one more
BDF2_HALVINGS = 10  # the reference must be finer than what it judges, also where BDF2 is no better than first order
FINEST = 5  # halvings over which the second slope is taken
REQUIRED = 0.9
TOLERANCE = 1e-10  # of Newton's method: at 1 µs less would be below the rounding of momenta
QUANTITIES = ("q", "v", "tactile")
GRID = {"rolling": {"pads.pad.rows": 20, "pads.pad.cols": 20}}


@dataclass(frozen=True)
class End:
    """What one run came to."""

    q: Array  # (nq,)
    v: Array  # (nv,)
    tactile: Array  # (frames, markers, 3)
    fastest: float  # largest norm of v at the frames
    iterations: int  # of Newton's method
    halved: int  # steps that had to be halved


def simulator(scene: Any, step: float, integrator: str, tolerance: float) -> Simulator:
    spec = scene.describe_to(_core.ModelSpec())
    spec.step, spec.integrator, spec.tolerance = step, integrator, tolerance
    return Simulator(_core.Model(spec), threads=1)


def run(name: str, law: str, integrator: str, halvings: int, tolerance: float = TOLERANCE) -> End:
    """A scene's motion with steps of LONGEST / 2^halvings. Raises SimulationError where a step can't be taken."""
    scene = load_scene(name, friction=law, overrides=GRID.get(name))
    step = LONGEST / 2**halvings
    sim, moves = simulator(scene, step, integrator, tolerance), motion(scene)
    u = moves.steps(step)
    sim.q[0] = moves.q0
    between = len(u) // FRAMES
    frames, fastest = [], 0.0
    for k, controls in enumerate(u, 1):
        sim.step(controls)
        if k % between == 0:
            frames.append(sim.tactile()[0].copy())
            fastest = max(fastest, float(np.linalg.norm(sim.v)))
    sim.check()
    return End(sim.q[0].copy(), sim.v[0].copy(), np.array(frames), fastest, int(sim.iterations[0]), int(sim.halved[0]))


@dataclass(frozen=True)
class Convergence:
    """Errors of one scene under one law by one integrator."""

    scene: str
    law: str
    integrator: str
    steps: list[float]  # [s], longest first
    errors: dict[str, list[float]]  # by quantity
    iterations: list[int]
    halved: list[int]

    def slope(self, quantity: str, last: int | None = None) -> float:
        """Over all steps, or over the `last` halvings."""
        chosen = slice(None if last is None else -last - 1, None)
        x, y = np.log(self.steps[chosen]), np.log(self.errors[quantity][chosen])
        return float(np.polyfit(x, y, 1)[0])


def judge(ends: dict[int, End], reference: End, start: Array) -> dict[str, list[float]]:
    errors: dict[str, list[float]] = {quantity: [] for quantity in QUANTITIES}
    for end in ends.values():
        errors["q"].append(float(np.linalg.norm(end.q - reference.q) / np.linalg.norm(reference.q - start)))
        errors["v"].append(float(np.linalg.norm(end.v - reference.v) / reference.fastest))
        change = np.linalg.norm(end.tactile - reference.tactile)
        errors["tactile"].append(float(change / np.linalg.norm(reference.tactile)))
    return errors


def converge(
    halvings: int, bdf2: int, threads: int, done: Callable[[float], None]
) -> tuple[list[Convergence], dict[tuple[str, str], End]]:
    """Every scene, law and integrator. `done` is told the share of the steps that were taken."""
    jobs = [
        (name, law, integrator, k)
        for name in SCENES
        for law in LAWS
        for integrator, most in zip(INTEGRATORS, (halvings, bdf2), strict=True)
        for k in [*range(most + 1), *([halvings + 1] if integrator == "bdf2" else [])]
    ]
    whole = sum(2**k for *_, k in jobs)

    def job(what: tuple[str, str, str, int]) -> End:
        end = run(*what)
        done(2 ** what[3] / whole)
        return end

    jobs.sort(key=lambda what: -what[3])  # the longest first
    with ThreadPoolExecutor(threads) as pool:
        ends = dict(zip(jobs, pool.map(job, jobs), strict=True))
    found, references = [], {}
    for name in SCENES:
        start = motion(load_scene(name)).q0
        for law in LAWS:
            reference = references[name, law] = ends[name, law, "bdf2", halvings + 1]
            for integrator, most in zip(INTEGRATORS, (halvings, bdf2), strict=True):
                runs = {k: ends[name, law, integrator, k] for k in range(most + 1)}
                found.append(
                    Convergence(
                        name,
                        law,
                        integrator,
                        [LONGEST / 2**k for k in runs],
                        judge(runs, reference, start),
                        [end.iterations for end in runs.values()],
                        [end.halved for end in runs.values()],
                    )
                )
    return found, references


def error_table(name: str, law: str, pair: list[Convergence]) -> Table:
    out = Table(title=f"{name}, {law}: relative errors", title_justify="left")
    out.add_column("step [µs]", justify="right")
    for result in pair:
        for quantity in QUANTITIES:
            out.add_column(f"{result.integrator}\n{quantity}", justify="right")
    for k, step in enumerate(pair[0].steps):
        cells = [f"{r.errors[quantity][k]:.1e}" if k < len(r.steps) else "" for r in pair for quantity in QUANTITIES]
        out.add_row(f"{step * 1e6:.5g}", *cells)
    return out


def slope_table(found: list[Convergence], finest: int) -> Table:
    out = Table(title=f"Slopes over all steps / over the {finest} finest halvings", title_justify="left")
    for heading in ("scene", "law", "by", *QUANTITIES):
        out.add_column(heading, justify="right" if heading in QUANTITIES else "left")
    for r in found:
        out.add_row(r.scene, r.law, r.integrator, *(f"{r.slope(q):.2f} / {r.slope(q, finest):.2f}" for q in QUANTITIES))
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
    parser.add_argument("--halvings", type=int, default=HALVINGS, help="of 5 ms, for BDF1 (%(default)s)")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="runs at a time (%(default)s)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "order.json", help="file to write")
    parser.add_argument("--picture", type=Path, default=HERE.parent / "docs" / "pictures" / "order.png")
    args = parser.parse_args()
    bdf2 = max(1, args.halvings - HALVINGS + BDF2_HALVINGS)
    finest = min(FINEST, bdf2)
    console = Console(width=80)
    try:
        with Progress(console=Console(stderr=True, width=80)) as progress:
            task = progress.add_task("scenes", total=1.0)
            found, references = converge(args.halvings, bdf2, args.threads, lambda d: progress.advance(task, d))
            task = progress.add_task("schemes", total=1.0)
            ball = ball_errors(lambda d: progress.advance(task, 0.5 * d))
            scenes = scene_schemes(found, references, lambda d: progress.advance(task, 0.5 * d))
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    for name in SCENES:
        for law in LAWS:
            console.print(error_table(name, law, [r for r in found if (r.scene, r.law) == (name, law)]))
    console.print(slope_table(found, finest))
    console.print(scheme_table("A ball thrown on a penalty plane: Newton solves for an error", ball))
    for title, schemes in scenes.items():
        console.print(scheme_table(f"{title}: Newton iterations for an error of q", schemes))
    slopes = {q: min(r.slope(q, finest) for r in found) for q in QUANTITIES}
    console.print(f"Smallest slope over the finest steps: {', '.join(f'{q} {s:.2f}' for q, s in slopes.items())}")
    if min(slopes.values()) < REQUIRED:
        console.print(f"Some are below {REQUIRED}: docs/accuracy.md says why.")
    record = {
        "format": 1,
        "processor": processor(),
        "versions": versions(),
        "convergence": [
            asdict(r)
            | {"slopes": {q: r.slope(q) for q in QUANTITIES}, "finest": {q: r.slope(q, finest) for q in QUANTITIES}}
            for r in found
        ],
        "ball": [asdict(s) for s in ball],
        "schemes": {title: [asdict(s) for s in schemes] for title, schemes in scenes.items()},
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    draw(found, ball, scenes, args.picture)
    console.print(f"{args.out}\n{args.picture}", soft_wrap=True)
    return 0 if min(slopes.values()) >= REQUIRED else 1


def scene_schemes(
    found: list[Convergence], references: dict[tuple[str, str], End], done: Callable[[float], None]
) -> dict[str, list[Scheme]]:
    """BDF1, BDF2 and BDF1 extrapolated on two whole scenes, by cost: errors of q over Newton iterations."""
    result = {}
    cases = (("rolling", "viscous"), ("pushing", "viscous"), ("pushing", "elastic"))
    for name, law in cases:
        schemes = [
            Scheme(r.integrator.upper(), r.steps[:9], r.errors["q"][:9], r.iterations[:9])
            for r in found
            if (r.scene, r.law) == (name, law)
        ]
        scene = load_scene(name, friction=law, overrides=GRID.get(name))
        moves, reference = motion(scene), references[name, law]
        size = float(np.linalg.norm(reference.q - moves.q0))
        steps = [LONGEST / 2**k for k in range(8)]
        errors, iterations = [], []
        for step in steps:
            q, cost = extrapolated_scene(
                simulator(scene, step, "bdf1", TOLERANCE), simulator(scene, step / 2, "bdf1", TOLERANCE), moves
            )
            errors.append(float(np.linalg.norm(q - reference.q)) / size)
            iterations.append(cost)
            done(step / sum(steps) / len(cases))
        result[f"{name}, {law}"] = [*schemes, Scheme("BDF1 extrapolated", steps, errors, iterations)]
    return result


if __name__ == "__main__":
    sys.exit(main())
