"""Accuracy of the slip estimate from rendered images of objects that slip on a gel: a table on the terminal."""

import argparse
import sys

import numpy as np
import script
from rich.console import Console
from rich.table import Table

from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.benchmark.slip import measure_slip
from gelflow.perception.synthetic.slipping_layer import INDENTERS


def main() -> int:
    parser = argparse.ArgumentParser(description="Slip from rendered images of objects that slip on a gel.")
    parser.add_argument("--contacts", type=int, default=12, help="of each object (%(default)s)")
    parser.add_argument("--objects", nargs="+", default=INDENTERS, choices=INDENTERS, help="default: all")
    parser.add_argument("--image-class", default="typical", help="as in gelflow bench tracking (%(default)s)")
    parser.add_argument("--width", type=int, default=640, help="of the images [px] (%(default)s)")
    parser.add_argument("--rate", type=float, default=60.0, help="of the images [Hz] (%(default)s)")
    parser.add_argument("--friction-unknown", action="store_true", help="do not state the friction coefficient")
    parser.add_argument("--friction-error", type=float, default=0.0, help="of the stated one, relative (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    args = parser.parse_args()
    gel = ElasticGel(1.5e5, 0.48, 3e-3)
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
    Console(width=140).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
