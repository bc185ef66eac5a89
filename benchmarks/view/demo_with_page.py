"""Compares runs of the demo with and without the page of `--view`: decisions, missed EGM cycles, time.

    python -m benchmarks.view.demo_with_page --pairs 3

Each pair is one run without the page and one with the page open in headless Chromium, which draws by software. EGM
cycles are missed when the controller's message arrives too late or is not answered. A second run without the page shows
how much two equal runs differ.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from tests.view.browser import Browser, browser

from gelflow.session import SessionReader


class Run(NamedTuple):
    """The figures of a run that are compared."""

    corrections: NDArray[np.float64]  # of all decisions: x, y [m], yaw [rad]
    cycles: int  # of EGM
    missed: float  # fraction of the cycles
    answer: float  # time from a message to its answer, 99.9 % [s]
    inserted: int
    seconds: float  # wall time


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--parts", type=int, default=2)
    parser.add_argument("--factor", type=float, default=1.0, help="robot time over wall time")
    parser.add_argument("--seed", type=int, default=1, help="of the first pair")
    args = parser.parse_args()
    table = Table("page", "parts in", "attempts", "difference\n[mm]", "difference\n[°]", "cycles", "missed\n[%]",
                  "answer 99.9 %\n[ms]", "wall [s]")  # fmt: skip
    with browser() as window:
        for seed in range(args.seed, args.seed + args.pairs):
            first = demo(args, seed, None)
            for name, page in (("no", None), ("no, again", None), ("open", window)):
                run = first if name == "no" else demo(args, seed, page)
                table.add_row(name, *row(run, first), end_section=page is not None)
    Console(width=100, markup=False).print(table)


def row(run: Run, first: Run) -> list[str]:
    """The figures of a run, compared with those of the first with the same seed."""
    same = run.corrections.shape == first.corrections.shape
    change = np.abs(run.corrections - first.corrections).max(axis=0, initial=0) if same else np.full(3, np.nan)
    return [
        str(run.inserted), str(len(run.corrections)), f"{1e3 * change[:2].max():.2f}", f"{np.degrees(change[2]):.2f}",
        str(run.cycles), f"{100 * run.missed:.3f}", f"{1e3 * run.answer:.1f}", f"{run.seconds:.0f}",
    ]  # fmt: skip


def demo(args: argparse.Namespace, seed: int, window: Browser | None) -> Run:
    """One run of the demo, with the page if there is a window."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["gelflow", "demo", "--no-real-time", "--json", "--out", folder, "--seed", str(seed)]
        words += ["--insertions", str(args.parts), "--factor", str(args.factor)]
        words += ["--view", "--port", "0"] if window else []
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None and process.stderr is not None
            if window is not None:
                address = next(line for line in process.stderr if "open http" in line).split()[1]
                window.open(address)
            out, _ = process.communicate()
        series = json.loads(out)["series"][0]
        with SessionReader(Path(folder) / "session.mcap") as session:
            decisions: Any = [record.value for record in session.records(["/decision"])]
            events = [record.value for record in session.records(["/event"])]
    timing = next(event["values"] for event in events if event["name"] == "arm timing")
    return Run(
        np.array([decision.action for decision in decisions]).reshape(-1, 3),
        timing["cycles"],
        timing["missed"],
        timing["answer"][2],
        sum(insertion["truth"]["inserted"] for insertion in series["insertions"]),
        series["seconds"],
    )


if __name__ == "__main__":
    main()
