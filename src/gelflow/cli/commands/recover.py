"""`gelflow recover`: copy the complete records of an unfinished or damaged session."""

import argparse
import dataclasses
from pathlib import Path

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_json, add_out
from gelflow.cli.output import Output, progress_bar
from gelflow.session.recovery import recover


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("session", type=Path, metavar="SESSION", help="the unfinished or damaged session")
    add_out(parser, "the new session; default: the name of SESSION with .recovered.mcap at its end")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Recover the session, then print the number of recovered and lost records."""
    output = Output(args.json)
    target = args.out or args.session.parent / f"{args.session.stem}.recovered.mcap"
    with progress_bar() as progress:
        progress.add_task("recovering", total=None)
        report = recover(args.session, target)
    output.text(f"recovered: {report.messages} records over {report.duration:.2f} s of robot time")
    if report.lost_bytes:
        output.text(f"lost: {report.lost_bytes} bytes of incomplete or damaged records")
    if report.damaged_chunks:
        output.text(f"lost: {report.damaged_chunks} chunks or records with damaged contents")
    output.text(f"written: {report.path}")
    output.result(dataclasses.asdict(report))
    return SUCCESS
