"""Accuracy and speed of all settings and presets of the scenes: `python benchmarks/tradeoff.py [SCENE …]`.

For each scene the measurements (`gelflow.sim.benchmark.tradeoff`) are written to benchmarks/results/tradeoff_SCENE.json
and docs/pictures/tradeoff_SCENE.png, and the error bounds of its presets to the table of docs/guide/presets.md. Times
require an idle machine; errors do not depend on the machine.
"""

import argparse
import sys
from dataclasses import asdict

import script

from gelflow.cli.commands.tradeoff import short, table
from gelflow.cli.options import add_json, add_out, add_quick, add_seed
from gelflow.measurement.machine import processor
from gelflow.sim.benchmark.tradeoff.page import preset_rows, update_page
from gelflow.sim.benchmark.tradeoff.picture import draw
from gelflow.sim.benchmark.tradeoff.preset_bounds import bounds, preset_errors
from gelflow.sim.benchmark.tradeoff.sweep import measure
from gelflow.sim.scene import scene_names

PAGE = script.ROOT / "docs" / "guide" / "presets.md"
DESCRIPTION = "Measure accuracy and speed of scene settings. Quick run: 3 repeats, 2 samples, no page or picture."
HALVINGS = 8  # of a frame, for the references of the sampled physics


def main() -> int:
    parser = argparse.ArgumentParser(description=DESCRIPTION)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="default: all included scenes")
    add_out(parser, "folder of tradeoff_SCENE.json", default=script.RESULTS, folder=True)
    parser.add_argument("--repeats", type=int, default=21, metavar="N", help="timed runs of each setting (%(default)s)")
    parser.add_argument("--draws", type=int, default=48, metavar="N", help="samples of the physics (%(default)s)")
    add_quick(parser)
    add_seed(parser)
    add_json(parser)
    args = parser.parse_args()
    for scene in args.scenes or scene_names():
        _measure_scene(scene, args)
    return 0


def _measure_scene(scene: str, args: argparse.Namespace) -> None:
    """Measure one scene; write its record, picture and rows of the page."""
    draws, repeats = (2, 3) if args.quick else (args.draws, args.repeats)
    with script.progress_share(f"{scene}: presets") as update:
        seeds = range(args.seed, args.seed + draws)
        errors = preset_errors(scene, seeds, halvings=HALVINGS, done=update)
    with script.progress_share(f"{scene}: settings") as update:
        tradeoff = measure(scene, quick=args.quick, repeats=repeats, done=lambda _, share: update(share))
    limits = bounds(errors, draws)
    if not args.quick:
        update_page(PAGE, {scene: preset_rows(tradeoff, limits)})
        draw(tradeoff, script.PICTURES / f"tradeoff_{scene}.png")
    record = {
        **script.header(),
        **asdict(tradeoff),
        "bounds": {name: asdict(limit) for name, limit in limits.items()},
    }
    summaries = [
        f"{name}: largest error of the markers {short(100 * limit.worst.markers)} % in {draws} samples"
        for name, limit in limits.items()
    ]
    file = args.out / f"tradeoff_{scene}.json"
    script.write(file, record, args.json, table(tradeoff, f"{scene}, one thread of {processor()}"), *summaries)


if __name__ == "__main__":
    sys.exit(script.run(main))
