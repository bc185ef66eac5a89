"""Write a result of `gelflow bench rolling` with the machine that it ran on: `python benchmarks/rolling.py`.

The file goes to benchmarks/results/, named after the processor. Run it on a machine that does nothing else.
"""

import argparse
import json
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gelflow import __version__
from gelflow.cli.bench import EVERY, SIDES, plain
from gelflow.errors import GelflowError
from gelflow.sim._core import LEVEL
from gelflow.sim.benchmark import processor, rolling_speed

RESULTS = Path(__file__).parent / "results"


def versions() -> dict[str, str]:
    """Of gelflow, Python, and what the run goes through."""
    found = {"gelflow": __version__, "core": LEVEL, "python": platform.python_version(), "system": platform.platform()}
    for package in ("numpy", "mujoco"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a tree that was not installed with pip
            found[package] = "unknown"
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure the ball rolling run and write the result to a file.")
    parser.add_argument("--repeats", type=int, default=51, metavar="N", help="timed runs (%(default)s)")
    parser.add_argument("--out", type=Path, help="file to write (default: in benchmarks/results)")
    args = parser.parse_args()
    laws = ("viscous", "elastic")
    try:
        results = [
            plain(speed) | {"friction": law}
            for law in laws
            for speed in rolling_speed(sides=SIDES, every=EVERY, repeats=args.repeats, friction=law)
        ]
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    machine = processor()
    name = re.sub(r"[^a-z0-9]+", "_", machine.lower()).strip("_")
    file = args.out or RESULTS / f"rolling_{name}.json"
    record = {"format": 1, "processor": machine, "threads": 1, "versions": versions(), "results": results}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    print(file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
