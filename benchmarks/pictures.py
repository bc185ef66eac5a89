"""Redraw the pictures of the measurements in docs/pictures from benchmarks/results; measures nothing."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import script

from gelflow.perception.benchmark import curves
from gelflow.policies.reproduction import picture as reproduction_picture
from gelflow.sim.benchmark.speed import scaling_picture
from gelflow.sim.benchmark.tradeoff import picture as tradeoff_picture
from gelflow.sim.benchmark.tradeoff.run import Errors
from gelflow.sim.benchmark.tradeoff.sweep import Measurement, Setting, Tradeoff
from gelflow.sim.scene import scene_names
from gelflow.sim.validation.studies import convergence, convergence_picture, mesh_distance_picture
from gelflow.sim.validation.studies.mesh_distance import Result
from gelflow.sim.validation.studies.schemes import Scheme


def draw_scaling(record: dict[str, Any], file: Path) -> None:
    scaling_picture.draw(record["scaling"]["results"], file)


def draw_tracking(record: dict[str, Any], file: Path) -> None:
    curves.draw(record["tracking_curves"]["results"], file)


def draw_mesh_distance(record: dict[str, Any], file: Path) -> None:
    mesh_distance_picture.draw([Result(**result) for result in record["results"]], file)


def draw_convergence(record: dict[str, Any], file: Path) -> None:
    scenes = []
    for entry in record["convergence"]:
        fields = {name: value for name, value in entry.items() if name != "slopes"}
        runs = [convergence.Errors(**run) for run in entry["runs"]]
        scenes.append(convergence.Convergence(**{**fields, "runs": runs}))
    schemes = {title: [Scheme(**scheme) for scheme in group] for title, group in record["schemes"].items()}
    convergence_picture.draw(scenes, [Scheme(**scheme) for scheme in record["ball"]], schemes, file)


def draw_tradeoff(record: dict[str, Any], file: Path) -> None:
    measurements = tuple(
        Measurement(**{**entry, "setting": Setting(**entry["setting"]), "errors": Errors(**entry["errors"])})
        for entry in record["measurements"]
    )
    changes = {name: Errors(**change) for name, change in record["changes"].items()}
    fields = {name: record[name] for name in ("scene", "failed", "reference_step", "repeats")}
    tradeoff_picture.draw(Tradeoff(measurements=measurements, changes=changes, **fields), file)


def draw_reproduction(record: dict[str, Any], file: Path) -> None:
    reproduction_picture.draw(record, file)


# picture → record in benchmarks/results, drawing function
PICTURES: dict[str, tuple[str, Callable[[dict[str, Any], Path], None]]] = {
    "scaling": ("speed", draw_scaling),
    "tracking": ("tracking", draw_tracking),
    "mesh_distance": ("mesh_distance", draw_mesh_distance),
    "convergence": ("convergence", draw_convergence),
    "reproduce_grasp": ("reproduce_grasp", draw_reproduction),
    "reproduce_cap": ("reproduce_cap", draw_reproduction),
    "reproduce_pushing": ("reproduce_pushing", draw_reproduction),
    "reproduce_insertion": ("reproduce_insertion", draw_reproduction),
    **{f"tradeoff_{scene}": (f"tradeoff_{scene}", draw_tradeoff) for scene in scene_names()},
}


def main() -> int:
    parser = argparse.ArgumentParser(description="Redraw pictures from the records in benchmarks/results.")
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], metavar="PICTURE", help="default: all")
    parser.add_argument("--out", type=Path, default=script.PICTURES, metavar="FOLDER", help="folder (%(default)s)")
    args = parser.parse_args()
    for name in args.names or PICTURES:
        source, draw = PICTURES[name]
        record = json.loads((script.RESULTS / f"{source}.json").read_text("utf-8"))
        draw(record, args.out / f"{name}.png")
        print(args.out / f"{name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
