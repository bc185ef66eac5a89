"""`gelflow calibrate`: fit the simulator to recorded insertions."""

import argparse
import json
import os
from pathlib import Path

from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_quick, add_seed
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError
from gelflow.policies.calibration.calibrated_scene import MODEL, SCENE, write_scene
from gelflow.policies.calibration.calibration import Calibration, calibrate
from gelflow.policies.calibration.fit import FitSettings
from gelflow.policies.calibration.report import advice_lines, error_lines, page, plain_report
from gelflow.policies.calibration.session_recordings import read_recordings

_QUICK = FitSettings(starts=2, points=1, poses=24, steps=1)


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("sessions", nargs="+", type=Path, metavar="SESSION", help="recorded sessions (.mcap)")
    add_out(
        parser, "new folder for report.html, report.json and scene.toml", default=Path("out/calibration"), folder=True
    )
    add_seed(parser)
    add_quick(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Fit, print the parameters, and write the report."""
    output = Output(args.json)
    files = [args.out / "report.json", args.out / "report.html", args.out / SCENE, args.out / MODEL]
    for file in files:
        if file.exists():
            raise UsageError(f"{file} exists; name a new folder with --out")
    recordings = read_recordings(args.sessions)
    settings = _QUICK if args.quick else FitSettings()
    with progress_bar(count=True) as progress:
        bar = progress.add_task("fitting", total=settings.starts)
        result = calibrate(
            recordings,
            seed=args.seed,
            settings=settings,
            processes=min(settings.starts, os.cpu_count() or 1),
            progress=lambda done: progress.update(bar, completed=done),
        )
    report = plain_report(result, args.sessions)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        files[0].write_text(json.dumps(report, indent=2) + "\n")
        files[1].write_text(page(result, args.sessions, recordings.task.grid))
        scene = write_scene(result, args.out)
    except OSError as error:
        raise UsageError(f"cannot write the report to {args.out}: {error}") from error
    if output.json:
        output.result(report)
        return SUCCESS
    output.console.print(_table(result))
    for line in error_lines(result):
        output.text(line)
    for line in advice_lines(result):
        output.text(f"record next: {line}")
    output.text(f"the report is {files[1]}")
    if scene:
        output.text(f"the scene with the known values is {scene[0]}")
    return SUCCESS


def _table(result: Calibration) -> Table:
    table = Table("parameter", "value", "95 % interval", "unit", "from the recordings")
    for column in table.columns[1:3]:
        column.justify = "right"
    for estimate in result.estimates:
        interval = f"{estimate.low:.3g} … {estimate.high:.3g}"
        style = "dim" if estimate.verdict == "unknown" else None
        unit = estimate.parameter.unit
        table.add_row(estimate.parameter.name, f"{estimate.value:.3g}", interval, unit, estimate.verdict, style=style)
    return table
