"""Inserts parts with the mock robot in worlds that differ from training: through protocols, camera images and tracker.

    python -m benchmarks.training.mock_worlds --parts 10
    python -m benchmarks.training.mock_worlds --worlds "as in training" --parts 100 --out 100_parts.json
    python -m benchmarks.training.mock_worlds --worlds "as in training" --part hexagon --parts 20 --out hexagon.json

The policy is that of the part. A world is changed by the file of `gelflow mock --world`; the lab file holds what a user
of that cell would know. The same command continues a run that was killed; another command starts anew.
"""

import json
import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import script
from rich.table import Table

from gelflow.cli.options import checkpoint_for, part_task
from gelflow.errors import GelflowError
from gelflow.mock_lab.robot_process import mock_robot, true_state
from gelflow.policies.checkpoint import load_policy
from gelflow.real.runner.insertion.attempt import Insertion
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import RunPlan, run_insertions
from gelflow.toml_tables import toml_text

TRAINING = "as in training"
SERIES = 10  # parts

WORLDS: Mapping[str, Mapping[str, Any]] = {
    TRAINING: {},
    "cameras tilted by 8°": {"cameras": {"tilt_deg": [8.0, 0.0]}},
    "lens with 6 % distortion": {"cameras": {"barrel": 0.06}},
    "half the light": {"cameras": {"light": 60.0}},
    "twice the light": {"cameras": {"light": 220.0}},
    "pale dots": {"cameras": {"contrast": 0.3}},
    "out of focus": {"cameras": {"blur_px": 2.5}},
    "noisy cameras, 4 grey levels": {"cameras": {"noise": 4.0}},
    "15 images per second": {"cameras": {"rate": 15.0}},
    "grid of 9 × 7 markers": {"markers": {"rows": 9, "cols": 7, "pitch_mm": 2.8}},
    "uneven print, 0.1 mm": {"markers": {"jitter_mm": 0.1}},
    "5 % of the markers missing": {"markers": {"missing": 0.05}},
    "hole taught 3 mm aside, 5° turned": {"taught_error": {"x": 0.003, "yaw_deg": 5.0}},
    "hole taught 1 mm too high": {"taught_error": {"z": 0.001}},
    "hole taught 1 mm too low": {"taught_error": {"z": -0.001}},
    "gels five times as stiff": {"gels": {"left": 5.0, "right": 5.0}},
    "gels a fifth as stiff": {"gels": {"left": 0.2, "right": 0.2}},
    "low friction": {"friction": {"pads": 0.5, "hole": 0.3}},
    "creep, crosstalk, unequal gains": {"sensor": {"creep": 0.3, "crosstalk": 0.2, "gain_spread": 0.1}},
    "soft arm, 10 N/mm": {"arm": {"stiffness": 1e4}},
    "most of these at once, milder": {
        "cameras": {"tilt_deg": [4.0, 0.0], "barrel": 0.03, "light": 90.0, "contrast": 0.45, "noise": 2.5},
        "markers": {"jitter_mm": 0.05, "missing": 0.02},
        "taught_error": {"x": 0.001, "yaw_deg": 2.0, "z": 0.0005},
        "gels": {"left": 0.5, "right": 0.5},
        "friction": {"pads": 0.8, "hole": 0.5},
        "sensor": {"creep": 0.3, "crosstalk": 0.2, "gain_spread": 0.1},
        "arm": {"stiffness": 1e4},
    },
}


def main() -> int:
    parser = script.parser(__doc__ or "", out="mock_worlds.json", quick="one part in each of two worlds", seed=0)
    parser.add_argument("--parts", type=int, default=10, metavar="N", help="in each world (default 10)")
    parser.add_argument(
        "--worlds", nargs="+", choices=WORLDS, default=list(WORLDS), metavar="NAME", help="default: all"
    )
    parser.add_argument("--part", help="part to insert (default: the cuboid)")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="policy (default: that of the part)")
    parser.add_argument("--factor", type=float, default=5.0, metavar="X", help="robot time over wall time (default 5)")
    args = parser.parse_args()
    names, parts = (args.worlds[:2], 1) if args.quick else (args.worlds, args.parts)
    settings = {"part": args.part or "cuboid", "checkpoint": args.checkpoint and str(args.checkpoint)}
    settings |= {"parts": parts, "seed": args.seed, "factor": args.factor}
    unfinished = args.out.with_suffix(".part")
    stored = json.loads(unfinished.read_text()) if unfinished.is_file() else {}
    rows: dict[str, Any] = stored["worlds"] if stored.get("settings") == settings else {}
    with script.progress("worlds", len(names)) as advance:
        for name in names:
            if name not in rows:
                rows[name] = inserted(WORLDS[name], parts, args)
                script.save(unfinished, {"settings": settings, "worlds": rows})
            advance(1)
    table = Table("world", "inserted", "robot and truth agree", "corrections", "stops")
    for name, row in rows.items():
        length = "" if row["corrections"] is None else f"{row['corrections']:.2f}"
        table.add_row(name, f"{row['inserted']} of {row['parts']}", str(row["agree"]), length, "; ".join(row["stops"]))
    script.finish(args, script.header() | settings | {"worlds": rows}, table)
    unfinished.unlink(missing_ok=True)
    return 0


def inserted(world: Mapping[str, Any], parts: int, args: Any) -> dict[str, Any]:
    """Counts of one world: parts inserted in truth, and parts whose outcome the robot measured correctly.

    Each series of up to `SERIES` parts has a mock robot of its own: a stop, which a busy computer may cause, ends one,
    and a further one inserts the other parts. Twice the planned number of series end the world.
    """
    rows: list[dict[str, Any]] = []
    stops, begun = [], time.monotonic()
    for number in range(2 * math.ceil(parts / SERIES)):
        found, stop = series(world, min(SERIES, parts - len(rows)), args, args.seed + 1000 * number)
        rows += found
        stops += [stop] if stop else []
        if len(rows) == parts:
            break
    tries = [row["attempts"] - 1 for row in rows if row["truth"]]
    return {
        "world": world,
        "parts": len(rows),
        "inserted": sum(row["truth"] for row in rows),
        "agree": sum(row["robot"] == row["truth"] for row in rows),
        "corrections": sum(tries) / len(tries) if tries else None,
        "stops": stops,
        "minutes": round((time.monotonic() - begun) / 60, 2),
        "insertions": rows,
    }


def series(world: Mapping[str, Any], parts: int, args: Any, seed: int) -> tuple[list[dict[str, Any]], str]:
    """Insertions of one mock robot, and the reason why they ended early."""
    task = part_task(args.part)
    checkpoint = checkpoint_for(task, args.checkpoint)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "world.toml"
        file.write_text(toml_text({"format": 1, **world}), encoding="utf-8")
        with mock_robot(factor=args.factor, seed=seed, world=file, part=args.part) as (lab_file, truth_url):

            def seen(result: Insertion) -> None:
                truth = true_state(truth_url)["parts"][result.number]
                row = {"robot": result.inserted, "truth": bool(truth["inserted"]), "attempts": len(result.attempts)}
                rows.append(row | {"outcome": result.outcome, "misalignment": truth["misalignment"]})

            plan = RunPlan(
                lab=load_lab(lab_file),
                policy=load_policy(checkpoint, task=task),
                task=task,
                session=Path(name) / "session.mcap",
                checkpoint=checkpoint,
                insertions=parts,
                on_insertion=seen,
            )
            try:
                run_insertions(plan)
            except GelflowError as stop:
                return rows, str(stop)
    return rows, ""


if __name__ == "__main__":
    raise SystemExit(script.run(main))
