"""Convergence of whole scenes with the time step, and cost of other implicit schemes.

See `gelflow.sim.validation.studies.convergence`. Exit status: 0 when every slope over the finest steps is at least 0.9,
1 when not.
"""

import os
import sys
from dataclasses import asdict
from pathlib import Path

import script

from gelflow.sim.validation.studies.convergence import (
    QUANTITIES,
    REQUIRED,
    SETUPS,
    error_table,
    measure,
    scene_schemes,
    scheme_table,
    slope_table,
    slopes_of,
)
from gelflow.sim.validation.studies.convergence_picture import draw
from gelflow.sim.validation.studies.schemes import ball_errors


def main() -> int:
    parser = script.parser(
        "Measure the convergence of whole scenes.", out="convergence.json", quick="three halvings fewer"
    )
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="concurrent runs (%(default)s)")
    parser.add_argument("--picture", type=Path, default=script.PICTURES / "convergence.png", metavar="FILE")
    args = parser.parse_args()
    with script.progress("scenes") as advance:
        found, ends = measure(3 if args.quick else 0, args.threads, advance)
    with script.progress("schemes", 2.0) as advance:
        ball = ball_errors(advance)
        scenes = scene_schemes(found, ends, advance)
    slopes = {q: min(r.slope(q) for r in found) for q in QUANTITIES}
    record = {
        **script.header(),
        "convergence": [asdict(r) | {"slopes": slopes_of(r)} for r in found],
        "ball": [asdict(s) for s in ball],
        "schemes": {title: [asdict(s) for s in schemes] for title, schemes in scenes.items()},
    }
    draw(found, ball, scenes, args.picture)
    script.finish(
        args,
        record,
        *(error_table(*setup, [r for r in found if (r.scene, r.law) == setup]) for setup in SETUPS),
        slope_table(found),
        scheme_table("A ball thrown on a penalty plane: Newton solves for an error", ball),
        *(scheme_table(f"{title}: Newton iterations for an error of q", schemes) for title, schemes in scenes.items()),
        f"Smallest slopes over the finest steps: {', '.join(f'{q} {s:.2f}' for q, s in slopes.items())}; required "
        f"{REQUIRED}, exceptions in docs/reference/accuracy.md",
    )
    return 0 if min(slopes.values()) >= REQUIRED else 1


if __name__ == "__main__":
    sys.exit(script.run(main))
