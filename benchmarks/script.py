"""Options, progress and output shared by the benchmark scripts."""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import Progress

from gelflow.cli.options import add_json, add_out, add_quick, add_seed
from gelflow.errors import GelflowError
from gelflow.measurement.machine import processor
from gelflow.sim.benchmark import versions

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "docs" / "pictures"
WIDTH = 80


def parser(description: str, *, out: str, quick: str, seed: int | None = None) -> argparse.ArgumentParser:
    """A parser with the options of all scripts.

    Parameters
    ----------
    description: of the script
    out: name of the default output file in benchmarks/results
    quick: what a quick run covers
    seed: default of --seed; None for a script without random numbers
    """
    result = argparse.ArgumentParser(description=f"{description} Quick run: {quick}.")
    add_out(result, "file to write", default=RESULTS / out)
    add_quick(result)
    add_json(result)
    if seed is not None:
        add_seed(result, default=seed)
    return result


@contextmanager
def progress(name: str, total: float = 1.0) -> Iterator[Callable[[float], None]]:
    """A progress bar on standard error; the result advances it by an amount."""
    with Progress(console=Console(stderr=True, width=WIDTH), transient=True) as bar:
        task = bar.add_task(name, total=total)
        yield lambda amount: bar.advance(task, amount)


@contextmanager
def progress_share(name: str) -> Iterator[Callable[[float], None]]:
    """A progress bar on standard error; the result sets the share that is done."""
    with Progress(console=Console(stderr=True, width=WIDTH), transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def measure_each(
    args: argparse.Namespace, names: Sequence[Any], measure: Callable[[Any], dict[str, Any]], *, key: str
) -> list[dict[str, Any]]:
    """For each of `names` the row that `measure` returns; the value of the row under `key` is the name.

    Rows are stored after each measurement: the same command continues a run that was killed, until `finish`.
    """
    file = _unfinished(args)
    stored = json.loads(file.read_text())["results"] if file.is_file() else []
    rows = {row[key]: row for row in stored}
    with progress("worlds", len(names)) as advance:
        for name in names:
            if name not in rows:
                rows[name] = measure(name)
                save(file, {"results": list(rows.values())})
            advance(1)
    return [rows[name] for name in names]


def _unfinished(args: argparse.Namespace) -> Path:
    """The file with the rows of a run that is not finished."""
    out: Path = args.out
    return out.with_suffix(".quick.part" if args.quick else ".part")


def run(main: Callable[[], int]) -> int:
    """The exit status of `main`; 2, with a message on standard error, when it raises a gelflow error."""
    try:
        return main()
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2


def header() -> dict[str, Any]:
    """The start of a record: format, processor and versions."""
    return {"format": 1, "processor": processor(), "versions": versions()}


def finish(args: argparse.Namespace, record: dict[str, Any], *tables: RenderableType) -> None:
    """Write the record to `args.out`; print the tables, or the record with --json."""
    write(args.out, record, args.json, *tables)
    _unfinished(args).unlink(missing_ok=True)


def write(file: Path, record: dict[str, Any], as_json: bool, *tables: RenderableType) -> None:
    """Write the record to a file; print the tables, or the record if `as_json`."""
    text = save(file, record)
    if as_json:
        print(text, end="")
        return
    console = Console(width=WIDTH, highlight=False, markup=False)
    for table in tables:
        console.print(table)
    console.print(str(file), soft_wrap=True)


def save(file: Path, record: dict[str, Any]) -> str:
    """Write the record to a file; returns the text."""
    text = json.dumps(record, indent=1, allow_nan=False) + "\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return text
