"""Gradient checks over all scenes, shapes, friction laws and integrators.

See `gelflow.sim.validation.studies.gradient_survey`; tests/sim/gradients/test_gradients.py runs
the same checks with three states. Exit status: 0 when all combinations are within the limits, 1 when not.
"""

import sys
import time
from dataclasses import asdict

import script

from gelflow.sim._core import LEVEL
from gelflow.sim.validation.studies.gradient_survey import (
    DIFFERENCE_LIMIT,
    DUAL_LIMIT,
    SKIPPED_LIMIT,
    STATES,
    count,
    survey,
    table,
)


def main() -> int:
    parser = script.parser(
        "Check gradients of all scenes and shapes.", out="gradients.json", quick="one state per combination", seed=0
    )
    parser.add_argument("--states", type=int, default=STATES, metavar="N", help="states per combination (%(default)s)")
    args = parser.parse_args()
    states, start = 1 if args.quick else args.states, time.perf_counter()
    with script.progress("states", count(states)) as advance:
        results = survey(states, advance, seed=args.seed)
    seconds = time.perf_counter() - start
    violations = [result for result in results if not result.within_limits]
    record = {
        **script.header(),
        "core": LEVEL,
        "seconds": round(seconds),
        "limits": {"dual": DUAL_LIMIT, "difference": DIFFERENCE_LIMIT, "skipped": SKIPPED_LIMIT},
        "results": [asdict(result) for result in results],
    }
    summary = f"{len(violations)} of {len(results)} combinations outside the limits, {seconds:.0f} s"
    script.finish(args, record, table(results), summary)
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(script.run(main))
