"""Everything that docs/guide/tradeoff.md shows: `python benchmarks/tradeoff.py [SCENE …]`.

For each scene: all settings (`gelflow.sim.benchmark.tradeoff.sweep`) to benchmarks/results/tradeoff_SCENE.json and
docs/pictures/tradeoff_SCENE.png, and the errors of its presets over draws of its physics, whose bounds go into the
table of docs/guide/tradeoff.md. Errors do not depend on the machine; run it where nothing else runs, for the times.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from gelflow.cli.commands.tradeoff import plain, short, table
from gelflow.errors import GelflowError
from gelflow.measurement.machine import processor
from gelflow.sim.benchmark import versions
from gelflow.sim.benchmark.tradeoff.picture import draw
from gelflow.sim.benchmark.tradeoff.preset_bounds import SCENE_DEFAULT, Bounds, bounds, preset_errors
from gelflow.sim.benchmark.tradeoff.run import Errors
from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff, measure
from gelflow.sim.scene import load_scene, scene_names

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "guide" / "tradeoff.md"
DRAWS = 48
HALVINGS = 8  # of a frame, for the references of the draws
BEGIN, END = "<!-- written by benchmarks/tradeoff.py -->", "<!-- end -->"


def row(scene: str, name: str, bound: Errors, speed: float) -> str:
    """One line of the page's table. Units as in its heading."""
    way = load_scene(scene, preset=None if name == SCENE_DEFAULT else name)
    how = f"{way.integrator.upper()}, {1e3 * way.step:g} ms, {way.tolerance:.0e}".replace("e-0", "e-")
    figures = (1e3 * bound.position, 1e3 * bound.rotation, 100 * bound.markers, bound.flow)
    cells = [scene, name, how, f"{speed:.0f}", *(f"{x:.3g}" for x in figures), f"{bound.cosine:.4f}"]
    return f"| {' | '.join([*cells, f'{100 * bound.gradient:.3g}'])} |"


def speeds(found: Tradeoff) -> dict[str, float]:
    """Times faster than real time, by preset."""
    result = {name: measurement.speed for measurement in found.measurements for name in measurement.presets}
    return result | {
        SCENE_DEFAULT: next(
            measurement.speed for measurement in found.measurements if measurement.setting.group == "default"
        )
    }


def write_page(rows: dict[str, list[str]]) -> None:
    """Replace the rows of these scenes in the page's table."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    inside, after = rest.split(END)
    lines = inside.strip().splitlines()
    kept = {name: [line for line in lines[2:] if line.startswith(f"| {name} |")] for name in scene_names()}
    body = [line for name in scene_names() for line in rows.get(name, kept[name])]
    PAGE.write_text(f"{before}{BEGIN}\n{chr(10).join([*lines[:2], *body])}\n{END}{after}", encoding="utf-8")


def record(found: Tradeoff, limits: dict[str, Bounds], machine: str) -> dict[str, Any]:
    return {
        "format": 1,
        "processor": machine,
        "versions": versions(),
        **plain(found),
        "bounds": {name: asdict(limit) for name, limit in limits.items()},
    }


def one(scene: str, draws: int, repeats: int, progress: Progress) -> tuple[Tradeoff, dict[str, Bounds]]:
    """Everything about one scene."""
    bar = progress.add_task(scene, total=2.0)
    worst = preset_errors(
        scene,
        range(draws),
        halvings=HALVINGS,
        done=lambda share: progress.update(bar, description=f"{scene}: presets", completed=share),
    )
    found = measure(
        scene,
        repeats=repeats,
        done=lambda what, share: progress.update(bar, description=f"{scene}: {what}", completed=1 + share),
    )
    return found, bounds(worst, draws)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure cost against accuracy; writes docs/guide/tradeoff.md.")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="all that come along, when none is named")
    parser.add_argument("--repeats", type=int, default=21, metavar="N", help="timed runs of each setting (%(default)s)")
    parser.add_argument("--draws", type=int, default=DRAWS, metavar="N", help="of the physics (%(default)s)")
    args = parser.parse_args()
    console, machine = Console(width=80, highlight=False), processor()
    try:
        for scene in args.scenes or scene_names():
            with Progress(console=Console(stderr=True, width=80), transient=True) as progress:
                found, limits = one(scene, args.draws, args.repeats, progress)
            fast = speeds(found)
            write_page({scene: [row(scene, name, limit.bound, fast[name]) for name, limit in limits.items()]})
            text = json.dumps(record(found, limits, machine), indent=1, allow_nan=False)
            (ROOT / "benchmarks" / "results" / f"tradeoff_{scene}.json").write_text(text + "\n", encoding="utf-8")
            draw(found, ROOT / "docs" / "pictures" / f"tradeoff_{scene}.png")
            console.print(table(found, f"{scene}, one thread of {machine}"))
            for name, limit in limits.items():
                console.print(f"{name}: markers at most {short(100 * limit.worst.markers)} % off in {args.draws} draws")
    except GelflowError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
