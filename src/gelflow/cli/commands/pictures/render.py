"""`gelflow render`: gel images with known marker positions and selectable flaws."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out, add_seed, check_at_least, picture_size
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import UsageError
from gelflow.perception.synthetic.appearance import PRESETS, SIZES, DegradedGelAppearance, make_appearance
from gelflow.perception.synthetic.sequence_files import truth_file, write_sequence
from gelflow.perception.synthetic.sequences import FIELDS, MOTIONS, GelSequence

# Fields of the appearance for --set, with their types; the other fields have their own options or follow from these.
_SETTABLE: dict[str, Any] = {
    field.name: field.type
    for field in dataclasses.fields(DegradedGelAppearance)
    if field.type in (float, int, bool) and field.name not in ("width", "height", "seed", "mirrored", "pixels_per_mm")
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "--flaws", choices=list(PRESETS), default="typical", help="class of image flaws (default %(default)s)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change one factor, repeatable; names: {', '.join(_SETTABLE)}",
    )
    parser.add_argument("--field", choices=FIELDS, default="shear", help="deformation of the gel (default %(default)s)")
    parser.add_argument(
        "--motion",
        choices=MOTIONS,
        default="smooth",
        help="to the peak and back to rest, to the peak within one image, or none (default %(default)s)",
    )
    parser.add_argument("--peak", type=float, default=0.4, metavar="X", help="largest motion in spacings (%(default)s)")
    parser.add_argument("--frames", type=int, default=64, metavar="N", help="number of images (default %(default)s)")
    parser.add_argument(
        "--period", type=int, default=60, metavar="N", help="images of one smooth motion (default %(default)s)"
    )
    parser.add_argument(
        "--markers", type=int, choices=list(SIZES), default=130, help="number of markers (default %(default)s)"
    )
    parser.add_argument("--size", default="320x240", metavar="WxH", help="image size [px] (default %(default)s)")
    add_seed(parser)
    add_out(parser, "a new folder for JPEG images, or a new file .mjpeg", default=Path("out/render"))
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Render the sequence, then print the paths of images and true positions."""
    width, height = picture_size(args.size)
    check_at_least(args, seed=0)
    changed = dict(_factor(text) for text in args.set)
    appearance = make_appearance(
        args.flaws, markers=args.markers, width=width, height=height, seed=args.seed, **changed
    )
    sequence = GelSequence(
        appearance, args.field, frames=args.frames, peak=args.peak, motion=args.motion, period=args.period
    )
    output = Output(args.json)
    with progress_bar(count=True) as progress:
        bar = progress.add_task("rendering", total=args.frames)
        for done in write_sequence(sequence, args.out):
            progress.update(bar, completed=done)
    truth = truth_file(args.out)
    output.text(f"{args.frames} images in {args.out}, true marker positions in {truth}")
    output.result({"images": args.frames, "out": args.out, "truth": truth})
    return SUCCESS


def _factor(text: str) -> tuple[str, float | int | bool]:
    """Name and value of a field of the appearance from NAME=VALUE."""
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
