"""Instructions of a step by purpose, for each scene (`gelflow.sim.benchmark.profile`); needs valgrind."""

import shutil
import sys
from dataclasses import asdict

import script

from gelflow.errors import UsageError
from gelflow.sim.benchmark.profile import measure, table
from gelflow.sim.validation.reference_motions import SCENES


def main() -> int:
    parser = script.parser("Count the instructions of a step by purpose.", out="profile.json", quick="one scene")
    args = parser.parse_args()
    if shutil.which("valgrind") is None:
        raise UsageError("valgrind is not installed; install the package valgrind")
    with script.progress("scenes", 1 if args.quick else len(SCENES)) as advance:
        profiles = measure(advance, quick=args.quick)
    record = {**script.header(), "scenes": {name: asdict(profile) for name, profile in profiles.items()}}
    script.finish(args, record, table(profiles))
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
