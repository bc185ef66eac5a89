"""`gelflow render`: images of a gel whose markers' true places are known, with the flaws that one asks for."""

import argparse
import dataclasses
import re
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gelflow.errors import UsageError
from gelflow.perception.synthetic.appearance import PRESETS, SIZES, DegradedGelAppearance, make_appearance
from gelflow.perception.synthetic.sequence_files import truth_file, write_sequence
from gelflow.perception.synthetic.sequences import FIELDS, MOTIONS, GelSequence

# Fields of a look that --set takes, and their types; the others have options of their own or follow from these.
_SETTABLE: dict[str, Any] = {
    field.name: field.type
    for field in dataclasses.fields(DegradedGelAppearance)
    if field.type in (float, int, bool) and field.name not in ("width", "height", "seed", "mirrored", "pixels_per_mm")
}


def configure(parser: argparse.ArgumentParser) -> None:
    """The options of `gelflow render`."""
    parser.add_argument("out", type=Path, metavar="OUT", help="a new folder for JPEG images, or a new FILE.mjpeg")
    parser.add_argument(
        "--preset", choices=list(PRESETS), default="typical", help="class of images (default %(default)s)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change one factor, again and again; names: {', '.join(_SETTABLE)}",
    )
    parser.add_argument("--field", choices=FIELDS, default="shear", help="how the gel moves (default %(default)s)")
    parser.add_argument(
        "--motion",
        choices=MOTIONS,
        default="smooth",
        help="to the peak and back to rest, to the peak within one image, or none (default %(default)s)",
    )
    parser.add_argument("--peak", type=float, default=0.4, help="largest motion in spacings (default %(default)s)")
    parser.add_argument("--frames", type=int, default=64, metavar="N", help="how many images (default %(default)s)")
    parser.add_argument(
        "--period", type=int, default=60, metavar="N", help="images of one smooth motion (default %(default)s)"
    )
    parser.add_argument("--markers", type=int, choices=list(SIZES), default=130, help="default %(default)s")
    parser.add_argument("--size", default="320x240", metavar="WxH", help="of the images [px] (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="another light, print, contact and noise")


def run(args: argparse.Namespace) -> int:
    """Draws the sequence and says what is where."""
    size = re.fullmatch(r"(\d+)x(\d+)", args.size)
    if size is None:
        raise UsageError(f"--size must be width x height in pixels, as 640x480; got {args.size!r}")
    if args.seed < 0:
        raise UsageError(f"--seed must be at least 0, got {args.seed}")
    changed = dict(_factor(text) for text in args.set)
    width, height = (int(part) for part in size.groups())
    look = make_appearance(args.preset, markers=args.markers, width=width, height=height, seed=args.seed, **changed)
    sequence = GelSequence(look, args.field, frames=args.frames, peak=args.peak, motion=args.motion, period=args.period)
    console = Console(highlight=False)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("drawing", total=args.frames)
        for done in write_sequence(sequence, args.out):
            progress.update(bar, completed=done)
    console.print(f"{args.frames} images in {args.out}, their truth in {truth_file(args.out)}", soft_wrap=True)
    return 0


def _factor(text: str) -> tuple[str, float | int | bool]:
    """NAME=VALUE as what the look takes."""
    name, equals, value = text.partition("=")
    if not equals or name not in _SETTABLE:
        raise UsageError(f"--set takes NAME=VALUE, names are {', '.join(_SETTABLE)}; got {text!r}")
    kind = _SETTABLE[name]
    if kind is bool:
        if value not in ("yes", "no"):
            raise UsageError(f"--set {name} must be yes or no, got {value!r}")
        return name, value == "yes"
    try:
        return name, int(value) if kind is int else float(value)
    except ValueError:
        raise UsageError(f"--set {name} must be a {'whole ' if kind is int else ''}number, got {value!r}") from None
