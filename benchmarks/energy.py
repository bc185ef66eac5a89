"""What steps do to mechanical energy: `python benchmarks/energy.py`.

First free bodies thrown on planes, where nothing may add any (`thrown_bodies`): the share of the steps in which
the energy grew, and by how much at most. Then the scenes' motions, where motors and servos do work: what a step gained
beyond their work. Servos pull with the force at the step's end, over the way of the step. All but the share is relative
to the energy at work.

Exit status: 0 when BDF1 never adds any to a free body, 1 when it does.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from gelflow.errors import GelflowError
from gelflow.measurement.machine import processor
from gelflow.sim.benchmark import versions
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.energy import EnergyGauge, motor_forces
from gelflow.sim.validation.reference_motions import SCENES, reference_motion
from gelflow.sim.validation.thrown_bodies import Kind, ThrownBody, throw_bodies

STEPS = (1e-4, 1e-3, 5e-3, 2e-2)  # [s], of free bodies
SCENE_STEPS = (1e-3, 5e-3, 2e-2)  # [s]
BODIES, STEPS_TAKEN = 16, 200
CENTERS = ((0.0, 0.0, 0.0), (4e-3, -3e-3, 5e-3))  # of mass, in the body's frame [m]
ALLOWED = 1e-8  # ten times Newton's tolerance
MATERIALS = (("depth", 0.0), ("depth", 3e3), ("plain", 0.0), ("plain", 3.0))  # damping and its k_d
CASES: tuple[tuple[Kind, str, float], ...] = (  # body, law, k_t
    ("sphere", "viscous", 5.0),
    ("box", "viscous", 5.0),
    ("cylinder", "viscous", 5.0),
    ("box", "elastic", 0.0),
    ("cylinder", "elastic", 0.0),
    ("box", "elastic", 5.0),
    ("cylinder", "elastic", 5.0),
)
GRID = {"rolling": {"pads.pad.rows": 5, "pads.pad.cols": 5}}


@dataclass(frozen=True)
class Thrown:
    """Free bodies of all materials, by one integrator at one step; energies relative to the energy at work."""

    body: str
    law: str
    kt: float
    integrator: str
    step: float
    share: float  # of the steps in which the energy grew
    largest: float  # growth in one step
    above: float  # largest excess over the energy at the start, at any time
    halved: float  # share of the steps that were halved


def throw(body: Kind, law: str, kt: float, integrator: str, step: float) -> Thrown:
    rows = []
    for damping, kd in MATERIALS:
        numbers = {"kn": 2e3, "kt": kt, "mu": 0.6, "kd": kd, "ks": 1e3 if law == "elastic" else 0.0}
        rng = np.random.default_rng(1)
        for center in CENTERS:
            thrown = ThrownBody(body, law, damping, step, numbers, integrator=integrator, center=center)
            growth = throw_bodies(thrown, rng, bodies=BODIES, steps=STEPS_TAKEN)
            relative = growth.change / growth.scale
            above = (growth.total.max(0) - growth.total[0]) / growth.scale[0]
            rows.append(((relative > ALLOWED).mean(), relative.max(), above.max(), growth.halved.mean()))
    share, largest, above, halved = np.array(rows).T
    most = [float(max(x.max(), 0.0)) for x in (largest, above)]
    return Thrown(body, law, kt, integrator, step, float(share.mean()), *most, halved=float(halved.mean()))


@dataclass(frozen=True)
class Moved:
    """A scene's motion; energies relative to all that motors gave and took, summed over the motion."""

    scene: str
    law: str
    integrator: str
    step: float
    share: float  # of the steps that gained beyond the motors' work
    largest: float  # gained in one step beyond their work
    gained: float  # sum of all that was gained so
    lost: float  # sum of all that went: friction, damping, and the integrator's own
    halved: int


def move(name: str, law: str, integrator: str, step: float) -> Moved:
    overrides = {**GRID.get(name, {}), "step": step, "integrator": integrator}
    scene = load_scene(name, friction=law, overrides=overrides)
    sim, gauge, moves = Simulator(scene), EnergyGauge(scene), reference_motion(scene)
    sim.q[0] = moves.q0
    at = [sim.model.joint_q[a.joint] for a in scene.actuators]
    excess, work = [], []
    before = gauge.read(sim).total[0]
    for u in moves.step_controls(step):
        start = sim.q[0, at].copy()
        sim.step(u)
        after = gauge.read(sim).total[0]
        work.append(float(motor_forces(scene, sim, u)[0] @ (sim.q[0, at] - start)))
        excess.append(after - before - work[-1])
        before = after
    sim.check()
    gain, scale = np.array(excess), float(np.abs(work).sum())
    return Moved(
        name,
        law,
        integrator,
        step,
        share=float((gain > ALLOWED * scale).mean()),
        largest=float(max(gain.max(), 0.0) / scale),
        gained=float(gain[gain > 0].sum() / scale),
        lost=float(-gain[gain < 0].sum() / scale),
        halved=int(sim.halved[0]),
    )


def thrown_table(found: list[Thrown]) -> Table:
    out = Table(title="Free bodies on planes: growth of energy in a step, relative", title_justify="left")
    for heading in ("body", "law", "k_t", "by", "step [ms]", "grew", "most", "over start"):
        out.add_column(heading, justify="left" if heading in ("body", "law", "by") else "right")
    for r in found:
        numbers = (f"{r.share:.1%}", *(f"{x:.0e}" if x > ALLOWED else "0" for x in (r.largest, r.above)))
        out.add_row(r.body, r.law, f"{r.kt:g}", r.integrator, f"{r.step * 1e3:g}", *numbers)
    return out


def moved_table(found: list[Moved]) -> Table:
    out = Table(title="Scenes: gained beyond the motors' work, relative to it", title_justify="left")
    for heading in ("scene", "law", "by", "ms", "grew", "in a step", "in all", "lost", "halved"):
        out.add_column(heading, justify="left" if heading in ("scene", "law", "by") else "right")
    for r in found:
        numbers = (f"{x:.0e}" if x > ALLOWED else "0" for x in (r.largest, r.gained))
        row = (f"{r.share:.1%}", *numbers, f"{r.lost:.2g}", str(r.halved))
        out.add_row(r.scene, r.law, r.integrator, f"{r.step * 1e3:g}", *row)
    return out


def measure(progress: Callable[[], None]) -> tuple[list[Thrown], list[Moved]]:
    thrown, moved = [], []
    for body, law, kt in CASES:
        for integrator in INTEGRATORS:
            for step in STEPS:
                thrown.append(throw(body, law, kt, integrator, step))
                progress()
    for name in SCENES:
        for law in FRICTION_LAWS:
            for integrator in INTEGRATORS:
                for step in SCENE_STEPS:
                    moved.append(move(name, law, integrator, step))
                    progress()
    return thrown, moved


def main() -> int:
    parser = argparse.ArgumentParser(description="What steps do to mechanical energy.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "energy.json")
    args = parser.parse_args()
    console = Console(width=80)
    whole = 2 * len(CASES) * len(STEPS) + len(FRICTION_LAWS) * len(INTEGRATORS) * len(SCENES) * len(SCENE_STEPS)
    try:
        with Progress(console=Console(stderr=True, width=80)) as progress:
            task = progress.add_task("energy", total=whole)
            thrown, moved = measure(lambda: progress.advance(task))
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    console.print(thrown_table(thrown))
    console.print(moved_table(moved))
    worst = max(r.largest for r in thrown if r.integrator == "bdf1")
    console.print(f"BDF1: free bodies gained at most {worst:.1e} in a step; allowed {ALLOWED:g}.")
    record = {
        "format": 1,
        "processor": processor(),
        "versions": versions(),
        "thrown": [asdict(r) for r in thrown],
        "scenes": [asdict(r) for r in moved],
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    console.print(str(args.out), soft_wrap=True)
    return 0 if worst <= ALLOWED else 1


if __name__ == "__main__":
    sys.exit(main())
