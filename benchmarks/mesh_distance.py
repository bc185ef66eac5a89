"""Accuracy and speed of the distance grids of meshes (`gelflow.sim.validation.studies.mesh_distance`)."""

import sys
from dataclasses import asdict
from pathlib import Path

import script

from gelflow.sim.validation.studies.mesh_distance import BAND, error_table, measure, time_table
from gelflow.sim.validation.studies.mesh_distance_picture import draw


def main() -> int:
    parser = script.parser(
        "Measure distance grids of meshes against exact solids.",
        out="mesh_distance.json",
        quick="resolutions up to 32 cells",
        seed=0,
    )
    parser.add_argument("--picture", type=Path, default=script.PICTURES / "mesh_distance.png", metavar="FILE")
    parser.add_argument("--repeats", type=int, default=200, metavar="N", help="timed repeats (%(default)s)")
    args = parser.parse_args()
    with script.progress("grids") as advance:
        results, times = measure(advance, quick=args.quick, repeats=args.repeats, seed=args.seed)
    record = {
        **script.header(),
        "band": BAND,
        "results": [asdict(result) for result in results],
        "microseconds_per_point": times,
    }
    draw(results, args.picture)
    script.finish(args, record, error_table(results), time_table(times))
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
