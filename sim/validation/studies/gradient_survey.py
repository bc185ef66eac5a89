"""Gradient checks over all scenes, shapes, friction laws and integrators, from random states in contact.

Each state has a scalar of positions, velocities or marker forces, in turn. Errors are relative:

dual        largest difference to dual numbers, which run the same code
difference  largest difference to five-point central differences
skipped    share of gradient entries without a stencil on one smooth piece of the dynamics
where       input with the largest error; parameters in groups of one kind: "kn", "pos", "scale", …
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.validation.contact_states import FREE, SHAPES, cloud_on_shape, converged_simulator, scene_in_contact
from gelflow.sim.validation.gradient_check import Output, RolloutLoss, compare_to_differences, compare_to_dual_numbers
from gelflow.sim.validation.reference_motions import PUBLISHED_ROLLING_FORCES, SCENES

OUTPUTS: tuple[Output, ...] = ("q", "v", "tactile")
ROLLING_RUN = "rolling run"
DUAL_LIMIT, DIFFERENCE_LIMIT, SKIPPED_LIMIT = 1e-10, 1e-6, 0.05
STATES = 12  # per combination


@dataclass
class GradientErrors:
    """Largest errors of one combination over its states; None for a comparison that was not made."""

    name: str
    law: str
    integrator: str
    states: int = 0
    entries: int = 0
    dual: float = 0.0
    dual_worst: str = ""
    difference: float | None = None
    difference_worst: str = ""
    skipped: float | None = None

    @property
    def within_limits(self) -> bool:
        smooth = self.difference is None or (
            self.difference < DIFFERENCE_LIMIT and (self.skipped or 0.0) <= SKIPPED_LIMIT
        )
        return self.dual < DUAL_LIMIT and smooth


def count(states: int) -> int:
    """Number of states that `survey` checks with `states` per combination."""
    pairs = len(FRICTION_LAWS) * len(INTEGRATORS)
    return pairs * ((len(SCENES) + len(SHAPES) + 1) * states + 1)


def survey(states: int, progress: Callable[[float], None], *, seed: int = 0) -> list[GradientErrors]:
    """Check all combinations with `states` states each, and the published rolling run.

    `progress` is advanced by 1 after each state. Raises SimulationError when a rollout fails.
    """
    results = []
    for name, law, integrator in itertools.product((*SCENES, *SHAPES, FREE), FRICTION_LAWS, INTEGRATORS):
        result = GradientErrors(name, law, integrator)
        for k in range(seed, seed + states):
            _check_state(result, k)
            progress(1)
        results.append(result)
    for law, integrator in itertools.product(FRICTION_LAWS, INTEGRATORS):
        result = GradientErrors(ROLLING_RUN, law, integrator)
        _check_rolling_run(result)
        progress(1)
        results.append(result)
    return results


def _check_state(result: GradientErrors, seed: int) -> None:
    """Check one random state of a combination."""
    rng = np.random.default_rng(seed)
    prepare = scene_in_contact if result.name in SCENES else cloud_on_shape
    sim, u = prepare(result.name, result.law, result.integrator, rng)
    loss = RolloutLoss.random(sim, u, OUTPUTS[seed % len(OUTPUTS)], rng)
    dual, difference = compare_to_dual_numbers(loss, rng, directions=2), compare_to_differences(loss)
    if dual.error >= result.dual:
        result.dual, result.dual_worst = dual.error, dual.worst
    if result.difference is None or difference.error >= result.difference:
        result.difference, result.difference_worst = difference.error, difference.worst
    skipped = (result.skipped or 0.0) * result.entries + difference.skipped * difference.entries
    result.states, result.entries = result.states + 1, result.entries + difference.entries
    result.skipped = skipped / result.entries


def _check_rolling_run(result: GradientErrors) -> None:
    """Check the first 110 steps of the published run, for a loss of all marker forces and for the final positions."""
    (down, push), (_, roll) = PUBLISHED_ROLLING_FORCES[:2]
    sim, rng = converged_simulator("rolling", result.law, result.integrator), np.random.default_rng(0)
    u = np.array([push] * down + [roll] * (110 - down))
    forces = sim.rollout(u[:, None], read_after=(len(u),)).tactile[0, 0]
    for loss in (RolloutLoss(sim, u, "tactile", forces), RolloutLoss.random(sim, u, "q", rng)):
        dual = compare_to_dual_numbers(loss, rng, directions=1)
        result.states += 1
        if dual.error >= result.dual:
            result.dual, result.dual_worst = dual.error, dual.worst


def table(results: Sequence[GradientErrors]) -> Table:
    """Errors of all combinations; those outside the limits are red."""
    out = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("case", "law", "steps", "dual", "where", "difference", "where", "skipped"):
        out.add_column(column, justify="right" if column == "skipped" else "left", no_wrap=True)
    for r in results:
        out.add_row(
            *(r.name, r.law, r.integrator, f"{r.dual:.0e}", r.dual_worst),
            *("" if r.difference is None else f"{r.difference:.0e}", r.difference_worst),
            "" if r.skipped is None else f"{r.skipped:.1%}",
            style=None if r.within_limits else "red",
        )
    return out
