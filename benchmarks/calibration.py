"""Calibration in simulated worlds: `coverage` of its intervals, a motion `plan`, or the `transfer` matrix."""

import argparse
import dataclasses
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import script
from rich.table import Table

from gelflow.policies.calibration.experiment.coverage import measure_coverage
from gelflow.policies.calibration.experiment.planned import measure_plan
from gelflow.policies.calibration.experiment.transfer import measure_world, worlds
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.calibration.planning.motions import SCENARIOS, plan_motions
from gelflow.policies.calibration.session_recordings import nothing_recorded
from gelflow.task import INSERTION

_QUICK = FitSettings(starts=1, members=24, nearby=16, poses=8, steps=1)


def main() -> int:
    """Measure what the first argument names."""
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
    unfinished = _unfinished(args)
    with script.progress("worlds", count) as advance:

        def after_world(result: dict[str, Any]) -> None:
            script.save(unfinished, result)
            advance(1)

        result = measure_coverage(
            seeds, settings=settings, processes=2, measured=_results(unfinished), progress=after_world
        )
    table = Table("worlds", "refused", "all known in their intervals", "known parameters", "of these in the interval")
    keys = ("worlds", "refused", "covered_worlds", "known", "known_in_interval")
    table.add_row(*(str(result[key]) for key in keys))
    script.finish(args, script.header() | result, table)
    unfinished.unlink(missing_ok=True)
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
        result = measure_plan(seeds, motions, fits=args.fits, processes=2, progress=lambda world: advance(1))
    table = Table("intervals", "worlds", "motions planned", "unplanned", "mean ratio of widths", "same or narrower")
    for key, name in (("expected", "expected"), ("expected_half", "expected, half"), ("fitted", "calibrated")):
        if key in result:
            row, half = result[key], 0.5 if key == "expected_half" else 1.0
            made = f"{row['motions_planned']:.1f}", f"{half * row['motions_unplanned']:.1f}"
            table.add_row(name, str(row["worlds"]), *made, f"{row['mean_ratio']:.2f}", str(row["same_or_narrower"]))
    described = [{"x": m.x, "y": m.y, "yaw": m.yaw, "depth": m.depth} for m in motions]
    script.finish(args, script.header() | {"plan": described} | result, table)
    return 0


def transfer(words: list[str]) -> int:
    """Evaluate the shipped policy in worlds that differ from training; calibrate and fine-tune where it fails.

    The same command continues a run that was killed.
    """
    arguments = script.parser(transfer.__doc__ or "", out="transfer.json", quick="few insertions, no fine-tuning")
    args = arguments.parse_args(words)
    episodes, below = (32, 0.0) if args.quick else (512, 0.9)
    unfinished = _unfinished(args)
    rows = {row["world"]: row for row in _results(unfinished)}
    with script.progress("worlds", len(worlds())) as advance:
        for world in worlds():
            if world.name not in rows:
                with tempfile.TemporaryDirectory() as folder:
                    rows[world.name] = measure_world(world, Path(folder), episodes=episodes, below=below, processes=2)
                script.save(unfinished, _record(rows))
            advance(1)
    table = Table("world", "shipped policy", "calibrated and fine-tuned")
    for row in rows.values():
        table.add_row(row["world"], *(_result(row, key) for key in ("before", "after")))
    script.finish(args, _record(rows), table)
    unfinished.unlink(missing_ok=True)
    return 0


def _unfinished(args: argparse.Namespace) -> Path:
    """The file with the results of a run that is not finished."""
    out: Path = args.out
    return out.with_suffix(".quick.part" if args.quick else ".part")


def _results(file: Path) -> list[dict[str, Any]]:
    """The results of a run that was killed."""
    return json.loads(file.read_text())["results"] if file.is_file() else []


def _record(rows: dict[str, Any]) -> dict[str, Any]:
    return script.header() | {"results": list(rows.values())}


def _result(row: dict[str, Any], key: str) -> str:
    if key not in row:
        return str(row.get("refused", "")) if key == "after" else ""
    result = row[key]
    length = result["corrections"]
    return f"{100 * result['success']:.1f} %" + ("" if length is None else f" ({length:.2f})")


if __name__ == "__main__":
    sys.exit(script.run(main))
