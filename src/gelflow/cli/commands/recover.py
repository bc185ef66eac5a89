"""`gelflow recover`: salvage what a killed recorder left behind."""

import argparse
from pathlib import Path

from rich.console import Console

from gelflow.session.recovery import recover


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the unfinished or damaged session")
    parser.add_argument("--output", type=Path, help="the new session; default: FILE with .recovered.mcap at its end")


def run(args: argparse.Namespace) -> int:
    target = args.output or args.file.with_name(f"{args.file.stem}.recovered.mcap")
    report = recover(args.file, target)
    console = Console(highlight=False)
    console.print(f"{report.messages} records over {report.duration:.2f} s of robot time are whole", markup=False)
    if report.lost_bytes:
        console.print(f"lost: {report.lost_bytes} bytes of a record that was cut off at the end", markup=False)
    if report.damaged_chunks:
        console.print(f"lost: {report.damaged_chunks} chunks or records with damaged contents", markup=False)
    console.print(f"written: {report.path}", markup=False, soft_wrap=True)
    return 0
