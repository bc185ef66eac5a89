"""`gelflow export CHECKPOINT`: the policy as an ONNX model."""

import argparse
from pathlib import Path

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out
from gelflow.cli.output import Output
from gelflow.errors import UsageError


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("checkpoint", type=Path, metavar="CHECKPOINT", help="checkpoint of gelflow train")
    add_out(parser, "model to write (default: beside the checkpoint, with the suffix .onnx)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Export the policy and print the path of the model."""
    if not args.checkpoint.name:
        raise UsageError(f"{args.checkpoint} is no checkpoint; name a file that gelflow train has written")
    from gelflow.policies.onnx_export import export  # deferred: torch is slow to import

    out = args.out or args.checkpoint.with_suffix(".onnx")
    export(args.checkpoint, out)
    output = Output(args.json)
    output.text(f"wrote {out}")
    output.result({"checkpoint": args.checkpoint, "model": out})
    return SUCCESS
