"""Where the time of a step goes, on this machine; `gelflow describe` prints it.

A part cannot be timed by leaving it out: without a contact the scene moves otherwise and Newton's method takes other
iterations. So the scene is timed with the part *twice*. The second one has stiffness and damping 0: it is computed just
like the first, at the same points, and changes nothing. What the step takes longer is what the part costs.
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
from gelflow.sim.simulator import Simulator

Array = NDArray[np.float64]
State = tuple[NDArray[Any], ...]

# The run whose steps are timed: so many steps from the scene's start, of which every fifth.
RUN_STEPS = 100
EVERY = 5

_AGAIN = " again"  # what the second one of a part is called
_FORCES = ("kn", "kt", "kd", "ks")  # the numbers that are 0 in it


@dataclass(frozen=True)
class Part:
    """One part of a step."""

    name: str
    microseconds: float
    share: float  # of the whole step


@dataclass(frozen=True)
class StepTimes:
    """Where the time of a step goes. Times in µs, one environment, one thread."""

    machine: str
    run_steps: int  # length of the run, from the scene's start
    timed_steps: int  # of the run
    repeats: int
    whole: float  # a step as a user calls it, the mean over the timed steps
    quartiles: tuple[float, float]  # of the repeats' whole steps
    at_start: float  # the run's first step alone
    newton_iterations: float  # per timed step
    halved_steps: int  # of the timed ones: were taken as substeps
    parts: tuple[Part, ...]  # add up to the whole
    reading: float | None  # one reading of all markers, which is no part of a step; None without pads


def holding_controls(scene: Scene) -> Array:
    """Controls that ask for nothing: servos hold where the scene starts, all else is 0. Shape (nu,)."""
    lengths = [a.gear * scene.q0[scene.joints[a.joint].q_start] for a in scene.actuators]
    servo = [a.kind == "position" for a in scene.actuators]
    return np.where(servo, lengths, 0.0)


def with_duplicates(scene: Scene) -> list[tuple[str, Simulator]]:
    """For each contact and each pad, its name and a simulator of the scene that has it twice, the second without force.

    All of them move exactly like the scene.
    """
    found = []
    for group in dict.fromkeys(c.group for c in scene.contacts):
        twins = tuple(
            replace(c, name=c.name + _AGAIN, group=group + _AGAIN, points=c.points + _AGAIN)
            for c in scene.contacts
            if c.group == group
        )
        # Own points too: shared ones would be in the processor's cache when the second contact comes to them.
        names = {c.points for c in twins}
        points = tuple(replace(p, name=p.name + _AGAIN) for p in scene.points if p.name + _AGAIN in names)
        both = replace(scene, contacts=(*scene.contacts, *twins), points=(*scene.points, *points))
        sim = Simulator(both, threads=1)
        for contact in twins:
            for number in _FORCES:
                sim.param(f"{contact.name}.{number}")[:] = 0
        found.append((f"contact {group}", sim))
    for pad in scene.pads:
        what = "memory of its markers" if pad.law == "elastic" else "viscous, not read"
        both = replace(scene, pads=(*scene.pads, replace(pad, name=pad.name + _AGAIN)))
        found.append((f"pad {pad.name}: {what}", Simulator(both, threads=1)))
    return found


def measure(scene: Scene, *, repeats: int = 60, done: Callable[[], None] = lambda: None) -> StepTimes:
    """Time a step and its parts.

    The scene runs for `RUN_STEPS` steps from its start under `holding_controls`. Then single steps are taken from every
    `EVERY`th of the states it went through, by the scene and by those of `with_duplicates`, in turn, again and again. A
    step's time and the differences from it are medians over the repeats for each state, then means over the states.

    Parameters
    ----------
    repeats: how often each state is stepped from
    done: called after each of the repeats

    Raises UsageError when `repeats` is below 1, SimulationError when a step cannot be taken.
    """
    if repeats < 1:
        raise UsageError(f"repeats must be at least 1, got {repeats}")
    u = holding_controls(scene)
    twice = with_duplicates(scene)
    sims = [Simulator(scene, threads=1), *(sim for _, sim in twice)]
    runs = [_recorded(sim, scene.q0, u) for sim in sims]
    free = Simulator(replace(scene, contacts=(), pads=()), threads=1)
    steps = np.zeros((repeats, len(sims), len(runs[0])))
    readings = np.zeros((repeats, len(runs[0])))
    calls = []
    for repeat in range(repeats):
        for i, (sim, states) in enumerate(zip(sims, runs, strict=True)):
            for k, state in enumerate(states):
                _place(sim, state)
                steps[repeat, i, k] = _seconds(partial(sim.step, u))
        for k, state in enumerate(runs[0]):
            _place(sims[0], state)
            readings[repeat, k] = _seconds(sims[0].tactile)
        calls.append(_call(free, scene.q0, u))
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


def _recorded(sim: Simulator, q0: Array, u: Array) -> list[State]:
    """States of the run at every `EVERY`th step: q, v, anchors, anchored. Raises SimulationError when it fails."""
    sim.q[:] = q0
    states: list[State] = []
    for _ in range(0, RUN_STEPS, EVERY):
        states.append((sim.q.copy(), sim.v.copy(), sim.anchors.copy(), sim.anchored.copy()))
        sim.step(u, EVERY)
    sim.check()
    sim.reset()  # iterations count from here
    return states


def _place(sim: Simulator, state: State) -> None:
    for own, recorded in zip((sim.q, sim.v, sim.anchors, sim.anchored), state, strict=True):
        own[:] = recorded


def _call(sim: Simulator, q0: Array, u: Array) -> float:
    """What one call costs besides the step in it [s]: many calls of a step against one call of many."""

    def run(calls: int, steps: int) -> float:
        sim.reset()
        sim.q[:] = q0
        clock = time.perf_counter()
        for _ in range(calls):
            sim.step(u, steps)
        return time.perf_counter() - clock

    return (run(RUN_STEPS, 1) - run(1, RUN_STEPS)) / RUN_STEPS
