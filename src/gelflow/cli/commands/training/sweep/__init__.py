"""`gelflow sweep GRID`: many training runs on one or many machines."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from rich.progress import Progress

from gelflow.cli.commands.training import train
from gelflow.cli.commands.training.sweep.table import summary_table
from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.options import add_json, add_out, check_at_least
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError
from gelflow.interrupts import interruptible
from gelflow.measurement.machine import cores

if TYPE_CHECKING:
    from gelflow.policies.sweep.engines.engine import Engine
    from gelflow.policies.sweep.grid import CommandOptions, Grid
    from gelflow.policies.sweep.run import Run, RunRecord

_RESERVED = {
    "seed": "list them as seeds = [0, 1, 2]",
    "out": "every run has a folder of its own",
    "json": "the sweep reads the results of its runs",
    "help": "it is not an option of a training",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("grid", type=Path, metavar="GRID", help="grid file: task, options and seeds")
    parser.add_argument(
        "--on",
        choices=["local", "ray", "slurm"],
        default="local",
        help="engine that executes the runs (default %(default)s)",
    )
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="runs at a time with --on local (default: cores / cpus of a run)"
    )
    parser.add_argument(
        "--tries",
        type=int,
        default=3,
        metavar="N",
        help="starts of a run that is killed or fails (default %(default)s)",
    )
    add_out(parser, "folder of all runs and results (default: runs/NAME for NAME.toml)", folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Execute the runs that are not complete, then write and print the results of all."""
    check_at_least(args, jobs=1, tries=1)
    from gelflow.policies.sweep.grid import read_grid
    from gelflow.policies.sweep.sweep import check_grid_file, execute_runs, incomplete, store_grid_file, sweep_folder

    output = Output(args.json)
    grid = read_grid(args.grid, train_options())
    folder = (args.out or Path("runs") / args.grid.stem).resolve()
    runs = grid.runs(folder)
    with interruptible(), sweep_folder(folder):
        check_grid_file(folder, args.grid, runs)
        remaining = incomplete(runs)
        output.text(f"{len(runs)} runs in {folder}, {len(runs) - len(remaining)} of them complete")
        if not remaining:
            store_grid_file(folder, args.grid)
        else:
            with progress_bar(count=True) as progress, _engine(args, grid, folder) as engine:
                engine.submit(remaining)
                store_grid_file(folder, args.grid)  # nothing was refused
                view = _SweepProgress(progress, len(runs), len(remaining))
                execute_runs(remaining, engine, tries=args.tries, report=view.report)
        return _finish(grid, runs, folder, output)


def train_options() -> "CommandOptions":
    """The options of `gelflow train` that a grid file may have, from its argument parser."""
    from gelflow.policies.sweep.grid import CommandOptions

    parser = _CheckingParser(prog="gelflow train")
    train.configure(parser)
    actions = {
        option.removeprefix("--"): action
        for action in parser._actions
        for option in action.option_strings
        if option.startswith("--")
    }

    def check(arguments: Sequence[str]) -> None:
        train.check(parser.parse_args(arguments))

    def curve_columns(arguments: Sequence[str]) -> Sequence[str]:
        from gelflow.policies.recipes import recipe_for  # deferred: torch is slow to import

        args = parser.parse_args(arguments)
        return recipe_for(args.task, train.recipe_name(args)).curve_columns

    return CommandOptions(
        names={name: action.dest for name, action in actions.items() if name not in _RESERVED},
        flags=[name for name, action in actions.items() if action.nargs == 0],
        reserved=_RESERVED,
        check=check,
        curve_columns=curve_columns,
    )


class _CheckingParser(argparse.ArgumentParser):
    """Raises UsageError where ArgumentParser ends the program."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message)


def _engine(args: argparse.Namespace, grid: "Grid", folder: Path) -> "Engine":
    if args.on == "ray":
        from gelflow.policies.sweep.engines.ray import RayEngine

        return RayEngine()
    if args.on == "slurm":
        from gelflow.policies.sweep.engines.slurm import SlurmEngine

        return SlurmEngine(folder, grid.slurm, cpus=grid.cpus)
    from gelflow.policies.sweep.engines.local import LocalEngine

    return LocalEngine(args.jobs or max(1, cores() // grid.cpus))


class _SweepProgress:
    """Counts the runs that have ended, and prints a line for each."""

    def __init__(self, progress: Progress, runs: int, remaining: int) -> None:
        self._progress = progress
        self._task = progress.add_task("runs", total=runs, completed=runs - remaining)

    def report(self, run: "Run", record: "RunRecord", again: bool) -> None:
        """Called by `execute_runs` for each run that ended."""
        if record.state == "complete":
            text = f"complete in {record.seconds / 60:.1f} min"
        else:
            text = f"{record.error}{'; it is started again' if again else ''}"
        self._progress.console.print(f"{run.name}: {text}", highlight=False, soft_wrap=True)
        if not again:
            self._progress.advance(self._task)


def _finish(grid: "Grid", runs: Sequence["Run"], folder: Path, output: Output) -> int:
    """Write the tables and the picture, and print the results, also where a file cannot be written."""
    from gelflow.policies.sweep import results
    from gelflow.policies.sweep.run import read_record

    records = {run.name: read_record(run) for run in runs}
    rows, found = results.rows(runs, records), results.configurations(runs, records)
    files: dict[str, Path] = {}
    failure: Exception | None = None
    try:
        for name, table in (("runs", rows), ("summary", results.summary_rows(found))):
            results.write_csv(folder / f"{name}.csv", table)
            files[name] = folder / f"{name}.csv"
        files |= _write_curves(grid, runs, records, folder)
    except (OSError, UsageError) as error:
        failure = error
    failed = [run for run in runs if records[run.name].state != "complete"]
    output.console.print(summary_table(found, output.console))
    for run in failed:
        log = f" (log: {run.log})" if run.log.exists() else ""
        output.text(f"failed: {run.name}: {records[run.name].error}{log}")
    if files:
        output.text(f"written: {', '.join(str(path) for path in files.values())}")
    output.result(
        {"folder": folder, "complete": len(runs) - len(failed), "failed": len(failed)}
        | {"runs": rows, "configurations": found, "files": files}
    )
    if failure is not None:
        raise failure
    return NEGATIVE_RESULT if failed else SUCCESS


def _write_curves(
    grid: "Grid", runs: Sequence["Run"], records: Mapping[str, "RunRecord"], folder: Path
) -> dict[str, Path]:
    """Write the learning curves, if there are any, as a table and as a picture; the files."""
    from gelflow.policies.sweep import curves, results

    drawn = curves.read_curves(runs, records, grid.curve)
    if drawn is None:
        return {}
    files = {"curves": folder / "curves.csv", "picture": folder / "curves.png"}
    results.write_csv(files["curves"], drawn.rows())
    curves.draw(files["picture"], drawn, grid.task)
    return files
