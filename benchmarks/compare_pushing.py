"""Marker forces of the pushing scene compared with DiffRedMax: `python benchmarks/compare_pushing.py FILE.npz`.

See `gelflow.sim.validation.studies.pushing_comparison`. Exit status: 0 when all forces agree within --tolerance, 1 when
not, 2 for an invalid file.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import script
from rich.console import Console

from gelflow.sim.validation.studies.pushing_comparison import compare, load, table


def main() -> int:
    parser = argparse.ArgumentParser(description="Compare the marker forces of the pushing scene with DiffRedMax.")
    parser.add_argument("file", type=Path, help="the reference trajectory (.npz)")
    parser.add_argument("--tolerance", type=float, default=1e-9, metavar="N", help="largest difference (1e-9 N)")
    args = parser.parse_args()
    reference = load(args.file)
    result = compare(reference)
    console = Console(markup=False)
    console.print(table(reference, result))
    largest = float(np.abs(result.difference).max())
    console.print(f"Largest velocity term, tangential part of kₜ ω × (d n): {result.largest_term:.1e} N.")
    console.print(f"Largest deviation from Coulomb's bound: {result.bound_error:.1e} N.")
    agree = max(largest, result.bound_error) <= args.tolerance
    console.print(f"Largest difference: {largest:.1e} N; {'agrees' if agree else 'DISAGREES'} to {args.tolerance:g} N.")
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(script.run(main))
