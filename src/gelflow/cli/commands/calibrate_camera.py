"""`gelflow calibrate-camera`: camera calibration in millimetres from one image of the gel at rest."""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_profile, picture_beside, removed_on_error
from gelflow.cli.output import Output
from gelflow.errors import PeerError, UsageError
from gelflow.perception.camera_calibration import CameraCalibration, fit_calibration, save_calibration, scale_by_ruler
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.grid_detection.grid import find_extent
from gelflow.perception.mount_check import VisiblePart, find_visible_part, lines_text
from gelflow.perception.output.camera_calibration_picture import draw_calibration
from gelflow.perception.output.init_error import picture_of_init_error
from gelflow.perception.sensors.profile import load_sensor_profile
from gelflow.perception.sources import ImageSource, SourceImage, image_source, start_on_image
from gelflow.perception.tracker import MarkerTracker, TrackingResult

_UNEVEN, _SMOOTH = 0.02, 0.5  # residual [spacings] and its smooth share that may be a touched gel
_MAX_OPTIONS = 4  # possible visible parts that an error lists

Floats = NDArray[np.float64]


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("source", help="image of the gel at rest, or a folder, video, session or camera (first image)")
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--spacing-mm", type=float, metavar="MM", help="distance of neighbouring markers (default: of the profile)"
    )
    length.add_argument(
        "--ruler",
        type=float,
        nargs=5,
        metavar=("X1", "Y1", "X2", "Y2", "MM"),
        help="instead: two points in an image as the camera sends it [px], and their distance on the gel",
    )
    add_profile(parser)
    parser.add_argument("--rows", type=int, metavar="N", help="printed rows of markers (default: detected)")
    parser.add_argument("--cols", type=int, metavar="N", help="printed markers in a row (default: detected)")
    for name, start in (("rows", "top"), ("cols", "left")):
        parser.add_argument(
            f"--visible-{name}",
            type=int,
            nargs=2,
            metavar=("FIRST", "LAST"),
            help=f"first and last of the printed {name} in the image, from 1 at its {start} (default: detected)",
        )
    parser.add_argument("--sensor", default="left", help="sensor of a session: left or right (default %(default)s)")
    add_out(parser, "the new calibration; a picture (.png) goes beside it", default=Path("calibration.json"))
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Detect the grid, fit the calibration, and write the file and a picture of the fit."""
    output = Output(args.json)
    picture = picture_beside(args.out)
    profile = load_sensor_profile(args.profile)
    spacing = profile.markers.pitch_mm if args.spacing_mm is None else args.spacing_mm
    if args.spacing_mm is None and not spacing and args.ruler is None:
        raise UsageError(
            "--spacing-mm is missing: the distance of neighbouring markers; measure it on the gel, or give --ruler"
        )
    if args.rows is None and args.cols is None and profile.markers.rows:
        args.rows, args.cols = profile.markers.rows, profile.markers.cols
    source = image_source(args.source, sensor=args.sensor, profile=profile)
    with picture_of_init_error(args.out):
        frame, (tracker, first, part) = start_on_image(source, _images(source), lambda image: _start(image, args))
    image = frame.image
    rest, measured = tracker.rest, first.valid
    size = (image.shape[1], image.shape[0])
    fit = fit_calibration(
        rest, measured, rows=first.rows, cols=first.cols, spacing_mm=1.0 if args.ruler else spacing, size=size
    )
    if args.ruler:
        points = profile.used_positions(np.reshape(args.ruler[:4], (2, 2)), size)
        if not profile.image.is_plain and not ((points >= -0.5) & (points <= np.array(size) - 0.5)).all():
            raise UsageError("the points of the ruler must be in the part of the image that the profile uses")
        fit = scale_by_ruler(fit, points, args.ruler[4], pixel=1 / profile.image.reduce)
    fit = replace(fit, skipped=part.skipped) if part else fit
    with removed_on_error(args.out, picture):
        save_calibration(fit, args.out)
        draw_calibration(image, rest, measured, fit, picture)
    rejected = _rejected(fit, rest, measured)
    scale = fit.pixels_per_mm()
    if output.json:
        output.result(
            {
                "calibration": args.out,
                "picture": picture,
                "rows": fit.rows,
                "cols": fit.cols,
                "printed_grid": fit.printed_grid,
                "skipped_lines": fit.skipped,
                "measured_markers": int(measured.sum()),
                "rejected_markers": rejected,
                "pixels_per_mm": scale,
                "residual_px": fit.residual_px,
                "largest_residual_px": fit.largest_px,
                "spacing_mm": fit.spacing_mm,
                "scale_error": fit.scale_error,
                "smooth_share": fit.smooth_share,
            }
        )
    else:
        written = f"{args.out}, and the picture {picture}"
        output.console.print(_table(fit, measured, rejected, ruler=args.ruler is not None, written=written))
    return SUCCESS


def _images(source: ImageSource) -> Iterator[SourceImage]:
    """The images of `source`. Raises PeerError when the first one of a recorded source cannot be read: a later one may
    not show the gel at rest.
    """
    for image in source:
        if source.skipped.unreadable and not source.live:
            raise PeerError(source.skipped.first)
        yield image


def _start(
    image: NDArray[np.uint8], args: argparse.Namespace
) -> tuple[MarkerTracker, TrackingResult, VisiblePart | None]:
    """A tracker started with `image`, its result, and the visible part of the printed grid (None: the whole grid)."""
    given = [lines for lines in (args.visible_rows, args.visible_cols) if lines is not None]
    if given and (args.rows is None or args.cols is None):
        raise UsageError("--visible-rows and --visible-cols need --rows and --cols, the numbers of printed lines")
    if not given:
        tracker = MarkerTracker()
        try:
            return tracker, tracker.start(image, rows=args.rows, cols=args.cols), None
        except TrackerInitError:
            if args.rows is None or args.cols is None:
                raise
    part = _visible_part(image, args, given=bool(given))
    tracker = MarkerTracker(part.tracker_config())
    return tracker, tracker.start(image), part


def _visible_part(image: NDArray[np.uint8], args: argparse.Namespace, *, given: bool) -> VisiblePart:
    """The part of the printed grid that the image shows. Raises UsageError when there is none or a choice."""
    possible = find_visible_part(image, args.rows, args.cols, either_way=not given)
    parts = [
        part
        for part in possible
        if all(
            wanted is None or tuple(wanted) == lines
            for wanted, lines in zip((args.visible_rows, args.visible_cols), part.lines, strict=True)
        )
    ]
    if len(parts) == 1:
        return parts[0]
    options = [
        "--rows {} --cols {} --visible-rows {} {} --visible-cols {} {}".format(
            part.rows, part.cols, *(number for lines in part.lines for number in lines)
        )
        for part in (parts or possible)[:_MAX_OPTIONS]
    ]
    if not options:
        extent = find_extent(image)
        raise UsageError(
            f"the image shows {extent.rows} rows of {extent.cols} markers, which is no part of a grid of {args.rows} × "
            f"{args.cols}: correct --rows and --cols"
        )
    reason = "does not show which lines of the printed grid these are" if parts else "does not show these lines"
    raise UsageError(f"the image {reason}: look at the gel, and give {', or '.join(options)}")


def _rejected(fit: CameraCalibration, rest: Floats, measured: NDArray[np.bool_]) -> int:
    """Number of measured markers that the fit rejected as outliers."""
    distance = np.linalg.norm(rest - fit.to_pixels(fit.marker_positions_mm()), axis=1)[measured]
    return int((distance > fit.largest_px * (1 + 1e-9)).sum())


def _table(fit: CameraCalibration, measured: NDArray[np.bool_], rejected: int, *, ruler: bool, written: str) -> Table:
    along, down = fit.pixels_per_mm()
    lens = ", ".join(f"k{i} {k:+.3f}" for i, k in enumerate(fit.radial, start=1)) or "no measurable distortion"
    offset = np.subtract(fit.center, ((fit.width - 1) / 2, (fit.height - 1) / 2))
    if offset.any():
        lens += f", centre of distortion {offset[0]:+.0f}, {offset[1]:+.0f} px from the image centre"
    scales = [_scale(fit, position) for position in fit.marker_positions_mm()]
    table = Table(show_header=False)
    table.add_row(
        "markers", f"{fit.rows} rows of {fit.cols}, {measured.sum()} measured, {rejected} rejected as outliers"
    )
    if any(fit.skipped):
        lines = VisiblePart.of_calibration(fit).lines
        table.add_row("visible", f"{lines_text(lines, *fit.printed_grid)} of the printed grid, counted in the image")
    if ruler:
        table.add_row("spacing", f"{fit.spacing_mm:.4g} mm between neighbouring markers, by the ruler")
    table.add_row("scale", f"{along:.2f} px/mm along rows, {down:.2f} along columns (centre)")
    table.add_row("", f"{min(scales):.2f} to {max(scales):.2f} px/mm over the grid")
    table.add_row("lens", lens)
    residuals = (fit.residual_px, 1e3 * fit.residual_px / along, fit.largest_px)
    table.add_row("residual", "{:.3f} px = {:.1f} µm root mean square, {:.2f} px at most".format(*residuals))
    reason = "the unevenness of the print" + (", and the reading of the ruler" if ruler else "")
    table.add_row("uncertainty", f"{100 * (fit.scale_error or 0.0):.1f} % of a length, from {reason}")
    spacings = fit.residual_px / (fit.spacing_mm * min(along, down))
    if spacings > _UNEVEN and (fit.smooth_share or 0.0) > _SMOOTH:
        table.add_row("", "the deviations change slowly over the image: check that nothing touches the gel")
    table.add_row("written", written)
    return table


def _scale(fit: CameraCalibration, position: Floats) -> float:
    """Mean scale at a position on the gel [px/mm], from the area of a small square."""
    corners = fit.to_pixels(position + np.array([[0, 0], [0.1, 0], [0, 0.1]]))
    (right, down) = corners[1:] - corners[0]
    return float(np.sqrt(abs(right[0] * down[1] - right[1] * down[0]))) / 0.1
