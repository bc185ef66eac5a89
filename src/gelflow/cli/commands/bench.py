"""`gelflow bench`: how fast simulator and tracker are, beside others, and whether what was timed was right."""

import argparse
import json
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.measurement.timing import BenchmarkOptions, Report

WIDTH = 80
MEASUREMENTS = {
    "rolling": "the ball rolling run, beside MuJoCo and the paper's simulator",
    "scenes": "each scene on its motion",
    "gradients": "forwards, and forwards and backwards",
    "batch": "many environments on one core and on all",
    "markers": "a marker's reading and its gradient, for each shape",
    "precision": "single precision beside double, errors and speed",
    "tracking": "marker tracking: errors on images with known truth, speed, beside Lucas-Kanade and dense flow",
    "growth": "time against bodies, touching points, markers, environments",
}
_LONG = ("tracking", "growth")  # these only run when they are named


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "what",
        nargs="*",
        metavar="WHAT",
        help="; ".join(f"{name}: {text}" for name, text in MEASUREMENTS.items())
        + f". Without any: all but {' and '.join(_LONG)}, quick",
    )
    parser.add_argument("--quick", action="store_true", help="fewer sizes, shorter runs, fewer repeats")
    parser.add_argument(
        "--repeats", type=int, metavar="N", help="timed runs of each, of which the median counts (15; quick: 5)"
    )
    parser.add_argument("--markdown", action="store_true", help="print tables for a document")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything to a file, with the machine")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw growth or tracking (PNG)")
    parser.add_argument(
        "--paper-model", type=Path, metavar="FILE", help="tactile_pad.xml of the paper's simulator, if it is installed"
    )


def run(args: argparse.Namespace) -> int:
    """Measure; prints tables. 1 when a timed run was too far from its converged twin."""
    from gelflow.measurement.machine import processor
    from gelflow.measurement.timing import QUICK_REPEATS, REPEATS, BenchmarkOptions
    from gelflow.toml_tables import suggestion

    quick = args.quick or not args.what
    repeats = args.repeats if args.repeats is not None else QUICK_REPEATS if quick else REPEATS
    if repeats < 1:
        raise UsageError(f"--repeats must be at least 1, got {repeats}")
    for name in args.what:
        if name not in MEASUREMENTS:
            raise UsageError(f"no measurement {name!r}; {suggestion(name, tuple(MEASUREMENTS))}")
    wanted = list(dict.fromkeys(args.what)) or [name for name in MEASUREMENTS if name not in _LONG]
    if args.picture is not None and ("growth" in wanted) == ("tracking" in wanted):
        raise UsageError("--picture draws growth or tracking: ask for one, as in gelflow bench growth --picture g.png")
    console = Console(width=WIDTH)
    console.print(f"{processor()}. Medians of {repeats} repeats, all of one table taken in turn.", highlight=False)
    reports: list[Report] = []
    for name in wanted:
        with _Bar() as bar:
            found = _measure(name, BenchmarkOptions(quick=quick, repeats=repeats, progress=bar), args)
        for report in found:
            _show(console, report, markdown=args.markdown)
        reports += found
    if args.json is not None:
        _write(args.json, reports, quick=quick, repeats=repeats)
        print(args.json)
    return conclude(reports)


def conclude(reports: "Sequence[Report]") -> int:
    """Say which timed runs were wrong; 1 when there was one."""
    outside = [line for report in reports for line in report.violations]
    for line in outside:
        print(f"outside: {line}")
    return 1 if outside else 0


def _measure(name: str, options: "BenchmarkOptions", args: argparse.Namespace) -> "list[Report]":
    if name == "rolling":
        from gelflow.sim.benchmark.speed.rolling import measure_rolling

        return [measure_rolling(options, paper_model=args.paper_model)]
    if name == "scenes":
        from gelflow.sim.benchmark.speed.scenes import measure_scenes

        return [measure_scenes(options)]
    if name == "gradients":
        from gelflow.sim.benchmark.speed.gradients import measure_gradients

        return [measure_gradients(options)]
    if name == "batch":
        from gelflow.sim.benchmark.speed.batch import measure_batch

        return [measure_batch(options)]
    if name == "markers":
        from gelflow.sim.benchmark.speed.markers import measure_markers

        return [measure_markers(options)]
    if name == "precision":
        from gelflow.sim.benchmark.speed.precision import measure_precision

        return [measure_precision(options)]
    if name == "tracking":
        return _measure_tracking(options, args.picture)
    from gelflow.sim.benchmark.speed.growth import measure_growth

    report, found = measure_growth(options)
    if args.picture is not None:
        from gelflow.sim.benchmark.speed.growth_picture import draw

        draw(found, args.picture)
    return [report]


def _measure_tracking(options: "BenchmarkOptions", picture: Path | None) -> "list[Report]":
    from gelflow.perception.benchmark.tracking import measure_tracking

    reports = measure_tracking(options)
    if picture is not None:
        from gelflow.perception.benchmark.curves import draw, measure_curves

        curves = measure_curves(options)
        draw(curves, picture)
        reports.append(curves)
    return reports


def _show(console: Console, report: "Report", *, markdown: bool) -> None:
    if markdown:  # not through rich, which would fold its lines
        heads = [report.columns, ["---", *["---:"] * (len(report.columns) - 1)]]
        print("", *("| " + " | ".join(row) + " |" for row in (*heads, *report.rows)), "", report.note, sep="\n")
        return
    table = Table(title=report.title, title_justify="left", box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for i, column in enumerate(report.columns):
        table.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    for row in report.rows:
        table.add_row(*row)
    console.print()
    console.print(table)
    console.print(report.note, style="dim", highlight=False)


def _write(file: Path, reports: "Sequence[Report]", *, quick: bool, repeats: int) -> None:
    from gelflow.measurement.machine import processor
    from gelflow.sim.benchmark import versions

    version = versions() | {"opencv-contrib-python-headless": metadata.version("opencv-contrib-python-headless")}
    record = {"format": 1, "processor": processor(), "versions": version, "quick": quick, "repeats": repeats}
    record |= {report.name: report.to_dict() for report in reports}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


class _Bar:
    """A bar on the terminal, drawn only between timed runs: a thread of its own would disturb them."""

    def __init__(self) -> None:
        errors = Console(stderr=True)  # what is piped out of the command stays clean
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        self._progress = Progress(
            *columns, console=errors, transient=True, auto_refresh=False, disable=not errors.is_terminal
        )
        self._task: TaskID | None = None

    def __enter__(self) -> "_Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, what: str, total: int) -> None:
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(what, total=total)
        self._progress.refresh()

    def advance(self) -> None:
        assert self._task is not None
        self._progress.advance(self._task)
        self._progress.refresh()
