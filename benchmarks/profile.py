"""Where the instructions of a step go, scene by scene: `python benchmarks/profile.py` (needs valgrind).

Each scene's motion (`reference_motions`) runs under valgrind's callgrind, which counts the instructions of every
function while a step is taken. They are grouped by what the function is for, and divided by the steps. Counts do not
depend on how busy the machine is; the time beside them does.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from gelflow.measurement.machine import processor
from gelflow.sim.benchmark import versions
from gelflow.sim.benchmark.speed.timed_run import HOLD
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import SCENES, reference_motion

STEPS = 100
# Groups by the names of functions, looked for in this order; small ones are inlined into those that call them.
GROUPS = {
    "broad phase": (
        "find_candidate_points",
        "find_neighbors",
        "covers",
        "for_candidate_points",
        "for_candidate_leaves",
        "for_candidate_blocks",
    ),
    "forces": ("sum_forces", "flush", "uncommon_distance", "distance", "point_force"),
    "generalized forces": (
        *(
            "subtract_contact_derivatives",
            "contact_jacobian",
            "subtract_impulses",
            "wrench_in_world",
            "subtract_contact_forces",
        ),
        *("pair_frame", "move_mount"),
    ),
    "dynamics": ("inverse_dynamics", "free_body", "subtract_joint_forces", "actuator_pull"),
    "kinematics": (
        *("forward_", "integrate_to_trial_state", "integrate", "quaternion"),
        *("axis_rotation", "right_jacobian", "position_by", "sincos"),
    ),
    "solver": ("factorize", "invert", "solve", "newton", "evaluate", "relative"),
}


def run(name: str, steps: int) -> float:
    """Some steps from the start of the scene's motion, `HOLD` a call [s per step]."""
    scene = load_scene(name, friction="viscous")
    sim, moves = Simulator(scene, threads=1), reference_motion(scene)
    sim.q[:] = moves.q0
    controls = moves.step_controls(scene.step)[:steps]
    start = time.process_time()
    for u in controls[HOLD - 1 :: HOLD]:
        sim.step(u, HOLD)
    sim.check()
    return (time.process_time() - start) / len(controls)


def count(name: str) -> dict[str, float]:
    """Instructions per step by group."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind.out"
        valgrind = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
        inside = ["--collect-atstart=no", "--toggle-collect=gelflow::Batch<double>::step*"]
        program = [sys.executable, __file__, "--run", name]
        subprocess.run([*valgrind, *inside, *program], check=True, capture_output=True)
        text = subprocess.run(
            ["callgrind_annotate", "--threshold=100", "--auto=no", out], check=True, capture_output=True, text=True
        ).stdout
    found = dict.fromkeys([*GROUPS, "other"], 0.0)
    for instructions, what in re.findall(r"^ *([\d,]+) \([ \d.]+%\)  (?!PROGRAM)(.*)$", text, re.MULTILINE):
        function = what.split(":", 1)[-1].split("(")[0]
        group = next((g for g, names in GROUPS.items() if any(n in function for n in names)), "other")
        found[group] += int(instructions.replace(",", "")) / STEPS
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Where the instructions of a step go.")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "profile.json")
    args = parser.parse_args()
    if args.run:
        run(args.run, STEPS)
        return 0
    if shutil.which("valgrind") is None:
        print("valgrind is needed: apt install valgrind, or the like", file=sys.stderr)
        return 2
    found = {}
    for name in track(SCENES, "scenes", console=Console(stderr=True)):
        found[name] = {"instructions": count(name), "us": 1e6 * min(run(name, STEPS) for _ in range(50))}
    table = Table(title="Instructions per step, % by what they are for (viscous friction)", title_justify="left")
    for heading in ("", *SCENES):
        table.add_column(heading, justify="right" if heading else "left")
    for group in [*GROUPS, "other"]:
        shares = [f["instructions"][group] / sum(f["instructions"].values()) for f in found.values()]
        table.add_row(group, *(f"{100 * share:.0f}" for share in shares))
    table.add_section()
    table.add_row("instructions", *(f"{sum(f['instructions'].values()):.0f}" for f in found.values()))
    table.add_row("µs, with the call", *(f"{f['us']:.1f}" for f in found.values()))
    Console(width=80).print(table)
    record = {"format": 1, "processor": processor(), "versions": versions(), "scenes": found}
    args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
