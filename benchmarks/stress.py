"""Two million random steps at the extremes: `python benchmarks/extremes.py`, a little over 3 minutes on 2 cores.

What is drawn stands in `gelflow.sim`. Prints how many steps failed, needed substeps, and what they cost; the
figures go to benchmarks/results/stress.json. Exit status 1: a step of the normal range failed, or over 1 % of all.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from gelflow.measurement.machine import processor
from gelflow.sim import _core
from gelflow.sim.simulator import STATUS_MESSAGES
from gelflow.sim.validation.reference_motions import SCENES
from gelflow.sim.validation.stress import KINDS, StepStatistics, StressTest, stress_batches

RESULTS = Path(__file__).parent / "results"
ENVS, STEPS = 250, 20


def main() -> int:
    parser = argparse.ArgumentParser(description="Count what fails among random steps at the extremes.")
    parser.add_argument("--rounds", type=int, default=21, metavar="N", help="100 000 steps each (%(default)s)")
    parser.add_argument("--out", type=Path, default=RESULTS / "stress.json", help="file to write (%(default)s)")
    args = parser.parse_args()
    rows: dict[tuple[str, str], StepStatistics] = {}
    seconds: dict[tuple[str, str], float] = {}
    test = StressTest(envs=ENVS, steps=STEPS)
    begin = time.perf_counter()
    for draw in track(stress_batches(args.rounds), "batches", console=Console(stderr=True, width=80)):
        started = time.perf_counter()
        statistics = test.run(draw)
        took = time.perf_counter() - started
        for key in (("kind", draw.kind), ("scene", draw.scene), ("precision", draw.precision), ("", "everything")):
            rows.setdefault(key, StepStatistics()).add(statistics)
            seconds[key] = seconds.get(key, 0.0) + took
    wall = time.perf_counter() - begin
    order = [("kind", k) for k in KINDS] + [("scene", s) for s in SCENES]
    order += [("precision", "double"), ("precision", "single"), ("", "everything")]
    print(f"{'':22s} {'steps':>9s} {'failed':>9s} {'substeps':>9s} {'Newton':>7s} {'most':>5s} {'us/step':>8s}")
    table: list[dict[str, Any]] = []
    for key in order:
        t = rows.get(key)
        if t is None:
            continue
        share, halved, mean = t.failed / t.steps, t.halved / t.steps, t.iterations / t.steps
        us = 1e6 * seconds[key] / t.steps
        print(
            f"{' '.join(key):22s} {t.steps:9d} {share:9.3%} {halved:9.2%} {mean:7.1f} {t.most_iterations:5d} {us:8.1f}"
        )
        table.append(
            {"of": key[0], "name": key[1], "steps": t.steps, "failed": t.failed, "halved": t.halved}
            | {"iterations": t.iterations, "most_iterations": t.most_iterations, "us_per_step": round(us, 1)}
        )
    total, normal = rows["", "everything"], rows["kind", "normal"]
    cap = _core.ModelSpec().max_step_iterations
    for status, count in sorted(total.reasons.items()):
        print(f"failed, {STATUS_MESSAGES[status]}: {count}")
    print(f"{total.steps} steps in {wall:.0f} s; Newton iterations of a step are capped at {cap}")
    result = {"processor": processor(), "seconds": round(wall, 1), "rows": table}
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    good = normal.failed == 0 and total.failed <= 0.01 * total.steps and total.most_iterations <= cap
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
