"""A quick stand-in for `gelflow train`: the same options, files and result, and steps that continue after a kill.

Test hooks in the folder of the sweep: the run waits in its middle while the file `hold` exists; it fails with exit code
3 while `fail` exists, and with exit code 2 while `refuse` exists. With `crash` it is killed after it printed its
result. With `full` it deletes this file and ends without a result, as on a full disk.
"""

import argparse
import csv
import json
import os
import signal
import sys
import time
from pathlib import Path

STEPS = 10


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=["train"])
    parser.add_argument("task")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    hooks: Path = args.out.parents[1]
    args.out.mkdir(parents=True, exist_ok=True)
    for name, code in (("refuse", 2), ("fail", 3)):
        if (hooks / name).exists():
            sys.exit(fail(f"asked to {name}", code))
    state = args.out / "state.json"
    done = json.loads(state.read_text()) if state.exists() else []
    for step in range(len(done), STEPS):
        done.append([step, args.rate * (step + args.seed), os.getpid()])
        partial = state.with_suffix(".part")
        partial.write_text(json.dumps(done))
        partial.replace(state)
        while step == STEPS // 2 and (hooks / "hold").exists():
            time.sleep(0.02)
    table = args.out / "learning_curve.csv"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("steps", "success"), *(row[:2] for row in done)])
    if (hooks / "full").exists():
        (hooks / "full").unlink()
        sys.exit(fail("No space left on device", 2))
    print(json.dumps({"learning_curve": str(table), "validation": {"success": done[-1][1]}}), flush=True)
    if (hooks / "crash").exists():
        os.kill(os.getpid(), signal.SIGKILL)


def fail(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
