"""`gelflow replay SESSION --simulate`: recorded flow maps beside those of the simulation."""

import argparse
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.output import Output, progress_bar
from gelflow.cli.session_replay import read_attempts
from gelflow.figures import save
from gelflow.policies.calibration.comparison import NOTHING_IN_COMMON, SimulatedSession, simulate, unused_markers_text
from gelflow.policies.calibration.flow_picture import draw_flow_maps
from gelflow.policies.calibration.recordings import Recordings


def replay_in_simulation(args: argparse.Namespace) -> int:
    """Simulate the attempts with contact of a session, and print the error of each flow map."""
    output = Output(args.json)
    recordings = read_attempts([args.session], args.part)
    with progress_bar(count=True) as progress:
        bar = progress.add_task("simulating", total=len(np.unique(recordings.insertion)))
        result = simulate(recordings, progress=lambda done: progress.update(bar, completed=done))
    _show(output, recordings, result, args.out)
    if args.out:  # last: the result is not lost where the picture cannot be saved
        figure = draw_flow_maps(
            result.recorded,
            [("", result.simulated)],
            recordings.names,
            recordings.task.grid,
            recordings.unit,
            used=result.used,
            note="values of the scene; ",
        )
        save(figure, args.out, make_folder=False)
        output.text(f"picture: {args.out}")
    return SUCCESS


def _show(output: Output, recordings: Recordings, result: SimulatedSession, picture: Path | None) -> None:
    """Print the errors of the flow maps; `picture` is the file to be saved after them."""
    names, errors, cosines = recordings.names, result.relative_error, result.cosine
    strange = [name for name, cosine in zip(names, cosines, strict=True) if cosine < NOTHING_IN_COMMON]
    if output.json:
        output.result(
            {
                "unit": recordings.unit,
                "noise": recordings.noise(),
                "unused_markers": int((~result.used).sum()),
                "error": result.error,
                "attempts": [
                    {"name": name, "relative_error": float(error), "cosine": float(cosine)}
                    for name, error, cosine in zip(names, errors, cosines, strict=True)
                ],
                "nothing_in_common": strange,
                "picture": picture,
            }
        )
        return
    table = Table("attempt", "error of the flow map", "cosine", box=SIMPLE_HEAD)
    for name, error, cosine in zip(names, errors, cosines, strict=True):
        table.add_row(name, f"{100 * error:.0f} %", f"{cosine:.2f}")
    output.console.print(table)
    output.text(
        f"root mean square error {result.error:.3g} {recordings.unit} with the values of the scene, "
        f"noise {recordings.noise():.3g} {recordings.unit}"
    )
    if text := unused_markers_text(result.used):
        output.text(text)
    for name in strange:
        output.text(f"warning: {name}: recorded and simulated flow map have nothing in common")
