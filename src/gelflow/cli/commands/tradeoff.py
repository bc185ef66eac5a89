"""`gelflow tradeoff SCENE`: speed and error of a scene for many settings and for the presets."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_quick, add_repeats, check_at_least
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError
from gelflow.figures import PICTURE_FORMATS

if TYPE_CHECKING:
    from gelflow.sim.benchmark.tradeoff.sweep import Measurement, Tradeoff

_FIGURES = ("ms/s", "×", "mm", "mrad", "mark%", "flow", "cosine", "grad%")
_EXPLANATION = (
    "ms/s: processor time per simulated second, one environment, one thread. ×: speed relative to real time. mm, mrad: "
    "largest error of a body's position and orientation. mark%: error of the marker field over the motion. flow: mean "
    "error of a vector of the flow map, whose longest vector is 1. cosine, grad%: of the gradient of a tactile loss "
    "with respect to the controls. ●: not dominated."
)


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("scene", metavar="SCENE", help="name of an included scene")
    add_quick(parser)
    add_repeats(parser, "timed runs of each setting (9; quick: 3)")
    add_out(parser, "the picture (default out/tradeoff_SCENE.png; none with --json)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, then print the tables and draw the picture."""
    check_at_least(args, repeats=1)
    repeats = args.repeats if args.repeats is not None else 3 if args.quick else 9
    from gelflow.measurement.machine import processor
    from gelflow.policies.training.folder import create_folder
    from gelflow.sim.benchmark.tradeoff.picture import draw
    from gelflow.sim.benchmark.tradeoff.sweep import measure

    if args.out is not None and args.out.suffix.lower() not in PICTURE_FORMATS:
        raise UsageError(f"--out {args.out}: the suffix must be one of {', '.join(PICTURE_FORMATS)}")
    folder = Path("out") if args.out is None else args.out.parent
    drawn = args.out is not None or not args.json
    if drawn:
        create_folder(folder)
    output = Output(args.json)
    with progress_bar() as progress:
        task = progress.add_task("reference", total=1.0)
        measured = measure(
            args.scene,
            quick=args.quick,
            repeats=repeats,
            done=lambda what, share: progress.update(task, description=what, completed=share),
        )
    if output.json:
        output.result(dataclasses.asdict(measured) | {"processor": processor()})
    else:
        show(measured, f"{measured.scene}, one thread of {processor()}", output)
    if drawn:
        picture = args.out or folder / f"tradeoff_{measured.scene}.png"
        draw(measured, picture)
        output.text(f"picture: {picture}")
    return SUCCESS


def show(measured: "Tradeoff", title: str, output: Output) -> None:
    """Print the tables and their explanation."""
    console = output.console
    output.wide_table(table(measured, title))
    console.print(_EXPLANATION)
    console.print()
    console.print(dominated(measured))
    for name, reason in measured.failed.items():
        console.print(f"failed: {name}: {reason}")
    console.print(_reference(measured))


def table(measured: "Tradeoff", title: str) -> Table:
    """Table of all settings, followed by the presets."""
    view = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0)
    view.add_column("setting", no_wrap=True)
    for heading in _FIGURES:
        view.add_column(heading, justify="right", no_wrap=True)
    group = None
    for measurement in measured.measurements:
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
    for name, measurement in _presets(measured).items():
        view.add_row(f"  {name}", *_cells(measurement), style="bold")
    return view


def _presets(measured: "Tradeoff") -> "dict[str, Measurement]":
    """Measurements of the presets by name, fastest first."""
    pairs = [(name, measurement) for measurement in measured.measurements for name in measurement.presets]
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
    """`number` in at most five characters: two significant digits, one below 0.01."""
    if number != 0 and abs(number) < 9.5e-3:
        return f"{number:.0e}".replace("e-0", "e-")
    return f"{number:.0f}" if abs(number) >= 10 else f"{number:.2g}"


def dominated(measured: "Tradeoff") -> Table:
    """Table of the settings that another setting beats in at least one figure and equals in the others."""
    view = Table(title="Dominated", title_justify="left", box=SIMPLE_HEAD, padding=0)
    view.add_column("setting", no_wrap=True)
    view.add_column("by", no_wrap=True)
    for measurement in measured.measurements:
        if measurement.dominated_by:
            view.add_row(measurement.setting.name, measurement.dominated_by)
    return view


def _reference(measured: "Tradeoff") -> str:
    lines = []
    for name, change in measured.changes.items():
        what = {"scene": "The reference", "points": "The reference of settings with other points"}[name]
        lines.append(
            f"{what} changed by {short(1e3 * change.position)} mm, {short(1e3 * change.rotation)} mrad, "
            f"{short(100 * change.markers)} % of the markers, {short(change.flow)} of the flow map and "
            f"{short(100 * change.gradient)} % of the gradient when it was last refined."
        )
    return f"Reference: BDF2 with steps of {1e6 * measured.reference_step:.4g} µs. {' '.join(lines)}"
