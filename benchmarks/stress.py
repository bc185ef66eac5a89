"""Failure rates of two million random steps outside the normal range, about 3 minutes on 2 cores.

The distribution is described in `gelflow.sim.validation.stress`. Exit status: 0 when no step of the normal range and at
most 1 % of all steps failed, 1 otherwise.
"""

import sys
import time

import script

from gelflow.sim.simulator import STATUS_MESSAGES
from gelflow.sim.validation.studies.stress_survey import count, iteration_limit, survey, table


def main() -> int:
    parser = script.parser(
        "Count failures among random steps outside the normal range.", out="stress.json", quick="one round", seed=0
    )
    parser.add_argument("--rounds", type=int, default=21, metavar="N", help="100 000 steps each (%(default)s)")
    args = parser.parse_args()
    rounds, start = 1 if args.quick else args.rounds, time.perf_counter()
    with script.progress("batches", count(rounds)) as advance:
        result = survey(rounds, advance, seed=args.seed)
    seconds = time.perf_counter() - start
    lines = [f"failed, {STATUS_MESSAGES[status]}: {n}" for status, n in sorted(result.total.reasons.items())]
    lines.append(
        f"{result.total.steps} steps in {seconds:.0f} s; at most {iteration_limit()} Newton iterations per step"
    )
    record = {**script.header(), "seconds": round(seconds, 1), "rows": result.records()}
    script.finish(args, record, table(result), *lines)
    return 0 if result.passed else 1


if __name__ == "__main__":
    sys.exit(script.run(main))
