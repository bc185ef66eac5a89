"""Check gradients by everything: all scenes and shapes × friction laws × integrators, against two other ways to them.

`python benchmarks/gradients.py` prints a table and writes benchmarks/results/gradients.json. For each combination it
takes as many random states in contact as --states says, each with a scalar of positions, velocities or marker readings,
in turn. tests/sim/gradients/test_gradients.py does the same with three. In the table:

where       parameters count in groups of one kind: "kn", "pos", "scale", ...
dual        largest relative difference to dual numbers, which run the same code: below 1e-10
difference  largest relative difference to five-point central differences: below 1e-6
left out    share of entries of the gradient that no stencil could be found for, on the middle's side of every kink
"""

import argparse
import itertools
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gelflow.measurement.machine import processor
from gelflow.sim._core import LEVEL
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS
from gelflow.sim.validation.contact_states import FREE, SHAPES, cloud_on_shape, converged_simulator, scene_in_contact
from gelflow.sim.validation.gradient_check import Output, RolloutLoss, compare_to_differences, compare_to_dual_numbers
from gelflow.sim.validation.reference_motions import PUBLISHED_ROLLING_FORCES, SCENES

FILE = Path(__file__).parent / "results" / "gradients.json"
OUTPUTS: tuple[Output, ...] = ("q", "v", "tactile")
ROLLING_RUN = "rolling run"
EXACT, RIGHT, LEFT_OUT = 1e-10, 1e-6, 0.05


@dataclass
class Row:
    """One combination; errors are the largest over its states, None where that way was not gone."""

    name: str
    law: str
    integrator: str
    states: int = 0
    entries: int = 0
    dual: float = 0.0
    dual_worst: str = ""
    difference: float | None = None
    difference_worst: str = ""
    left_out: float | None = None

    @property
    def holds(self) -> bool:
        right = self.difference is None or (self.difference < RIGHT and (self.left_out or 0.0) <= LEFT_OUT)
        return self.dual < EXACT and right


def check(row: Row, seed: int) -> None:
    """One more state of a combination."""
    rng = np.random.default_rng(seed)
    sim, u = (scene_in_contact if row.name in SCENES else cloud_on_shape)(row.name, row.law, row.integrator, rng)
    case = RolloutLoss.random(sim, u, OUTPUTS[seed % len(OUTPUTS)], rng)
    exact, right = compare_to_dual_numbers(case, rng, directions=2), compare_to_differences(case)
    if exact.error >= row.dual:
        row.dual, row.dual_worst = exact.error, exact.worst
    if row.difference is None or right.error >= row.difference:
        row.difference, row.difference_worst = right.error, right.worst
    left = (row.left_out or 0.0) * row.entries + right.skipped * right.entries
    row.states, row.entries = row.states + 1, row.entries + right.entries
    row.left_out = left / row.entries


def check_rolling_run(row: Row) -> None:
    """The published run's first 110 steps, with a loss of all marker readings at the end, and positions there."""
    (down, push), (_, roll) = PUBLISHED_ROLLING_FORCES[:2]
    sim, rng = converged_simulator("rolling", row.law, row.integrator), np.random.default_rng(0)
    u = np.array([push] * down + [roll] * (110 - down))
    reading = sim.rollout(u[:, None], read_after=(len(u),)).tactile[0, 0]
    for case in (RolloutLoss(sim, u, "tactile", reading), RolloutLoss.random(sim, u, "q", rng)):
        exact = compare_to_dual_numbers(case, rng, directions=1)
        row.states += 1
        if exact.error >= row.dual:
            row.dual, row.dual_worst = exact.error, exact.worst


def table(rows: list[Row]) -> Table:
    result = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for column in ("case", "law", "steps", "dual", "where", "difference", "where", "left out"):
        result.add_column(column, justify="right" if column == "left out" else "left", no_wrap=True)
    for row in rows:
        difference = "" if row.difference is None else f"{row.difference:.0e}"
        left_out = "" if row.left_out is None else f"{row.left_out:.1%}"
        result.add_row(
            *(row.name, row.law, row.integrator, f"{row.dual:.0e}", row.dual_worst, difference, row.difference_worst),
            left_out,
            style=None if row.holds else "red",
        )
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description="Check gradients by everything and write the result to a file.")
    parser.add_argument("--states", type=int, default=12, metavar="N", help="states per combination (%(default)s)")
    parser.add_argument("--out", type=Path, default=FILE, help="file to write (%(default)s)")
    args = parser.parse_args()
    rows = [Row(*names) for names in itertools.product((*SCENES, *SHAPES, FREE), FRICTION_LAWS, INTEGRATORS)]
    runs = [Row(ROLLING_RUN, *names) for names in itertools.product(FRICTION_LAWS, INTEGRATORS)]
    console, begin = Console(width=80), time.perf_counter()
    work = [*((row, seed) for row in rows for seed in range(args.states)), *((row, -1) for row in runs)]
    for row, seed in track(work, "checking", console=Console(stderr=True)):
        if seed < 0:
            check_rolling_run(row)
        else:
            check(row, seed)
    console.print(table([*rows, *runs]))
    seconds = time.perf_counter() - begin
    record = {
        "format": 1,
        "processor": processor(),
        "core": LEVEL,
        "seconds": round(seconds),
        "limits": {"dual": EXACT, "difference": RIGHT, "left_out": LEFT_OUT},
        "results": [asdict(row) for row in (*rows, *runs)],
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    wrong = [row for row in (*rows, *runs) if not row.holds]
    print(f"{args.out}: {len(wrong)} of {len(rows) + len(runs)} combinations outside the limits, {seconds:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
