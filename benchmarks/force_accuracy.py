"""Accuracy of forces from rendered images of gels under five shapes: a table on the terminal."""

import argparse
import sys

import numpy as np
import script
from rich.console import Console
from rich.table import Table

from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.benchmark.forces import measure_forces
from gelflow.perception.synthetic.pressed_layer import SHAPES


def main() -> int:
    parser = argparse.ArgumentParser(description="Forces from rendered images of gels under five shapes.")
    parser.add_argument("--contacts", type=int, default=10, help="of each shape (%(default)s)")
    parser.add_argument("--image-class", default="typical", help="as in gelflow bench tracking (%(default)s)")
    parser.add_argument("--width", type=int, default=640, help="of the images [px] (%(default)s)")
    parser.add_argument("--youngs-modulus", type=float, default=1.5e5, help="[Pa] (%(default)s)")
    parser.add_argument("--poisson-ratio", type=float, default=0.48, help="(%(default)s)")
    parser.add_argument("--thickness", type=float, default=3e-3, help="[m] (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    args = parser.parse_args()
    gel = ElasticGel(args.youngs_modulus, args.poisson_ratio, args.thickness)
    table = Table(title="errors, 95th percentile, and share of images within the bound")
    for column in ("shape", "shear [N]", "<5 % or .05 N", "normal [N]", "<10 % or .1 N", "moment [N mm]", "<10 %"):
        table.add_column(column, justify="right")
    for column in ("error < 2 sd", "ms"):
        table.add_column(column, justify="right")
    for shape in SHAPES:
        errors = measure_forces(
            shape, args.contacts, gel, image_class=args.image_class, width=args.width, seed=args.seed
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
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
