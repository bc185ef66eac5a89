"""Coverage of the intervals of `gelflow calibrate` in random worlds; writes calibration_coverage.json."""

import sys

import script
from rich.table import Table

from gelflow.policies.calibration.experiment.coverage import measure_coverage
from gelflow.policies.calibration.fit import FitSettings

_QUICK = FitSettings(starts=1, points=1, poses=16, steps=1)


def main() -> int:
    """Calibrate in each world and count."""
    arguments = script.parser(__doc__ or "", out="calibration_coverage.json", quick="two worlds with little effort")
    arguments.add_argument("--worlds", type=int, default=100, metavar="N", help="number of worlds (default 100)")
    arguments.add_argument("--first", type=int, default=0, metavar="N", help="seed of the first world (default 0)")
    args = arguments.parse_args()
    count = 2 if args.quick else args.worlds
    seeds = range(args.first, args.first + count)
    with script.progress("worlds", count) as advance:
        result = measure_coverage(
            seeds, settings=_QUICK if args.quick else FitSettings(), processes=2, progress=lambda world: advance(1)
        )
    table = Table("worlds", "refused", "all known in their intervals", "known parameters", "of these in the interval")
    keys = ("worlds", "refused", "covered_worlds", "known", "known_in_interval")
    table.add_row(*(str(result[key]) for key in keys))
    script.finish(args, script.header() | result, table)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
