"""Energy balance of steps (`gelflow.sim.validation.studies.energy_balance`).

Exit status: 0 when BDF1 adds no energy to free bodies, 1 when it does.
"""

import sys
from dataclasses import asdict

import script

from gelflow.sim.validation.studies.energy_balance import ALLOWED, body_table, count, measure, motion_table


def main() -> int:
    parser = script.parser(
        "Measure the energy balance of steps.", out="energy.json", quick="one step size for each setup", seed=1
    )
    args = parser.parse_args()
    with script.progress("energy", count(quick=args.quick)) as advance:
        bodies, motions = measure(advance, quick=args.quick, seed=args.seed)
    largest = max(balance.largest for balance in bodies if balance.integrator == "bdf1")
    record = {
        **script.header(),
        "thrown": [asdict(balance) for balance in bodies],
        "scenes": [asdict(balance) for balance in motions],
    }
    summary = f"BDF1: largest energy gain of a free body in a step {largest:.1e}; allowed {ALLOWED:g}."
    script.finish(args, record, body_table(bodies), motion_table(motions), summary)
    return 0 if largest <= ALLOWED else 1


if __name__ == "__main__":
    sys.exit(script.run(main))
