"""Instructions of a step by purpose, counted by valgrind's callgrind on the scenes' reference motions.

Counts do not depend on the load of the machine; the time per step does.
"""

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from gelflow.sim.benchmark.speed.timed_run import HOLD
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import SCENES, reference_motion

STEPS = 100
# Groups of functions by parts of their names, in order of precedence. Small functions are inlined into their callers.
GROUPS = {
    "broad phase": (
        "find_candidate_points",
        "find_neighbors",
        "select_candidates",
        "gather_point_data",
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
    "dynamics": ("inverse_dynamics", "free_body", "subtract_joint_forces", "actuator_force"),
    "kinematics": (
        *("forward_", "integrate_to_trial_state", "integrate", "quaternion"),
        *("axis_rotation", "right_jacobian", "position_by", "sincos"),
    ),
    "solver": ("factorize", "invert", "solve", "newton", "evaluate", "relative_norm"),
}


@dataclass(frozen=True)
class StepProfile:
    """Cost of a step of one scene."""

    instructions: Mapping[str, float]  # per step, by group
    us: float  # time per step, Python call included [µs]


def run_motion(name: str, steps: int = STEPS) -> float:
    """Take the first steps of a scene's reference motion, `HOLD` per call; returns processor time per step [s]."""
    scene = load_scene(name, friction="viscous")
    sim, motion = Simulator(scene, threads=1), reference_motion(scene)
    sim.q[:] = motion.q0
    controls = motion.step_controls(scene.step)[:steps]
    start = time.process_time()
    for u in controls[HOLD - 1 :: HOLD]:
        sim.step(u, HOLD)
    sim.check()
    return (time.process_time() - start) / len(controls)


def count_instructions(name: str) -> dict[str, float]:
    """Instructions per step of a scene's motion, by group. Raises CalledProcessError when valgrind fails."""
    program = f"from gelflow.sim.benchmark.profile import run_motion; run_motion({name!r})"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind.out"
        valgrind = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
        steps_only = ["--collect-atstart=no", "--toggle-collect=gelflow::Batch<double>::step*"]
        subprocess.run([*valgrind, *steps_only, sys.executable, "-c", program], check=True, capture_output=True)
        text = subprocess.run(
            ["callgrind_annotate", "--threshold=100", "--auto=no", out], check=True, capture_output=True, text=True
        ).stdout
    counts = dict.fromkeys([*GROUPS, "other"], 0.0)
    for instructions, location in re.findall(r"^ *([\d,]+) \([ \d.]+%\)  (?!PROGRAM)(.*)$", text, re.MULTILINE):
        function = location.split(":", 1)[-1].split("(")[0]
        group = next((g for g, parts in GROUPS.items() if any(part in function for part in parts)), "other")
        counts[group] += int(instructions.replace(",", "")) / STEPS
    return counts


def measure(progress: Callable[[float], None], *, quick: bool = False) -> dict[str, StepProfile]:
    """Profiles by scene; with `quick` of the first scene only. `progress` is advanced by 1 after each."""
    profiles = {}
    for name in SCENES[:1] if quick else SCENES:
        profiles[name] = StepProfile(count_instructions(name), 1e6 * min(run_motion(name) for _ in range(50)))
        progress(1)
    return profiles


def table(profiles: Mapping[str, StepProfile]) -> Table:
    """Shares of the groups, instructions and time per step."""
    out = Table(title="Instructions per step by purpose, % (viscous friction)", title_justify="left")
    for heading in ("", *profiles):
        out.add_column(heading, justify="right" if heading else "left")
    totals = [sum(profile.instructions.values()) for profile in profiles.values()]
    for group in [*GROUPS, "other"]:
        shares = (p.instructions[group] / total for p, total in zip(profiles.values(), totals, strict=True))
        out.add_row(group, *(f"{100 * share:.0f}" for share in shares))
    out.add_section()
    out.add_row("instructions", *(f"{total:.0f}" for total in totals))
    out.add_row("µs, with the call", *(f"{profile.us:.1f}" for profile in profiles.values()))
    return out
