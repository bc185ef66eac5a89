"""Trains the insertion under each shear law and preset, randomization, or observation, and evaluates under all of them.

    python -m benchmarks.training.insertion_matrix settings
    python -m benchmarks.training.insertion_matrix randomizations
    python -m benchmarks.training.insertion_matrix observations

The task has the descents of Xu et al. (CoRL 2022). Every training has the same number of attempts. Results are stored
in --folder as they are found: a second call with the same folder computes what is missing. Writes a record and a
picture.
"""

import argparse
import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import script
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from gelflow.figures import save
from gelflow.policies.checkpoint import load_network
from gelflow.policies.episodes import evaluate_task
from gelflow.policies.recipes import training_run
from gelflow.policies.reproduction.trials import folder_name
from gelflow.sim.tasks.insertion_randomization import RANDOMIZATIONS
from gelflow.sim.tasks.registry import make_task
from gelflow.task import PUBLISHED_INSERTION

EVALUATION_SEED = 7_000_003  # far from the seeds of trainings and their validations
ENVS = 128
_TASK = {"task": PUBLISHED_INSERTION}


class Row(NamedTuple):
    """A setting in which policies are trained, or evaluated."""

    name: str
    options: Mapping[str, Any]  # of the environments


def settings(presets: tuple[str, ...]) -> list[Row]:
    """Each shear law with each preset; "scene" stands for the values of the scene file."""
    return [
        Row(f"{law}, {preset}", {**_TASK, "friction": law, "preset": None if preset == "scene" else preset})
        for law in ("elastic", "viscous")
        for preset in presets
    ]


def randomizations() -> list[Row]:
    """Each table of physical parameters; the nominal one has a single value of each."""
    return [Row(name, {**_TASK, "randomization": name}) for name in RANDOMIZATIONS]


def observations() -> list[Row]:
    """Each observation of the last frame, and of five frames where they differ."""
    five = tuple(depth * 1e-4 for depth in (3, 5, 7, 9, 11))
    rows = []
    last = PUBLISHED_INSERTION.frame_depths
    for observation in ("flow map", "forces", "nothing"):
        for frames in (last, five) if observation != "nothing" else (last,):
            task = dataclasses.replace(PUBLISHED_INSERTION, observation=observation, frame_depths=frames)
            rows.append(Row(f"{observation}, {len(frames)} frame{'s' * (len(frames) > 1)}", {"task": task}))
    return rows


def fast(rows: list[Row]) -> list[Row]:
    """`rows` with the preset "fast"."""
    return [row._replace(options={**row.options, "preset": "fast"}) for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("matrix", choices=("settings", "randomizations", "observations"))
    parser.add_argument("--attempts", type=int, default=100_000, help="of each training (%(default)s)")
    parser.add_argument("--episodes", type=int, default=512, help="of each evaluation (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    parser.add_argument("--folder", type=Path, help="of the trainings (default runs/insertion_MATRIX)")
    parser.add_argument("--out", type=Path, help="record (default benchmarks/results/insertion_MATRIX.json)")
    parser.add_argument("--picture", type=Path, help="default docs/pictures/insertion_MATRIX.png")
    args = parser.parse_args()
    name = f"insertion_{args.matrix}"
    folder = args.folder or Path("runs") / name
    if args.matrix == "settings":
        trained, evaluated = (
            settings(("fast", "scene", "balanced")),
            settings(("fast", "scene", "balanced", "accurate")),
        )
    elif args.matrix == "randomizations":
        trained, evaluated = fast(randomizations()), randomizations()
    else:
        trained = fast(observations())
        evaluated = []  # each under its own observation, with the values of the scene file
    cells: dict[str, dict[str, Any]] = {}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("", total=len(trained))
        for row in trained:
            progress.update(bar, description=row.name)
            columns = evaluated or [Row("its own observation", {**row.options, "preset": None})]
            cells[row.name] = train_and_evaluate(row, columns, folder, args)
            progress.advance(bar)
    settings_of_run = {"attempts": args.attempts, "episodes": args.episodes, "seed": args.seed}
    script.save(args.out or script.RESULTS / f"{name}.json", script.header() | settings_of_run | {"success": cells})
    draw(cells, args.picture or script.PICTURES / f"{name}.png")
    columns = list(next(iter(cells.values())))
    table = Table("trained", *columns, title="inserted [%]")
    for trained_name, values in cells.items():
        table.add_row(trained_name, *(f"{100 * values[column]['success']:.1f}" for column in columns))
    Console(width=120, markup=False).print(table)


def train_and_evaluate(row: Row, columns: list[Row], folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Success and corrections of the policy that is trained in `row`, by the names of the columns."""
    place = folder / folder_name(row.name)
    options = {name: value for name, value in row.options.items() if value is not None}
    run = training_run("insertion", place, seed=args.seed, steps=args.attempts, options=options)
    if not run.is_finished():
        run.train()
    stored = place / "evaluations.json"
    known = json.loads(stored.read_text()) if stored.exists() else {}
    for column in columns:
        if known.get(column.name, {}).get("episodes") == args.episodes:
            continue
        batch = make_task("insertion", ENVS, **column.options)
        actor = load_network(run.checkpoint, task=batch.description).batch_policy(ENVS)
        result = evaluate_task("policy", actor, batch, episodes=args.episodes, seed=EVALUATION_SEED + args.seed)
        known[column.name] = {
            "episodes": args.episodes, "success": result.success, "success_95": list(result.confidence_interval()),
            "corrections": result.length,
        }  # fmt: skip
        stored.write_text(json.dumps(known, indent=1) + "\n")
    return {column.name: known[column.name] for column in columns}


def draw(cells: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw the success of every cell as a number and as a colour, one colour map from the worst cell to 100 %."""
    from matplotlib.figure import Figure

    columns = list(next(iter(cells.values())))
    success = [[100 * values[column]["success"] for column in columns] for values in cells.values()]
    worst = min(min(row) for row in success)
    figure = Figure(figsize=(2.6 + 0.95 * len(columns), 1.6 + 0.55 * len(cells)), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(success, cmap="cividis", vmin=worst, vmax=100, aspect="auto")
    for i, row in enumerate(success):
        for j, value in enumerate(row):
            dark = value < (worst + 100) / 2
            axes.text(j, i, f"{value:.1f}", ha="center", va="center", color="white" if dark else "black")
    axes.set_yticks(range(len(cells)), list(cells))
    axes.set_xticks(range(len(columns)), [column.replace(", ", "\n") for column in columns])
    axes.xaxis.tick_top()
    axes.xaxis.set_label_position("top")
    axes.set(ylabel="trained under", xlabel="evaluated under")
    figure.colorbar(image, label="inserted [%]")
    save(figure, path)


if __name__ == "__main__":
    main()
