"""`gelflow track`: follow the markers of recorded or live tactile images; write and draw what was found."""

import argparse
import itertools
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gelflow.cli.refused import picture_of_refusal
from gelflow.cli.track_output import CODECS, PICTURES, CsvOutput, McapOutput, Output, OverlayOutput, Step
from gelflow.cli.track_summary import Summary
from gelflow.errors import UsageError
from gelflow.perception.calibration import Calibration, load_calibration
from gelflow.perception.sources import ImageSource, SourceImage, image_source
from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult
from gelflow.session.records import software_versions


def configure(parser: argparse.ArgumentParser) -> None:
    """The options of `gelflow track`."""
    parser.add_argument("source", help="folder of images, image, video, session (.mcap), stream URL, camera's number")
    parser.add_argument("--rows", type=int, help="lines of markers (default: found)")
    parser.add_argument("--cols", type=int, help="markers in a line (default: found); rows and cols may be swapped")
    polarity = parser.add_mutually_exclusive_group()
    polarity.add_argument("--dark", action="store_true", help="dots are darker than the gel (default: found)")
    polarity.add_argument("--bright", action="store_true", help="dots are brighter than the gel (default: found)")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="of gelflow calibrate-camera: millimetres too")
    parser.add_argument("--overlay", type=Path, metavar="FILE", help="video (.mkv, .avi, .mp4), or .png of the last")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="table: one row per image and marker")
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="recording of the images and their markers")
    parser.add_argument("--images", type=int, metavar="N", help="stop after N images (default: at the end, or Ctrl-C)")
    parser.add_argument("--rate", type=float, default=25.0, metavar="HZ", help="of a folder's images (%(default)s)")
    parser.add_argument("--sensor", default="left", help="of a session: left or right (%(default)s)")
    parser.add_argument("--magnify", type=float, default=3.0, help="length of the arrows drawn (%(default)s times)")


def run(args: argparse.Namespace) -> int:
    """Tracks, writes what was asked for, prints a summary."""
    _check(args)
    source = image_source(args.source, sensor=args.sensor, rate=args.rate)
    polarity = "dark" if args.dark else "bright" if args.bright else "auto"
    tracker = MarkerTracker(TrackerConfig(rows=args.rows, cols=args.cols, polarity=polarity))  # type: ignore[arg-type]
    calibration = load_calibration(args.calibration) if args.calibration else None
    console, summary, begin = Console(highlight=False), Summary(), time.perf_counter()
    try:
        _follow(source, tracker, calibration, summary, args, console)
    except KeyboardInterrupt:
        if not source.live or not summary.images:
            raise
    finally:
        # What was tracked before an error or Ctrl-C is written, and told.
        if summary.images:
            console.print(summary.table(time.perf_counter() - begin, [str(file) for file in _files(args)]))
    return 0


def _check(args: argparse.Namespace) -> None:
    if (args.images is not None and args.images < 1) or not args.magnify > 0:
        raise UsageError("--images must be at least 1, --magnify above 0")
    known = (*CODECS, *PICTURES)
    if args.overlay is not None and args.overlay.suffix.lower() not in known:
        raise UsageError(f"--overlay {args.overlay}: its suffix must be one of {', '.join(known)}")
    for file in _files(args):
        if file.exists():
            raise UsageError(f"{file} exists; name a new file")
        if not file.parent.is_dir():
            raise UsageError(f"{file}: the folder {file.parent} does not exist")


def _follow(
    source: ImageSource,
    tracker: MarkerTracker,
    calibration: Calibration | None,
    summary: Summary,
    args: argparse.Namespace,
    console: Console,
) -> None:
    total = source.count()
    if args.images is not None:
        total = args.images if total is None else min(total, args.images)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        ExitStack() as open_files,
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress,
    ):
        bar = progress.add_task("tracking", total=total)
        outputs: list[Output] = []
        for number, frame in enumerate(itertools.islice(source, args.images)):
            if number == 0 and calibration is not None:
                calibration.check_size(frame.image)
            begin = time.perf_counter()
            with picture_of_refusal(next(_files(args), Path("track"))):
                tracked = tracker.track(frame.image)
            seconds = time.perf_counter() - begin
            if number == 0:
                # Not before: a start that is refused leaves no empty files.
                outputs = [open_files.enter_context(closing(one)) for one in _outputs(args, calibration)]
            step = _step(number, frame, tracked, calibration)
            for output in outputs:
                output.add(step)
            summary.add(step, seconds)
            progress.advance(bar)


def _files(args: argparse.Namespace) -> Iterator[Path]:
    """The files that were asked for."""
    return (file for file in (args.overlay, args.csv, args.mcap) if file is not None)


def _outputs(args: argparse.Namespace, calibration: Calibration | None) -> Iterator[Output]:
    if args.overlay is not None:
        yield OverlayOutput(args.overlay, magnify=args.magnify)
    if args.csv is not None:
        yield CsvOutput(args.csv, millimetres=calibration is not None)
    if args.mcap is not None:
        description = {"source": args.source, "calibration": calibration, "versions": software_versions()}
        yield McapOutput(args.mcap, args.sensor, description)


def _step(number: int, frame: SourceImage, tracked: TrackingResult, calibration: Calibration | None) -> Step:
    if calibration is None:
        return Step(number, frame, tracked)
    displacement = calibration.displacement_mm(tracked.position, tracked.displacement)
    return Step(number, frame, tracked, calibration.to_mm(tracked.position), displacement)
