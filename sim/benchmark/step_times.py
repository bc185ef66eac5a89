"""Time of a step by part of the scene, on this machine (`gelflow describe`).

Removing a contact changes the motion and the number of Newton iterations. Therefore the scene is timed with the part
duplicated: the duplicate has stiffness and damping 0, is computed at the same points, and changes no result. The
additional time of the step is the cost of the part.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.measurement.machine import processor
from gelflow.sim.scene import Scene
from gelflow.sim.scene.start_controls import holding_controls
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]
State = tuple[NDArray[Any], ...]

# Length of the run from the scene's start, and interval between its timed steps.
RUN_STEPS = 100
EVERY = 5

_DUPLICATE = " again"  # suffix of the names of duplicates
_FORCE_PARAMS = ("kn", "kt", "kd", "ks")  # 0 in the duplicate


@dataclass(frozen=True)
class Part:
    """One part of a step."""

    name: str
    microseconds: float
    share: float  # of the whole step


@dataclass(frozen=True)
class StepTimes:
    """Times of a step and its parts [µs], one environment, one thread."""

    machine: str
    run_steps: int  # length of the run, from the scene's start
    timed_steps: int  # of the run
    repeats: int
    whole: float  # one call of `Simulator.step`, mean over the timed steps
    quartiles: tuple[float, float]  # of the whole step, over the repeats
    at_start: float  # first step of the run
    newton_iterations: float  # per timed step
    halved_steps: int  # timed steps that were split into substeps
    parts: tuple[Part, ...]  # their sum is the whole step
    reading: float | None  # one evaluation of all tactile forces, not part of a step; None without pads


def with_duplicates(scene: Scene) -> list[tuple[str, Simulator]]:
    """Name of each contact and pad, and a simulator of the scene with a duplicate of it that has no force.

    All simulators have the motion of the scene.
    """
    result = []
    for group in dict.fromkeys(c.group for c in scene.contacts):
        duplicates = tuple(
            replace(c, name=c.name + _DUPLICATE, group=group + _DUPLICATE, points=c.points + _DUPLICATE)
            for c in scene.contacts
            if c.group == group
        )
        # Separate points: shared ones would be in the processor cache when the duplicate is evaluated.
        names = {c.points for c in duplicates}
        points = tuple(replace(p, name=p.name + _DUPLICATE) for p in scene.points if p.name + _DUPLICATE in names)
        both = replace(scene, contacts=(*scene.contacts, *duplicates), points=(*scene.points, *points))
        sim = Simulator(both, threads=1)
        for contact in duplicates:
            for number in _FORCE_PARAMS:
                sim.param(f"{contact.name}.{number}")[:] = 0
        result.append((f"contact {group}", sim))
    for pad in scene.pads:
        what = "friction anchors of its markers" if pad.law == "elastic" else "viscous, not evaluated"
        both = replace(scene, pads=(*scene.pads, replace(pad, name=pad.name + _DUPLICATE)))
        sim = Simulator(both, threads=1)
        if pad.collides:
            what = "contact points and markers"
            for number in _FORCE_PARAMS:
                sim.param(f"{pad.name}{_DUPLICATE}.{number}")[:] = 0
        result.append((f"pad {pad.name}: {what}", sim))
    return result


def measure(scene: Scene, *, repeats: int = 60, done: Callable[[], None] = lambda: None) -> StepTimes:
    """Time a step and its parts.

    The scene runs for `RUN_STEPS` steps from its start under `holding_controls`. Single steps from every
    `EVERY`th state of the run are timed, in turn with the scene and with each of `with_duplicates`. Times and their
    differences are medians over the repeats for each state, and means over the states.

    Parameters
    ----------
    repeats: timed steps from each state
    done: called after each repeat

    Raises UsageError when `repeats` is below 1, SimulationError when a step fails.
    """
    if repeats < 1:
        raise UsageError(f"repeats must be at least 1, got {repeats}")
    u = holding_controls(scene)
    twice = with_duplicates(scene)
    sims = [Simulator(scene, threads=1), *(sim for _, sim in twice)]
    runs = [_record(sim, scene.q0, u) for sim in sims]
    free = Simulator(replace(scene, contacts=(), pads=()), threads=1)
    steps = np.zeros((repeats, len(sims), len(runs[0])))
    readings = np.zeros((repeats, len(runs[0])))
    calls = []
    for repeat in range(repeats):
        for i, (sim, states) in enumerate(zip(sims, runs, strict=True)):
            for k, state in enumerate(states):
                _set_state(sim, state)
                steps[repeat, i, k] = _seconds(partial(sim.step, u))
        for k, state in enumerate(runs[0]):
            _set_state(sims[0], state)
            readings[repeat, k] = _seconds(sims[0].tactile)
        calls.append(_call_overhead(free, scene.q0, u))
        done()
    typical = np.median(steps[:, 0], axis=0) * 1e6
    whole = float(typical.mean())
    longer = np.median(steps[:, 1:] - steps[:, :1], axis=0).mean(axis=1) * 1e6
    taken = [("call from Python", statistics.median(calls) * 1e6)]
    taken += [(name, float(t)) for (name, _), t in zip(twice, longer, strict=True)]
    taken.insert(1, ("bodies, joints, actuators, solver", whole - sum(t for _, t in taken)))
    low, high = np.percentile(steps[:, 0].mean(axis=1) * 1e6, (25, 75))
    return StepTimes(
        machine=processor(),
        run_steps=RUN_STEPS,
        timed_steps=len(runs[0]),
        repeats=repeats,
        whole=whole,
        quartiles=(float(low), float(high)),
        at_start=float(typical[0]),
        newton_iterations=float(sims[0].iterations[0]) / repeats / len(runs[0]),
        halved_steps=int(sims[0].halved[0]) // repeats,
        parts=tuple(Part(name, t, t / whole) for name, t in taken),
        reading=float(np.median(readings, axis=0).mean() * 1e6) if scene.pads else None,
    )


def _seconds(work: Callable[[], object]) -> float:
    clock = time.perf_counter()
    work()
    return time.perf_counter() - clock


def _record(sim: Simulator, q0: Array, u: Array) -> list[State]:
    """States (q, v, anchors, anchored) at every `EVERY`th step of the run. Raises SimulationError when a step fails."""
    sim.q[:] = q0
    states: list[State] = []
    for _ in range(0, RUN_STEPS, EVERY):
        states.append((sim.q.copy(), sim.v.copy(), sim.anchors.copy(), sim.anchored.copy()))
        sim.step(u, EVERY)
    sim.check()
    sim.reset()  # resets the iteration counts
    return states


def _set_state(sim: Simulator, state: State) -> None:
    for own, recorded in zip((sim.q, sim.v, sim.anchors, sim.anchored), state, strict=True):
        own[:] = recorded


def _call_overhead(sim: Simulator, q0: Array, u: Array) -> float:
    """Overhead of a call [s]: many calls of one step, minus one call of many steps."""

    def run(calls: int, steps: int) -> float:
        sim.reset()
        sim.q[:] = q0
        clock = time.perf_counter()
        for _ in range(calls):
            sim.step(u, steps)
        return time.perf_counter() - clock

    return (run(RUN_STEPS, 1) - run(1, RUN_STEPS)) / RUN_STEPS
