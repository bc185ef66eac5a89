"""Calibration in simulated worlds: `coverage` of its intervals, a motion `plan`, or the `transfer` matrix."""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path
from typing import Any

import script
from rich.table import Table

from gelflow.policies.calibration.experiment.coverage import counted, coverage_table, simulated_world
from gelflow.policies.calibration.experiment.planned import measure_plan
from gelflow.policies.calibration.experiment.transfer import measure_world, worlds
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.calibration.planning.motions import SCENARIOS, plan_motions
from gelflow.policies.calibration.session_recordings import nothing_recorded
from gelflow.task import INSERTION

_QUICK = FitSettings(starts=1, members=24, nearby=16, poses=8, steps=1)


def main() -> int:
    """Run the measurement that the first argument names."""
    chooser = argparse.ArgumentParser(description=__doc__)
    chooser.add_argument("measure", choices=("coverage", "plan", "transfer"), help="each has --help of its own")
    chosen = chooser.parse_args(sys.argv[1:2])
    return {"coverage": coverage, "plan": plan, "transfer": transfer}[chosen.measure](sys.argv[2:])


def coverage(words: list[str]) -> int:
    """Calibrate in random worlds and count how often the intervals contain the truth.

    The same command continues a run that was killed.
    """
    arguments = script.parser(
        coverage.__doc__ or "", out="calibration_coverage.json", quick="two worlds with little effort"
    )
    arguments.add_argument("--worlds", type=int, default=100, metavar="N", help="number of worlds (default 100)")
    arguments.add_argument("--first", type=int, default=0, metavar="N", help="seed of the first world (default 0)")
    args = arguments.parse_args(words)
    count = 2 if args.quick else args.worlds
    seeds = range(args.first, args.first + count)
    settings = _QUICK if args.quick else FitSettings()
    result = counted(
        script.measure_each(args, seeds, lambda seed: simulated_world(seed, settings=settings, processes=2), key="seed")
    )
    script.finish(args, script.header() | result, coverage_table(result))
    return 0


def plan(words: list[str]) -> int:
    """Compare the intervals of a motion plan with those of unplanned insertions, which make twice as many attempts."""
    arguments = script.parser(plan.__doc__ or "", out="calibration_plan.json", quick="two worlds")
    arguments.add_argument("--worlds", type=int, default=40, metavar="N", help="number of worlds (default 40)")
    arguments.add_argument("--first", type=int, default=0, metavar="N", help="seed of the first world (default 0)")
    arguments.add_argument("--fits", type=int, default=0, metavar="N", help="worlds that are also calibrated (0)")
    args = arguments.parse_args(words)
    lab = dataclasses.replace(nothing_recorded(INSERTION, grasp_force=None, grasp_height=None), unit="N")
    with script.progress("scenarios", SCENARIOS) as advance:
        motions = plan_motions(lab, progress=lambda done: advance(1)).motions
    count = 2 if args.quick else args.worlds
    seeds = range(args.first, args.first + count)
    with script.progress("worlds", count) as advance:
        settings = _QUICK if args.quick else None
        result = measure_plan(
            seeds, motions, settings=settings, fits=args.fits, processes=2, progress=lambda world: advance(1)
        )
    table = Table("intervals", "worlds", "motions planned", "unplanned", "mean ratio of widths", "same or narrower")
    for key, name in (("expected", "expected"), ("expected_half", "expected, half"), ("fitted", "calibrated")):
        if key in result:
            row, half = result[key], 0.5 if key == "expected_half" else 1.0
            made = f"{row['motions_planned']:.1f}", f"{half * row['motions_unplanned']:.1f}"
            table.add_row(name, str(row["worlds"]), *made, f"{row['mean_ratio']:.2f}", str(row["same_or_narrower"]))
    described = [dataclasses.asdict(motion) for motion in motions]
    script.finish(args, script.header() | {"plan": described} | result, table)
    return 0


def transfer(words: list[str]) -> int:
    """Evaluate the included policy in worlds that differ from training; calibrate and fine-tune where it fails.

    The same command continues a run that was killed.
    """
    arguments = script.parser(transfer.__doc__ or "", out="transfer.json", quick="few insertions, no fine-tuning")
    args = arguments.parse_args(words)
    episodes, below = (32, 0.0) if args.quick else (512, 0.9)

    def measured(name: str) -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            return measure_world(named[name], Path(folder), episodes=episodes, below=below, processes=2)

    named = {world.name: world for world in worlds()}
    rows = script.measure_each(args, list(named), measured, key="world")
    table = Table("world", "included policy", "calibrated and fine-tuned")
    for row in rows:
        table.add_row(row["world"], *(_result(row, key) for key in ("before", "after")))
    script.finish(args, script.header() | {"results": rows}, table)
    return 0


def _result(row: dict[str, Any], key: str) -> str:
    if key not in row:
        return str(row.get("refused", "")) if key == "after" else ""
    result = row[key]
    length = result["corrections"]
    return f"{100 * result['success']:.1f} %" + ("" if length is None else f" ({length:.2f})")


if __name__ == "__main__":
    sys.exit(script.run(main))
