"""The summary that `gelflow track` prints."""

from pathlib import Path

from rich.table import Table

from gelflow.cli.output import Output
from gelflow.perception.mount_check import VisiblePart, lines_text
from gelflow.perception.output.forces import force_text
from gelflow.perception.output.summary import TrackingSummary
from gelflow.perception.sources import ImageSource


def show_summary(
    output: Output, summary: TrackingSummary, source: ImageSource, wall: float, files: list[Path], gel: str | None
) -> None:
    """Print the summary; `wall` is the duration of the run [s], `gel` names the gel of the forces."""
    values, skipped = summary.to_json(), source.skipped
    if output.json:
        not_tracked = {
            "unreadable_images": skipped.unreadable,
            "first_unreadable": skipped.first or None,
            "dropped_images": skipped.dropped,
        }
        output.result(values | not_tracked | {"gel": gel, "seconds": wall, "files": files})
        return
    markers, spacing = values["rows"] * values["cols"], values["spacing_px"]
    table = Table(show_header=False)
    table.add_row("images", str(values["images"]))
    if skipped.unreadable:
        table.add_row("skipped", f"{skipped.unreadable} unreadable or without a grid; {skipped.first}")
    if skipped.dropped:
        table.add_row("dropped", f"{skipped.dropped} live images, while tracking and writing were behind")
    table.add_row("markers", f"{markers}: {values['rows']} rows of {values['cols']}, {spacing:.1f} px apart")
    if summary.visible:
        table.add_row("visible", _visible_text(summary.visible, markers))
    if summary.pixels_per_mm is not None:
        reduce = source.profile.image.reduce
        where = f" in images at 1/{reduce} of their size" if reduce > 1 else ""
        scale = f"{summary.pixels_per_mm:.2f} px/mm everywhere{where}: no lens and no tilt; see calibrate-camera"
        table.add_row("scale", scale)
    worst = f"in the worst image {100 * values['tracked_share_min']:.1f} %"
    table.add_row("tracked", f"{100 * values['tracked_share']:.1f} % ({worst})")
    table.add_row("inferred", f"{100 * values['inferred_share']:.1f} %, from neighbours")
    jitter = values["jitter_px"]
    quiet = f"{jitter:.3f} px, in the quietest quarter of the images" if jitter is not None else "too few images"
    table.add_row("rest jitter", quiet)
    largest, largest_mm = values["largest_displacement_px"], values["largest_displacement_mm"]
    if largest is not None:
        mm = f", {largest_mm:.3f} mm" if largest_mm is not None else ""
        where = values["largest_displacement_at"]
        table.add_row("largest motion", f"{largest:.2f} px, {largest / spacing:.2f} of the spacing{mm} ({where})")
    if gel is not None:
        table.add_row("gel", gel)
    if summary.largest_normal is not None:
        image = f" ({summary.largest_normal_at})" if summary.largest_normal.contact else ""
        table.add_row("largest force", force_text(summary.largest_normal) + image)
        table.add_row("slip", summary.slip.text())
    usual, first = values["seconds_per_image"], values["seconds_first_image"]
    speed = f"{1 / usual:.0f} a second tracked ({1e3 * usual:.2f} ms each, the first {1e3 * first:.0f} ms)"
    table.add_row("speed", f"{speed}, {summary.images / wall:.0f} a second with reading and writing")
    for file in files:
        table.add_row("written" if summary.complete else "incomplete", str(file))
    output.console.print(table)


def _visible_text(parts: list[VisiblePart], markers: int) -> str:
    """The visible lines of a printed grid, or how many there are where the image does not show which ones."""
    rows, cols = parts[0].rows, parts[0].cols
    count = f"{markers} of {rows * cols} printed markers"
    if len(parts) == 1:
        return f"{count}: {lines_text(parts[0].lines, rows, cols)}, counted in the image"
    seen_rows, seen_cols = parts[0].shape
    return f"{count}: {seen_rows} of {rows} rows, {seen_cols} of {cols} columns; the image does not show which ones"
