"""`gelflow track`: follow the markers of recorded or live tactile images, and draw what was found."""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from gelflow.errors import UsageError
from gelflow.perception.overlay import draw_overlay
from gelflow.perception.sources import Source, find_source
from gelflow.perception.tracker import MarkerTracker, Tracked, TrackerConfig

TRACKS = "tracks.npz"
FORMAT = 1


def configure(parser: argparse.ArgumentParser) -> None:
    """The options of `gelflow track`."""
    parser.add_argument("source", help="folder of images, image, video file, stream URL, or a camera's number")
    parser.add_argument("--rows", type=int, help="lines of markers (default: found)")
    parser.add_argument("--cols", type=int, help="markers in a line (default: found); rows and cols may be swapped")
    polarity = parser.add_mutually_exclusive_group()
    polarity.add_argument("--dark", action="store_true", help="dots are darker than the gel (default: found)")
    polarity.add_argument("--bright", action="store_true", help="dots are brighter than the gel (default: found)")
    parser.add_argument("--out", type=Path, default=Path("tracks"), metavar="DIR", help="where to write (%(default)s)")
    parser.add_argument(
        "--every", type=int, default=10, metavar="N", help="draw every N-th image, and the last (default %(default)s)"
    )
    parser.add_argument("--images", type=int, metavar="N", help="stop after N images (default: at the end, or Ctrl-C)")
    parser.add_argument("--magnify", type=float, default=3.0, help="length of the arrows (default %(default)s times)")


@dataclass
class _Run:
    """What has been tracked so far."""

    out: Path
    names: list[str] = field(default_factory=list)
    tracked: list[Tracked] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)  # that tracking one image took [s]
    pictures: int = 0
    last: NDArray[np.uint8] | None = None

    def draw(self, magnify: float) -> None:
        """Writes the overlay of the newest image."""
        if self.last is None:
            return
        file = self.out / f"overlay_{len(self.names) - 1:06d}.png"
        if not cv2.imwrite(str(file), draw_overlay(self.last, self.tracked[-1], magnify=magnify)):
            raise UsageError(f"{file} can not be written")
        self.pictures += 1

    def save(self) -> None:
        """Writes all tracks: arrays over images and markers, line by line from the top."""
        first = self.tracked[0]
        np.savez_compressed(
            self.out / TRACKS,
            format=FORMAT,
            names=np.array(self.names),
            rows=first.rows,
            cols=first.cols,
            spacing_px=first.spacing,
            positions_px=np.array([t.position for t in self.tracked], dtype=np.float32),
            displacement_px=np.array([t.displacement for t in self.tracked], dtype=np.float32),
            valid=np.array([t.valid for t in self.tracked]),
        )


def run(args: argparse.Namespace) -> int:
    """Tracks, writes overlays and tracks, prints a table."""
    if args.every < 1 or (args.images is not None and args.images < 1) or not args.magnify > 0:
        raise UsageError("--every, --images and --magnify must be at least 1, 1 and above 0")
    polarity = "dark" if args.dark else "bright" if args.bright else "auto"
    tracker = MarkerTracker(TrackerConfig(rows=args.rows, cols=args.cols, polarity=polarity))  # type: ignore[arg-type]
    source = find_source(args.source)
    console = Console(highlight=False)
    result = _Run(_folder(args.out))
    try:
        _follow(source, tracker, result, args, console)
    except KeyboardInterrupt:
        if not source.live or not result.names:
            raise
    finally:
        # What was tracked before an error or Ctrl-C is kept.
        if result.names:
            if (len(result.names) - 1) % args.every:
                result.draw(args.magnify)
            result.save()
    _report(console, result)
    return 0


def _follow(source: Source, tracker: MarkerTracker, result: _Run, args: argparse.Namespace, console: Console) -> None:
    total = source.count()
    if args.images is not None:
        total = args.images if total is None else min(total, args.images)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("tracking", total=total)
        for name, image in _limited(source, args.images):
            begin = time.perf_counter()
            tracked = tracker.track(image)
            result.seconds.append(time.perf_counter() - begin)
            result.names.append(name)
            result.tracked.append(tracked)
            result.last = image
            if (len(result.names) - 1) % args.every == 0:
                result.draw(args.magnify)
            progress.advance(bar)


def _limited(source: Source, most: int | None) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    for number, item in enumerate(source, start=1):
        yield item
        if number == most:
            return


def _folder(out: Path) -> Path:
    """Makes `out`, without the pictures of an earlier run that would mix with the new ones."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        if (out / TRACKS).exists():
            for old in out.glob("overlay_[0-9][0-9][0-9][0-9][0-9][0-9].png"):
                old.unlink()
    except OSError as error:
        raise UsageError(f"--out {out} can not be used as a folder: {error.strerror}") from None
    return out


def _report(console: Console, result: _Run) -> None:
    first = result.tracked[0]
    valid = np.array([t.valid for t in result.tracked])
    length = np.linalg.norm(np.array([t.displacement for t in result.tracked]), axis=-1)
    length[~valid] = -1.0
    table = Table(show_header=False)
    table.add_row("images", str(len(result.names)))
    table.add_row("markers", f"{valid.shape[1]}: {first.rows} lines of {first.cols}, {first.spacing:.1f} px apart")
    table.add_row("valid", f"{100 * valid.mean():.1f} % (in the worst image {100 * valid.mean(axis=1).min():.1f} %)")
    if valid.any():
        image, marker = np.unravel_index(int(length.argmax()), length.shape)
        line, column = divmod(int(marker), first.cols)
        where = f"{result.names[image]}, line {line + 1}, marker {column + 1}"
        table.add_row("largest displacement", f"{length.max():.1f} px ({where})")
    # The first image is another matter: in it the grid is found.
    usual = np.median(result.seconds[1:]) if len(result.seconds) > 1 else result.seconds[0]
    table.add_row("time", f"{1e3 * usual:.1f} ms an image (the first {1e3 * result.seconds[0]:.0f} ms)")
    table.add_row("written", f"{result.pictures} overlays and {TRACKS} in {result.out}")
    console.print(table)
