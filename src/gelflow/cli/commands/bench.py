"""`gelflow bench`: speed of the simulator and the tracker compared with others, with checks of the timed results."""

import argparse
import json
from collections.abc import Callable, Sequence
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import TaskID
from rich.table import Table

from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.options import add_json, add_out, add_quick, add_repeats
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.measurement.timing import BenchmarkOptions, Report

WIDTH = 80
MEASUREMENTS = {
    "rolling": "the ball rolling motion, compared with MuJoCo and the paper's simulator",
    "scenes": "each scene on its reference motion",
    "gradients": "forward pass, and forward with backward pass",
    "batch": "many environments on one core and on all cores",
    "markers": "reading of a marker and its gradient, for each shape",
    "precision": "single and double precision: errors and speed",
    "startup": "imports and gelflow --help in fresh processes",
    "tracking": "marker tracking: errors on images with known truth and speed, with Lucas-Kanade and dense flow",
    "scaling": "time over the number of bodies, contact points, markers and environments",
}
_LONG = ("tracking", "scaling")  # measured only on request


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "what",
        nargs="*",
        metavar="WHAT",
        help="; ".join(f"{name}: {text}" for name, text in MEASUREMENTS.items())
        + f". Default: all except {' and '.join(_LONG)}, quick",
    )
    add_quick(parser)
    add_repeats(parser, "timed runs of each case (15; quick: 5)")
    parser.add_argument("--markdown", action="store_true", help="print the tables as Markdown")
    parser.add_argument(
        "--paper-model", type=Path, metavar="FILE", help="tactile_pad.xml of the paper's simulator, if it is installed"
    )
    add_out(parser, "folder for bench.json, and the pictures scaling.png and tracking.png", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure and print tables. A negative result: a timed run was too far from its converged reference."""
    from gelflow.measurement.machine import processor
    from gelflow.measurement.timing import QUICK_REPEATS, REPEATS, BenchmarkOptions
    from gelflow.policies.checkpoint import replace_file
    from gelflow.policies.training.folder import create_folder
    from gelflow.toml_tables import suggestion

    quick = args.quick or not args.what
    repeats = args.repeats if args.repeats is not None else QUICK_REPEATS if quick else REPEATS
    if repeats < 1:
        raise UsageError(f"--repeats must be at least 1, got {repeats}")
    for name in args.what:
        if name not in MEASUREMENTS:
            raise UsageError(f"no measurement {name!r}; {suggestion(name, tuple(MEASUREMENTS))}")
    names = list(dict.fromkeys(args.what)) or [name for name in MEASUREMENTS if name not in _LONG]
    if args.paper_model is not None and not ("rolling" in names and args.paper_model.is_file()):
        raise UsageError("--paper-model is for the measurement rolling and must be a file")
    if args.out is not None:
        create_folder(args.out)
    output = Output(args.json, width=WIDTH)
    output.console.print(f"{processor()}. {repeats} repeats; the cases of a table run in turn.")
    reports: list[Report] = []
    pictures: list[Callable[[Path], None]] = []  # each writes a file into the folder
    for name in names:
        with _Bar() as bar:
            options = BenchmarkOptions(quick=quick, repeats=repeats, progress=bar)
            measured = _measure(name, options, args, pictures)
        for report in measured:
            _show(output, report, markdown=args.markdown)
        reports += measured
    record = _record(reports, quick=quick, repeats=repeats)
    output.result(record)
    status = conclude(reports, output)
    if args.out is not None:
        file = args.out / "bench.json"
        replace_file(file, (json.dumps(record, indent=1) + "\n").encode())
        output.text(f"written: {file}")
        for draw in pictures:
            draw(args.out)
    return status


def conclude(reports: "Sequence[Report]", output: Output) -> int:
    """Print the violated bounds and return the exit code."""
    violations = [line for report in reports for line in report.violations]
    for line in violations:
        output.text(f"outside the bounds: {line}")
    return NEGATIVE_RESULT if violations else SUCCESS


def _measure(
    name: str, options: "BenchmarkOptions", args: argparse.Namespace, pictures: list[Callable[[Path], None]]
) -> "list[Report]":
    """Tables of a measurement; adds its pictures to `pictures`."""
    if name == "tracking":
        return _measure_tracking(options, pictures, curves=args.out is not None)
    if name == "scaling":
        return [_measure_scaling(options, pictures)]
    if name == "startup":
        from gelflow.measurement.startup import measure_startup

        return [measure_startup(options)]
    measure: Callable[..., Report] = getattr(import_module(f"gelflow.sim.benchmark.speed.{name}"), f"measure_{name}")
    more = {"paper_model": args.paper_model} if name == "rolling" else {}
    return [measure(options, **more)]


def _measure_scaling(options: "BenchmarkOptions", pictures: list[Callable[[Path], None]]) -> "Report":
    from gelflow.sim.benchmark.speed.scaling import measure_scaling

    report = measure_scaling(options)

    def write(folder: Path) -> None:
        from gelflow.sim.benchmark.speed.scaling_picture import draw

        draw(report.results, folder / "scaling.png")

    pictures.append(write)
    return report


def _measure_tracking(
    options: "BenchmarkOptions", pictures: list[Callable[[Path], None]], *, curves: bool
) -> "list[Report]":
    from gelflow.perception.benchmark.tracking import measure_tracking

    reports = measure_tracking(options)
    if curves:
        from gelflow.perception.benchmark.curves import draw, measure_curves

        measured = measure_curves(options)
        pictures.append(lambda folder: draw(measured.results, folder / "tracking.png"))
        reports.append(measured)
    return reports


def _show(output: Output, report: "Report", *, markdown: bool) -> None:
    if markdown:
        heads = [report.columns, ["---", *["---:"] * (len(report.columns) - 1)]]
        rows = ["| " + " | ".join(row) + " |" for row in (*heads, *report.rows)]
        for line in ("", *rows, "", report.note):
            output.text(line)
        return
    table = Table(title=report.title, title_justify="left", box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for i, column in enumerate(report.columns):
        table.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    for row in report.rows:
        table.add_row(*row)
    output.console.print()
    output.console.print(table)
    output.console.print(report.note, style="dim")


def _record(reports: "Sequence[Report]", *, quick: bool, repeats: int) -> dict[str, Any]:
    from gelflow.measurement.machine import processor
    from gelflow.sim.benchmark import versions

    version = versions() | {"opencv-contrib-python-headless": metadata.version("opencv-contrib-python-headless")}
    record = {"format": 1, "processor": processor(), "versions": version, "quick": quick, "repeats": repeats}
    return record | {report.name: report.to_dict() for report in reports}


class _Bar:
    """A progress bar without a refresh thread, which would disturb the timed runs."""

    def __init__(self) -> None:
        self._progress = progress_bar(auto_refresh=False)
        self._task: TaskID | None = None

    def __enter__(self) -> "_Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, what: str, total: int) -> None:
        """Start a new bar for `total` cases."""
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(what, total=total)
        self._progress.refresh()

    def advance(self) -> None:
        """One case is finished."""
        assert self._task is not None
        self._progress.advance(self._task)
        self._progress.refresh()
