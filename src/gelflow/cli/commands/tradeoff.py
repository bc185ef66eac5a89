"""`gelflow tradeoff SCENE`: what accuracy costs on a scene, and which settings are worth their time."""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from gelflow.errors import UsageError

if TYPE_CHECKING:
    from gelflow.sim.benchmark.tradeoff.sweep import Measurement, Tradeoff

_FIGURES = ("ms/s", "×", "mm", "mrad", "mark%", "flow", "cosine", "grad%")
_EXPLAINED = (
    "ms/s: processor time per simulated second, one environment, one thread. ×: times faster than real time. mm, mrad: "
    "largest error of any body's position and turn. mark%: error of the marker field, over the whole motion. flow: "
    "mean error of a vector of the flow map, whose longest is 1. cosine, grad%: of the gradient of a tactile loss by "
    "the controls. ●: not dominated."
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("scene", metavar="SCENE", help="name of a scene that comes with gelflow")
    parser.add_argument("--quick", action="store_true", help="fewer settings, a coarser reference: seconds")
    parser.add_argument("--repeats", type=int, metavar="N", help="timed runs of each setting (9; with --quick 3)")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="the picture (default out/tradeoff_SCENE.png)")
    parser.add_argument("--json", action="store_true", help="print an object; draw only what --picture names")


def run(args: argparse.Namespace) -> int:
    """Measure; prints tables and draws the picture, or prints JSON."""
    repeats = args.repeats if args.repeats is not None else 3 if args.quick else 9
    if repeats < 1:
        raise UsageError(f"--repeats must be at least 1, got {repeats}")
    from gelflow.measurement.machine import processor
    from gelflow.sim.benchmark.tradeoff.picture import draw
    from gelflow.sim.benchmark.tradeoff.sweep import measure

    bar = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    errors = Console(stderr=True)  # what is piped out of the command stays clean
    with Progress(*bar, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task("reference", total=1.0)
        found = measure(
            args.scene,
            quick=args.quick,
            repeats=repeats,
            done=lambda what, share: progress.update(task, description=what, completed=share),
        )
    picture = args.picture or (None if args.json else Path("out") / f"tradeoff_{found.scene}.png")
    if picture is not None:
        draw(found, picture)
    if args.json:
        print(json.dumps(plain(found) | {"processor": processor()}, indent=2, allow_nan=False))
        return 0
    show(found, f"{found.scene}, one thread of {processor()}")
    Console(highlight=False).print(f"picture: {picture}", markup=False, soft_wrap=True)
    return 0


def show(found: "Tradeoff", title: str) -> None:
    """Print the tables and what they mean."""
    console = Console(highlight=False)
    console.print(table(found, title))
    console.print(_EXPLAINED)
    console.print()
    console.print(dominated(found))
    for name, why in found.failed.items():
        console.print(f"failed: {name}: {why}", markup=False)
    console.print(_reference(found))


def plain(found: "Tradeoff") -> dict[str, Any]:
    """A measurement as what JSON can hold; SI units."""
    return dataclasses.asdict(found)


def table(found: "Tradeoff", title: str) -> Table:
    """All settings, then the presets."""
    view = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0)
    view.add_column("setting", no_wrap=True)
    for heading in _FIGURES:
        view.add_column(heading, justify="right", no_wrap=True)
    group = None
    for measurement in found.measurements:
        if group not in (None, measurement.setting.group):
            view.add_section()
        group = measurement.setting.group
        mark = " " if measurement.dominated_by else "●"
        view.add_row(
            f"{mark} {measurement.setting.name}",
            *_cells(measurement),
            style="dim" if measurement.dominated_by else None,
        )
    view.add_section()
    for name, measurement in _presets(found).items():
        view.add_row(f"  {name}", *_cells(measurement), style="bold")
    return view


def _presets(found: "Tradeoff") -> "dict[str, Measurement]":
    """The preset's name → its measurement, cheapest first."""
    pairs = [(name, measurement) for measurement in found.measurements for name in measurement.presets]
    return dict(sorted(pairs, key=lambda pair: pair[1].seconds))


def _cells(measurement: "Measurement") -> tuple[str, ...]:
    e = measurement.errors
    return (
        f"{1e3 * measurement.seconds:.3g}",
        f"{measurement.speed:.0f}",
        short(1e3 * e.position),
        short(1e3 * e.rotation),
        short(100 * e.markers),
        short(e.flow),
        f"{e.cosine:.4f}",
        short(100 * e.gradient),
    )


def short(number: float) -> str:
    """Two digits, below 0.01 one: in at most five characters."""
    if number != 0 and abs(number) < 9.5e-3:
        return f"{number:.0e}".replace("e-0", "e-")
    return f"{number:.0f}" if abs(number) >= 10 else f"{number:.2g}"


def dominated(found: "Tradeoff") -> Table:
    """Which settings are no better in anything than another, and worse in something."""
    view = Table(title="Dominated", title_justify="left", box=SIMPLE_HEAD, padding=0)
    view.add_column("setting", no_wrap=True)
    view.add_column("by", no_wrap=True)
    for measurement in found.measurements:
        if measurement.dominated_by:
            view.add_row(measurement.setting.name, measurement.dominated_by)
    return view


def _reference(found: "Tradeoff") -> str:
    lines = []
    for name, change in found.changes.items():
        what = {"scene": "The reference", "points": "That of the settings with other points"}[name]
        lines.append(
            f"{what} changed by {short(1e3 * change.position)} mm, {short(1e3 * change.rotation)} mrad, "
            f"{short(100 * change.markers)} % of the markers, {short(change.flow)} of the flow map and "
            f"{short(100 * change.gradient)} % of the gradient when it was last refined."
        )
    return f"Reference: BDF2 with steps of {1e6 * found.reference_step:.4g} µs. {' '.join(lines)}"
