"""Energy balance of steps: free bodies on planes, and the scenes' reference motions.

Free bodies (`gelflow.sim.validation.thrown_bodies`) must not gain energy: the share of steps in which the energy grows,
and the largest growth. In the scenes motors do work: energy gained beyond their work, where the work of a step is the
force at its end times the displacement. All values except shares are relative to the energy scale.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from rich.table import Table

from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.energy import EnergyGauge, actuator_forces
from gelflow.sim.validation.reference_motions import SCENES, reference_motion
from gelflow.sim.validation.thrown_bodies import Kind, ThrownBody, throw_bodies

STEPS = (1e-4, 1e-3, 5e-3, 2e-2)  # [s], of free bodies
SCENE_STEPS = (1e-3, 5e-3, 2e-2)  # [s]
BODIES, STEPS_TAKEN = 16, 200
CENTERS = ((0.0, 0.0, 0.0), (4e-3, -3e-3, 5e-3))  # of mass, in the body's frame [m]
ALLOWED = 1e-8  # ten times Newton's tolerance
MATERIALS = (("hunt-crossley", 0.0), ("hunt-crossley", 3e3), ("linear", 0.0), ("linear", 3.0))  # damping and its k_d
BODY_SETUPS: tuple[tuple[Kind, str, float], ...] = (  # body, law, k_t
    ("sphere", "viscous", 5.0),
    ("box", "viscous", 5.0),
    ("cylinder", "viscous", 5.0),
    ("box", "elastic", 0.0),
    ("cylinder", "elastic", 0.0),
    ("box", "elastic", 5.0),
    ("cylinder", "elastic", 5.0),
)
MARKER_GRID = {"rolling": {"pads.pad.rows": 5, "pads.pad.cols": 5}}


@dataclass(frozen=True)
class BodyBalance:
    """Free bodies of all materials with one integrator and step; energies relative to the energy scale."""

    body: str
    law: str
    kt: float
    integrator: str
    step: float
    share: float  # of steps in which the energy grew
    largest: float  # growth in one step
    above: float  # largest excess over the initial energy
    halved: float  # share of steps that were split into substeps


def body_balance(body: Kind, law: str, kt: float, integrator: str, step: float, *, seed: int = 1) -> BodyBalance:
    """Throw bodies of all materials and centres of mass."""
    rows = []
    for damping, kd in MATERIALS:
        numbers = {"kn": 2e3, "kt": kt, "mu": 0.6, "kd": kd, "ks": 1e3 if law == "elastic" else 0.0}
        rng = np.random.default_rng(seed)
        for center in CENTERS:
            thrown = ThrownBody(body, law, damping, step, numbers, integrator=integrator, center=center)
            energy = throw_bodies(thrown, rng, bodies=BODIES, steps=STEPS_TAKEN)
            relative = energy.change / energy.scale
            above = (energy.total.max(0) - energy.total[0]) / energy.scale[0]
            rows.append(((relative > ALLOWED).mean(), relative.max(), above.max(), energy.halved.mean()))
    share, largest, above, halved = np.array(rows).T
    return BodyBalance(
        body,
        law,
        kt,
        integrator,
        step,
        share=float(share.mean()),
        largest=float(max(largest.max(), 0.0)),
        above=float(max(above.max(), 0.0)),
        halved=float(halved.mean()),
    )


@dataclass(frozen=True)
class MotionBalance:
    """A scene's reference motion; energies relative to the sum of the motors' absolute work."""

    scene: str
    law: str
    integrator: str
    step: float
    share: float  # of steps that gained energy beyond the motors' work
    largest: float  # gain of one step beyond the motors' work
    gained: float  # sum of these gains
    lost: float  # sum of all losses: friction, damping and numerical dissipation
    halved: int  # steps that were split into substeps


def motion_balance(name: str, law: str, integrator: str, step: float) -> MotionBalance:
    """Energy balance of a scene's reference motion. Raises SimulationError when a step fails."""
    overrides = {**MARKER_GRID.get(name, {}), "step": step, "integrator": integrator}
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
        work.append(float(actuator_forces(scene, sim, u)[0] @ (sim.q[0, at] - start)))
        excess.append(after - before - work[-1])
        before = after
    sim.check()
    gain, scale = np.array(excess), float(np.abs(work).sum())
    return MotionBalance(
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


def body_table(balances: Sequence[BodyBalance]) -> Table:
    out = Table(title="Free bodies on planes: relative growth of energy in a step", title_justify="left")
    for heading in ("body", "law", "k_t", "by", "step [ms]", "grew", "largest", "above start"):
        out.add_column(heading, justify="left" if heading in ("body", "law", "by") else "right")
    for r in balances:
        numbers = (f"{r.share:.1%}", *(f"{x:.0e}" if x > ALLOWED else "0" for x in (r.largest, r.above)))
        out.add_row(r.body, r.law, f"{r.kt:g}", r.integrator, f"{r.step * 1e3:g}", *numbers)
    return out


def motion_table(balances: Sequence[MotionBalance]) -> Table:
    out = Table(title="Scenes: energy gained beyond the motors' work, relative to it", title_justify="left")
    for heading in ("scene", "law", "by", "ms", "grew", "largest", "gained", "lost", "halved"):
        out.add_column(heading, justify="left" if heading in ("scene", "law", "by") else "right")
    for r in balances:
        numbers = (f"{x:.0e}" if x > ALLOWED else "0" for x in (r.largest, r.gained))
        row = (f"{r.share:.1%}", *numbers, f"{r.lost:.2g}", str(r.halved))
        out.add_row(r.scene, r.law, r.integrator, f"{r.step * 1e3:g}", *row)
    return out


def count(*, quick: bool = False) -> int:
    """Number of balances that `measure` computes."""
    bodies, motions = _setups(quick)
    return len(bodies) + len(motions)


def measure(
    progress: Callable[[float], None], *, quick: bool = False, seed: int = 1
) -> tuple[list[BodyBalance], list[MotionBalance]]:
    """All balances; with `quick` one step size each. `progress` is advanced by 1 after each."""
    bodies, motions = [], []
    body_setups, motion_setups = _setups(quick)
    for (body, law, kt), integrator, step in body_setups:
        bodies.append(body_balance(body, law, kt, integrator, step, seed=seed))
        progress(1)
    for name, law, integrator, step in motion_setups:
        motions.append(motion_balance(name, law, integrator, step))
        progress(1)
    return bodies, motions


def _setups(
    quick: bool,
) -> tuple[list[tuple[tuple[Kind, str, float], str, float]], list[tuple[str, str, str, float]]]:
    steps, scene_steps = (STEPS[2:3], SCENE_STEPS[2:]) if quick else (STEPS, SCENE_STEPS)
    return (
        list(product(BODY_SETUPS, INTEGRATORS, steps)),
        list(product(SCENES, FRICTION_LAWS, INTEGRATORS, scene_steps)),
    )
