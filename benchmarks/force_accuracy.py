"""Accuracy of forces, or of slip, from rendered images of gels under several shapes: a table on the terminal."""

import argparse
import sys

import numpy as np
import script
from rich.console import Console
from rich.table import Table

from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.benchmark.forces import measure_forces
from gelflow.perception.benchmark.slip import measure_slip
from gelflow.perception.synthetic.pressed_layer import SHAPES
from gelflow.perception.synthetic.slipping_layer import INDENTERS


def main() -> int:
    parser = argparse.ArgumentParser(description="Forces or slip from rendered images of gels under several shapes.")
    parser.add_argument("quantity", nargs="?", choices=("forces", "slip"), default="forces", help="(%(default)s)")
    parser.add_argument("--contacts", type=int, default=10, help="of each shape (%(default)s)")
    parser.add_argument("--image-class", default="typical", help="as in gelflow bench tracking (%(default)s)")
    parser.add_argument("--width", type=int, default=640, help="of the images [px] (%(default)s)")
    parser.add_argument("--youngs-modulus", type=float, default=1.5e5, help="[Pa] (%(default)s)")
    parser.add_argument("--poisson-ratio", type=float, default=0.48, help="(%(default)s)")
    parser.add_argument("--thickness", type=float, default=3e-3, help="[m] (%(default)s)")
    parser.add_argument("--markers", type=int, default=130, help="of the gels, for forces (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    slip = parser.add_argument_group("slip only")
    slip.add_argument("--objects", nargs="+", default=INDENTERS, choices=INDENTERS, help="default: all")
    slip.add_argument("--rate", type=float, default=60.0, help="of the images [Hz] (%(default)s)")
    slip.add_argument("--friction-unknown", action="store_true", help="do not state the friction coefficient")
    slip.add_argument("--friction-error", type=float, default=0.0, help="of the stated one, relative (%(default)s)")
    args = parser.parse_args()
    gel = ElasticGel(args.youngs_modulus, args.poisson_ratio, args.thickness)
    table = _slip(gel, args) if args.quantity == "slip" else _forces(gel, args)
    Console(width=140 if args.quantity == "slip" else None, markup=False).print(table)
    return 0


def _forces(gel: ElasticGel, args: argparse.Namespace) -> Table:
    table = Table(title="errors, 95th percentile, and share of images within the bound")
    for column in ("shape", "shear [N]", "<5 % or .05 N", "normal [N]", "<10 % or .1 N", "moment [N mm]", "<10 %"):
        table.add_column(column, justify="right")
    for column in ("error < 2 sd", "CPU ms"):
        table.add_column(column, justify="right")
    for shape in SHAPES:
        errors = measure_forces(
            shape,
            args.contacts,
            gel,
            image_class=args.image_class,
            markers=args.markers,
            width=args.width,
            seed=args.seed,
        )
        covered = np.mean(np.stack([e[:, 1] < 2 * e[:, 2] for e in (errors.shear, errors.normal, errors.moment)]))
        table.add_row(
            shape,
            f"{np.percentile(errors.shear[:, 1], 95):.3f}",
            f"{100 * errors.within(errors.shear, 0.05, 0.05):.0f} %",
            f"{np.percentile(errors.normal[:, 1], 95):.3f}",
            f"{100 * errors.within(errors.normal, 0.1, 0.1):.0f} %",
            f"{1e3 * np.percentile(errors.moment[:, 1], 95):.2f}",
            f"{100 * errors.within(errors.moment, 0.1, 2e-4):.0f} %",
            f"{100 * covered:.0f} %",
            f"{1e3 * np.median(errors.seconds):.1f}",
        )
    return table


def _slip(gel: ElasticGel, args: argparse.Namespace) -> Table:
    table = Table(title="share that sticks in points, gross slip, false alarms")
    for column in ("object", "within 10", "95 %", "error < 2 sd", "found in 40 ms", "false", "false, > 10 % sticks"):
        table.add_column(column, justify="right")
    for column in ("friction 5/50/95 %", "ms"):
        table.add_column(column, justify="right")
    for name in args.objects:
        errors = measure_slip(
            name,
            args.contacts,
            gel,
            image_class=args.image_class,
            width=args.width,
            rate=args.rate,
            friction_known=not args.friction_unknown,
            friction_error=args.friction_error,
            seed=args.seed,
        )
        missed = np.abs(errors.share[:, 1] - errors.share[:, 0])
        friction = errors.friction[np.isfinite(errors.friction)]
        table.add_row(
            name,
            f"{100 * errors.share_within(0.1):.0f} %" if missed.size else "",
            f"{100 * np.percentile(missed, 95):.0f}" if missed.size else "",
            f"{100 * np.mean(missed < 2 * errors.share[:, 2]):.0f} %" if missed.size else "",
            f"{int((errors.delays <= 0.0401).sum())} of {len(errors.delays)}",
            f"{100 * errors.alarms[:, 0].mean():.2f} %",
            f"{100 * errors.alarms[:, 1].mean():.2f} %",
            "/".join(f"{value:.2f}" for value in np.percentile(friction, (5, 50, 95))) if friction.size else "",
            f"{1e3 * np.median(errors.seconds):.2f}",
        )
    return table


if __name__ == "__main__":
    sys.exit(script.run(main))
