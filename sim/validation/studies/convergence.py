"""Convergence of whole scenes with the time step, and cost of other implicit schemes.

Each reference motion is simulated with steps of 5 ms, halved repeatedly, with BDF1 and BDF2 and both friction laws. The
reference is BDF2 with the shortest step.

A contact event (touch, slip, stick) is resolved to one step, and its error within the step is random, so that a single
motion shows little of the order. Each motion is therefore simulated in several variants with amplitudes and speeds that
differ by up to 3 %, each with its own reference. Errors are means over all variants and over 128 times (160 in
insertion), relative to the mean of

    q        ‖q_ref − q_start‖
    v        ‖v_ref‖
    tactile  ‖T_ref‖, over all markers

Means of norms are used because a force that jumps is entirely wrong while its event is early or late: that share of
time is proportional to the step, a root mean square to its square root. Slopes of the latter are reported too. Slopes
are least-squares fits of log error over log step, over all steps and over the finest ones. Newton's tolerance is 1e-10,
so that errors are those of the step.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from gelflow.sim import _core
from gelflow.sim.scene import INTEGRATORS, Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import ReferenceMotion, reference_motion
from gelflow.sim.validation.studies.schemes import Scheme, extrapolated_scene

Array = NDArray[np.float64]
Setup = tuple[str, str]  # scene, law

LONGEST = 5e-3  # longest step, and interval of the error evaluation [s]
# Halvings of the longest step for BDF1, BDF2 and the reference, and number of variants. With the elastic law the slopes
# of single motions scatter. With the viscous law BDF2 is of second order, so that reference steps may be longer than
# those of BDF1; in insertion BDF1 damps vibration until steps are very short.
SETUPS: dict[Setup, tuple[int, int, int, int]] = {
    ("rolling", "viscous"): (10, 9, 11, 8),
    ("rolling", "elastic"): (10, 9, 11, 8),
    ("pushing", "viscous"): (11, 9, 11, 8),
    ("pushing", "elastic"): (10, 9, 11, 8),
    ("insertion", "viscous"): (13, 9, 11, 2),
    ("insertion", "elastic"): (11, 10, 12, 8),
}
SPREAD = 0.03  # relative spread of amplitude and speed of the variants
FINEST = {"bdf1": 3, "bdf2": 5}  # halvings of the second slope
REQUIRED = 0.9
TOLERANCE = 1e-10  # of Newton's method; below it, momenta are dominated by rounding at 1 µs
QUANTITIES = ("q", "v", "tactile")
MARKER_GRID = {"rolling": {"pads.pad.rows": 20, "pads.pad.cols": 20}}


def variants(moves: ReferenceMotion, count: int) -> list[ReferenceMotion]:
    """Similar motions, spread evenly over amplitudes and speeds (R2 sequence); the first is the motion itself."""
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    points = (0.5 + np.arange(count)[:, None] * steps) % 1
    return [moves.varied(*(1 + SPREAD * (2 * p - 1))) for p in points]


def simulator(scene: Scene, step: float, integrator: str, envs: int = 1) -> Simulator:
    """A simulator of the scene with another step and integrator, solved to `TOLERANCE`."""
    spec = scene.model_spec()
    spec.step, spec.integrator, spec.tolerance = step, integrator, TOLERANCE
    return Simulator(_core.Model(spec), num_envs=envs, threads=1)


@dataclass(frozen=True)
class SampledMotion:
    """All variants of a motion, sampled every `LONGEST` seconds."""

    samples: dict[str, Array]  # quantity → (frames, variants, components)
    iterations: int  # Newton iterations of the first variant
    halved: int  # steps that were split into substeps, all variants


def run(scene: Scene, integrator: str, halvings: int, count: int) -> SampledMotion:
    """Simulate all variants with steps of LONGEST / 2^halvings. Raises SimulationError when a step fails."""
    step, between = LONGEST / 2**halvings, 2**halvings
    moves = reference_motion(scene)
    sim, chosen = simulator(scene, step, integrator, count), variants(moves, count)
    sim.q[:] = moves.q0
    samples: dict[str, list[Array]] = {quantity: [] for quantity in QUANTITIES}
    for frame in range(round(moves.duration / LONGEST)):
        times = step * np.arange(frame * between + 1, (frame + 1) * between + 1)
        for u in np.stack([m.controls(times) for m in chosen], axis=1):
            sim.step(u)
        for quantity, now in (("q", sim.q), ("v", sim.v), ("tactile", sim.tactile())):
            samples[quantity].append(now.reshape(count, -1).copy())
    sim.check()
    return SampledMotion({k: np.array(v) for k, v in samples.items()}, int(sim.iterations[0]), int(sim.halved.sum()))


@dataclass(frozen=True)
class Errors:
    """Relative errors of one run: quantity → error of each variant."""

    mean: dict[str, list[float]]  # mean norm over time
    rms: dict[str, list[float]]  # root mean square over time
    end: float  # of q at the end of the first variant
    iterations: int
    halved: int


def errors_of(motion: SampledMotion, reference: SampledMotion, start: Array) -> Errors:
    """Errors of a motion relative to the reference; `start` (nq,) are the initial positions."""
    mean, rms = {}, {}
    for quantity in QUANTITIES:
        exact = reference.samples[quantity]
        off = np.linalg.norm(motion.samples[quantity] - exact, axis=2)
        size = np.linalg.norm(exact - start if quantity == "q" else exact, axis=2)
        mean[quantity] = (off.mean(0) / size.mean(0)).tolist()
        rms[quantity] = np.sqrt((off**2).mean(0) / (size**2).mean(0)).tolist()
    last, right = motion.samples["q"][-1, 0], reference.samples["q"][-1, 0]
    end = float(np.linalg.norm(last - right) / np.linalg.norm(right - start))
    return Errors(mean, rms, end, motion.iterations, motion.halved)


@dataclass(frozen=True)
class Convergence:
    """Errors of one scene, friction law and integrator over the step."""

    scene: str
    law: str
    integrator: str
    steps: list[float]  # [s], longest first
    runs: list[Errors]

    def errors(self, quantity: str, kind: str = "mean") -> list[float]:
        """Errors over all variants, one per step."""
        found = [np.array(getattr(r, kind)[quantity]) for r in self.runs]
        return [float(np.sqrt((e**2).mean()) if kind == "rms" else e.mean()) for e in found]

    def slope(self, quantity: str, kind: str = "mean", *, finest: bool = True) -> float:
        """Least-squares slope of log error over log step: over the finest steps, or over all."""
        return self._fit(self.errors(quantity, kind), finest)

    def scatter(self, quantity: str) -> tuple[float, float]:
        """Smallest and largest slope of single variants over the finest steps."""
        single = np.array([r.mean[quantity] for r in self.runs])
        slopes = [self._fit(errors.tolist(), True) for errors in single.T]
        return min(slopes), max(slopes)

    def _fit(self, errors: list[float], finest: bool) -> float:
        chosen = slice(-FINEST[self.integrator] - 1 if finest else None, None)
        return float(np.polyfit(np.log(self.steps[chosen]), np.log(errors[chosen]), 1)[0])


def measure(less: int, threads: int, done: Callable[[float], None]) -> tuple[list[Convergence], dict[Setup, Array]]:
    """Convergence of all scenes, laws and integrators, and final positions (nq,) of the references.

    Parameters
    ----------
    less: halvings fewer than in `SETUPS`
    threads: concurrent runs
    done: called with the share of the work of each finished run
    """
    scenes = {(name, law): load_scene(name, friction=law, overrides=MARKER_GRID.get(name)) for name, law in SETUPS}
    most = {setup: [k - less for k in given[:3]] for setup, given in SETUPS.items()}
    taken = {
        (setup, integrator): range(most[setup][i] + 1)
        for setup, (i, integrator) in product(SETUPS, enumerate(INTEGRATORS))
    }
    whole = sum(2**k * SETUPS[setup][3] for (setup, _), ks in taken.items() for k in ks)
    whole += sum(2 ** most[setup][2] * SETUPS[setup][3] for setup in SETUPS)
    references: dict[Setup, SampledMotion] = {}

    def motion(setup: Setup, integrator: str, halvings: int) -> SampledMotion:
        result = run(scenes[setup], integrator, halvings, SETUPS[setup][3])
        done(2**halvings * SETUPS[setup][3] / whole)
        return result

    def errors(job: tuple[Setup, str, int]) -> Errors:
        return errors_of(motion(*job), references[job[0]], reference_motion(scenes[job[0]]).q0)

    jobs = sorted(((*kind, k) for kind, ks in taken.items() for k in ks), key=lambda job: -job[2])  # longest first
    with ThreadPoolExecutor(threads) as pool:
        last = list(reversed(SETUPS))  # longest first
        references |= zip(last, pool.map(lambda setup: motion(setup, "bdf2", most[setup][2]), last), strict=True)
        found = dict(zip(jobs, pool.map(errors, jobs), strict=True))
    result = [
        Convergence(*setup, integrator, [LONGEST / 2**k for k in ks], [found[setup, integrator, k] for k in ks])
        for (setup, integrator), ks in taken.items()
    ]
    return result, {setup: reference.samples["q"][-1, 0] for setup, reference in references.items()}


def error_table(name: str, law: str, pair: Sequence[Convergence]) -> Table:
    """Errors of both integrators over the step."""
    out = Table(title=f"{name}, {law}: relative errors", title_justify="left")
    out.add_column("step [µs]", justify="right")
    for result in pair:
        for quantity in QUANTITIES:
            out.add_column(f"{result.integrator}\n{quantity}", justify="right")
    columns = [r.errors(quantity) for r in pair for quantity in QUANTITIES]
    for k, step in enumerate(pair[0].steps):
        out.add_row(f"{step * 1e6:.5g}", *(f"{errors[k]:.1e}" if k < len(errors) else "" for errors in columns))
    return out


def slope_table(found: Sequence[Convergence]) -> Table:
    """Slopes over all and over the finest steps."""
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


def scheme_table(title: str, schemes: Sequence[Scheme]) -> Table:
    """Order and cost of integration schemes."""
    out = Table(title=title, title_justify="left")
    for heading in ("scheme", "order", "solves for 1 %", "for 0.1 %", "for 0.01 %"):
        out.add_column(heading, justify="left" if heading == "scheme" else "right")
    for s in schemes:
        costs = [s.cost_of(error) for error in (1e-2, 1e-3, 1e-4)]
        out.add_row(s.name, f"{s.slope():.2f}", *("–" if c is None else f"{c:.0f}" for c in costs))
    return out


def slopes_of(r: Convergence) -> dict[str, dict[str, float]]:
    """All slopes, for JSON."""
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
    found: list[Convergence], ends: dict[Setup, Array], done: Callable[[float], None]
) -> dict[str, list[Scheme]]:
    """BDF1, BDF2 and extrapolated BDF1 on whole scenes: errors of the final q over Newton iterations."""
    result = {}
    setups: tuple[Setup, ...] = (("rolling", "viscous"), ("pushing", "viscous"), ("pushing", "elastic"))
    for name, law in setups:
        schemes = [
            Scheme(r.integrator.upper(), r.steps[:9], [e.end for e in r.runs[:9]], [e.iterations for e in r.runs[:9]])
            for r in found
            if (r.scene, r.law) == (name, law)
        ]
        scene = load_scene(name, friction=law, overrides=MARKER_GRID.get(name))
        moves, end = reference_motion(scene), ends[name, law]
        size = float(np.linalg.norm(end - moves.q0))
        steps = [LONGEST / 2**k for k in range(8)]
        errors, iterations = [], []
        for step in steps:
            q, cost = extrapolated_scene(simulator(scene, step, "bdf1"), simulator(scene, step / 2, "bdf1"), moves)
            errors.append(float(np.linalg.norm(q - end)) / size)
            iterations.append(cost)
            done(step / sum(steps) / len(setups))
        result[f"{name}, {law}"] = [*schemes, Scheme("BDF1 extrapolated", steps, errors, iterations)]
    return result
