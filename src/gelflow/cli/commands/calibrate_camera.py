"""`gelflow calibrate-camera`: from one picture of the gel at rest to millimetres anywhere in the camera's pictures."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from gelflow.cli.refused import picture_of_refusal
from gelflow.errors import UsageError
from gelflow.perception.calibration import Calibration, fit_calibration, save_calibration
from gelflow.perception.sources import image_source
from gelflow.perception.tracker import MarkerTracker

_MAGNIFY = 20  # residuals in the picture
_STEPS = 8  # pieces of a line of the grid between two markers: the lens bends it

Floats = NDArray[np.float64]


def configure(parser: argparse.ArgumentParser) -> None:
    """The options of the command."""
    parser.add_argument("source", help="image of the gel at rest; of a folder, video, session or camera the first one")
    parser.add_argument("--spacing-mm", type=float, required=True, metavar="MM", help="between neighbouring markers")
    parser.add_argument("--rows", type=int, help="lines of markers (default: found)")
    parser.add_argument("--cols", type=int, help="markers in a line (default: found)")
    parser.add_argument("--sensor", default="left", help="of a session: left or right (default %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("calibration.json"), metavar="FILE", help="new file (default %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    """Finds the grid, fits, writes the file and a picture of the fit beside it."""
    picture = args.out.with_suffix(".png")
    for file in (args.out, picture):
        if file.exists():
            raise UsageError(f"{file} exists; name a new file with --out")
    if not args.out.parent.is_dir():
        raise UsageError(f"{args.out}: the folder {args.out.parent} does not exist")
    image = next(iter(image_source(args.source, sensor=args.sensor))).image
    tracker = MarkerTracker()
    with picture_of_refusal(args.out):
        first = tracker.start(image, rows=args.rows, cols=args.cols)
    rest, seen = tracker.rest, first.valid
    size = (image.shape[1], image.shape[0])
    calibration = fit_calibration(rest, seen, rows=first.rows, cols=first.cols, spacing_mm=args.spacing_mm, size=size)
    save_calibration(calibration, args.out)
    draw_fit(image, rest, seen, calibration, picture)
    Console(highlight=False).print(_table(calibration, rest, seen, written=f"{args.out}, and the picture {picture}"))
    return 0


def draw_fit(image: NDArray[np.uint8], rest: Floats, seen: NDArray[np.bool_], fit: Calibration, path: Path) -> None:
    """The image with the fitted grid and the magnified residuals, and beside it the rectified image.

    Raises UsageError when the picture can't be written.
    """
    from matplotlib.figure import Figure  # here: slow to import

    figure = Figure(figsize=(13, 6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(image[..., ::-1])
    for line in _lines(fit):
        left.plot(*fit.to_pixels(line).T, color="tab:cyan", linewidth=0.8)
    measured = rest[seen]
    off = measured - fit.to_pixels(fit.marker_positions_mm())[seen]
    left.quiver(
        *measured.T, *(_MAGNIFY * off.T), color="red", angles="xy", scale_units="xy", scale=1, width=0.003, zorder=3
    )
    left.set(xlim=(-0.5, fit.width - 0.5), ylim=(fit.height - 0.5, -0.5), xticks=[], yticks=[])
    left.set_title(
        f"fitted grid; red: residuals × {_MAGNIFY}, {fit.residual_px:.2f} px (root mean square)", fontsize=10
    )
    right.imshow(fit.rectify(image)[..., ::-1], extent=_extent(fit))
    right.set(xlabel="x (right) [mm]", ylabel="y (down) [mm]", title="rectified: its lines must be straight and even")
    right.title.set_fontsize(10)
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise UsageError(f"cannot write the picture {path}: {error.strerror}") from error


def _lines(fit: Calibration) -> list[Floats]:
    """The lines and columns of the grid [mm], each shape (points, 2)."""
    nodes = fit.marker_positions_mm().reshape(fit.rows, fit.cols, 2)
    ends = [(line[0], line[-1], fit.cols) for line in nodes]
    ends += [(column[0], column[-1], fit.rows) for column in nodes.swapaxes(0, 1)]
    return [np.asarray(np.linspace(first, last, _STEPS * number)) for first, last, number in ends]


def _extent(fit: Calibration) -> tuple[float, ...]:
    """Left, right, bottom and top of the rectified image [mm]."""
    across, down = (fit.cols + 1) * fit.spacing_mm / 2, (fit.rows + 1) * fit.spacing_mm / 2
    return -across, across, down, -down


def _table(fit: Calibration, rest: Floats, seen: NDArray[np.bool_], *, written: str) -> Table:
    distance = np.linalg.norm(rest - fit.to_pixels(fit.marker_positions_mm()), axis=1)[seen]
    left_out = int((distance > fit.largest_px * (1 + 1e-9)).sum())
    along, down = fit.pixels_per_mm()
    lens = ", ".join(f"k{i} {k:+.3f}" for i, k in enumerate(fit.radial, start=1)) or "none that the markers show"
    moved = np.subtract(fit.center, ((fit.width - 1) / 2, (fit.height - 1) / 2))
    if moved.any():
        lens += f", its centre {moved[0]:+.0f}, {moved[1]:+.0f} px from the image's"
    nodes = fit.marker_positions_mm()
    scales = [_scale(fit, node) for node in nodes]
    table = Table(show_header=False)
    table.add_row(
        "markers", f"{fit.rows} lines of {fit.cols}, {seen.sum()} seen, {left_out} left out as measured wrongly"
    )
    table.add_row("scale", f"{along:.2f} px/mm along lines, {down:.2f} along columns (centre)")
    table.add_row("", f"{min(scales):.2f} to {max(scales):.2f} px/mm over the grid")
    table.add_row("lens", lens)
    shares = (fit.residual_px, 1e3 * fit.residual_px / along, fit.largest_px)
    table.add_row("residual", "{:.3f} px = {:.1f} µm root mean square, {:.2f} px at most".format(*shares))
    table.add_row("written", written)
    return table


def _scale(fit: Calibration, node: Floats) -> float:
    """Mean scale at a node [px/mm]."""
    corners = fit.to_pixels(node + np.array([[0, 0], [0.1, 0], [0, 0.1]]))
    (right, down) = corners[1:] - corners[0]
    return float(np.sqrt(abs(right[0] * down[1] - right[1] * down[0]))) / 0.1
