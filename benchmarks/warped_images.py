"""Errors of the trackers on images of your own gel at rest, warped by known fields: a table on the terminal."""

import argparse
import sys
from pathlib import Path

import cv2
import script
from rich.console import Console
from rich.table import Table

from gelflow.errors import UsageError
from gelflow.perception.benchmark.warped_images import measure_warped
from gelflow.perception.errors import TrackerInitError


def main() -> int:
    parser = argparse.ArgumentParser(description="Track real first images that are warped by known fields.")
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="image of a gel at rest")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (%(default)s)")
    args = parser.parse_args()
    table = Table(title="displacement error, 95th percentile [px]; LK: Lucas-Kanade; shaded: under changing light")
    table.add_column("image", overflow="fold")
    for column in ("markers", "gelflow", "LK", "shaded: gelflow", "shaded: LK"):
        table.add_column(column, justify="right")
    for path in args.images:
        image = cv2.imread(str(path))
        if image is None:
            raise UsageError(f"{path} is not an image")
        try:
            errors = measure_warped(path.name, image, seed=args.seed)
        except TrackerInitError as error:
            raise UsageError(f"{path}: {error}") from None
        values = (errors.gelflow, errors.lucas_kanade, errors.gelflow_shaded, errors.lucas_kanade_shaded)
        table.add_row(errors.image, str(errors.markers), *(f"{value:.3f}" for value in values))
    Console(markup=False).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
