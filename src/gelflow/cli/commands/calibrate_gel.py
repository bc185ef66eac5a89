"""`gelflow calibrate-gel`: stiffness and lag of a gel from measured forces."""

import argparse
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, picture_beside, removed_on_error
from gelflow.cli.output import Output
from gelflow.gel.gel_file import load_gel, save_gel
from gelflow.perception.force.gel_fit import Factor, GelFit, fit_gel, read_samples
from gelflow.perception.output.gel_fit_picture import draw_gel_fit


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("estimates", type=Path, help="table of `gelflow track SOURCE --gel GUESS --out X.forces.csv`")
    parser.add_argument(
        "--measured",
        type=Path,
        required=True,
        metavar="CSV",
        help="measured forces: normal_n, shear_n or both [N], by stamp [s] or by image",
    )
    parser.add_argument("--gel", type=Path, required=True, metavar="GUESS", help="gel file of the estimates")
    add_out(parser, "the new gel file; a picture (.png) goes beside it", default=Path("gel.toml"))
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Fit the gel, and write its file and a picture of the fit."""
    output = Output(args.json)
    picture = picture_beside(args.out)
    guess = load_gel(args.gel)
    samples = read_samples(args.estimates, args.measured)
    fit = fit_gel(samples, guess)
    with removed_on_error(args.out, picture):
        save_gel(fit.gel, args.out)
        draw_gel_fit(samples, fit, fit.gel.youngs_modulus / guess.youngs_modulus, picture)
    if output.json:
        output.result(
            {
                **{"images": len(samples.stamp), "contacts": fit.contacts, "gel": asdict(fit.gel)},
                "normal_factor": None if fit.normal is None else asdict(fit.normal),
                "shear_factor": None if fit.shear is None else asdict(fit.shear),
                "largest_shear_ratio": fit.largest_ratio,
                "thickness_that_agrees": fit.thickness,
                "thickness_doubtful": fit.doubtful,
                "creep_deviation": fit.creep_deviation,
                "files": [args.out, picture],
            }
        )
    else:
        output.console.print(_table(fit, len(samples.stamp), [args.out, picture]))
    return SUCCESS


def _table(fit: GelFit, images: int, files: list[Path]) -> Table:
    gel, table = fit.gel, Table(show_header=False)
    table.add_row("images", f"{images} with contact and measured force, {fit.contacts} contacts")
    low, high = (gel.youngs_modulus * max(0.0, 1 + 1.96 * sign * gel.youngs_modulus_deviation) for sign in (-1, 1))
    table.add_row("Young's modulus", f"{gel.youngs_modulus:.4g} Pa, 95 % interval {low:.4g} to {high:.4g}")
    table.add_row("normal forces", _factor_text(fit.normal))
    table.add_row("shear forces", _factor_text(fit.shear))
    if fit.thickness is not None:
        table.add_row(
            "thickness",
            f"normal and shear forces disagree: try {1e3 * fit.thickness:.2f} mm instead of "
            f"{1e3 * gel.thickness:.2f} mm, track and fit again",
        )
    elif fit.doubtful:
        table.add_row(
            "thickness",
            "doubtful: the normal forces of the contacts disagree. Measure it "
            f"({1e3 * gel.thickness:.2f} mm is stated), press inside the grid of markers, track and fit again",
        )
    if fit.creep_deviation is None:
        table.add_row("creep", "not found, or not determined: needs forces over time, with fast changes")
    else:
        table.add_row("creep", f"{gel.creep:.2f} ± {fit.creep_deviation:.2f}, time constant {gel.creep_time:.3g} s")
    table.add_row("friction", f"at least {fit.largest_ratio:.2f}, the largest ratio of shear to normal force")
    for file in files:
        table.add_row("written", str(file))
    return table


def _factor_text(factor: Factor | None) -> str:
    if factor is None:
        return "not measured"
    text = f"{factor.value:.3f} ± {factor.deviation:.3f} times the estimates"
    return text if factor.scatter is None else f"{text}; contacts differ by {100 * factor.scatter:.0f} %"
