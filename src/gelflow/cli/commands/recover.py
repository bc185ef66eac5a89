"""`gelflow recover`: salvage what a killed recorder left behind."""

import argparse
from pathlib import Path

from rich.console import Console

from gelflow.session.recover import recover


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="the unfinished or damaged session")
    parser.add_argument("--output", type=Path, help="the new session; default: FILE with .recovered.mcap at its end")


def run(args: argparse.Namespace) -> int:
    target = args.output or args.file.with_name(f"{args.file.stem}.recovered.mcap")
    salvage = recover(args.file, target)
    console = Console(highlight=False)
    console.print(f"{salvage.messages} records over {salvage.duration:.2f} s of robot time are whole", markup=False)
    if salvage.lost_bytes:
        console.print(f"lost: {salvage.lost_bytes} bytes of a record that was cut off at the end", markup=False)
    if salvage.damaged_chunks:
        console.print(f"lost: {salvage.damaged_chunks} chunks or records with damaged contents", markup=False)
    console.print(f"written: {salvage.path}", markup=False, soft_wrap=True)
    return 0
