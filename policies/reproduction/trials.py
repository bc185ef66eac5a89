"""Trials: the training of a variant with one seed, and the evaluation of its policy on episodes of its own.

Checkpoint and evaluation are stored in a folder: a repeated call computes only what is missing, and resumes a training
that was interrupted.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.measurement.machine import processor, versions
from gelflow.policies import recipes
from gelflow.policies.checkpoint import load_network, replace_file
from gelflow.policies.episodes import run_episodes
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.reports.evaluation_report import actors
from gelflow.policies.reproduction.variants import Reproduction, Variant, insertion_of
from gelflow.policies.sweep.curves import read_table, series
from gelflow.session.records import to_plain
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.tasks.task_batch import TaskBatch

EVALUATION = "evaluation.json"
# Seeds of evaluations are far from those of trainings and of their validations (`TrainingRun`), which start at 0 and at
# 1 000 003.
_EVALUATION_SEED = 7_000_003
_INSERTION_PRESET = "fast"  # of the training; evaluations have the settings of the scene

Curve = tuple[NDArray[np.float64], NDArray[np.float64]]  # environment steps, values
Report = Callable[[str, float], None]  # text, and completed part of the present training


@dataclass(frozen=True)
class Effort:
    """How much is trained and evaluated."""

    seeds: tuple[int, ...]
    shorter: int = 1  # trainings have this part of their full length
    max_episodes: int | None = None  # of an evaluation
    envs: int = 64  # parallel environments of evaluations

    def steps(self, steps: int) -> int:
        """Length of a training that has `steps` in full."""
        return max(1, steps // self.shorter)

    def episodes(self, episodes: int) -> int:
        """Episodes of an evaluation that has `episodes` in full."""
        return episodes if self.max_episodes is None else min(self.max_episodes, episodes)


class Trainer:
    """How the policies of a variant are trained, and in which environments they are evaluated."""

    def __init__(self, task: str, variant: Variant, effort: Effort, command: Sequence[str]) -> None:
        self.variant, self.effort, self.command = variant, effort, list(command)
        self._task, self._recipe = task, recipes.recipe_for(task, variant.recipe)

    def train(self, folder: Path, seed: int, report: Report) -> Path:
        """Trains what is missing in `folder`; returns the checkpoint."""
        steps = self.effort.steps(self._recipe.steps)
        run = recipes.training_run(
            self._task,
            folder,
            recipe=self.variant.recipe,
            seed=seed,
            steps=steps,
            command=self.command,
            report=lambda progress: report("training", progress.steps / steps),
            **self._run_options(),
        )
        if not run.is_finished():
            run.train()
        return run.checkpoint

    def _run_options(self) -> dict[str, Any]:
        """Options of `recipes.training_run` that determine the environments."""
        return {"options": self.variant.options}

    def environments(self, variant: Variant) -> TaskBatch:
        """The environments of the evaluation of `variant`."""
        return self._recipe.make_task(self.effort.envs, **{**variant.options, **variant.evaluation})

    def curves(self, folder: Path, measure: str) -> dict[str, Curve]:
        """Environment steps and `measure` ("success" or "reward") of a finished training.

        "validation" is that of the evaluations, "training" that of the episodes with exploration.
        """
        table = read_table(folder / "progress.csv")
        explored = "return" if measure == "reward" else measure  # "reward" is the mean of a step
        return {
            "validation": series(table, "steps", f"evaluated_{measure}"),
            "training": series(table, "steps", explored),
        }

    def minutes(self, folder: Path) -> float:
        """Duration of a finished training."""
        return float(read_table(folder / "progress.csv")["minutes"][-1])


class InsertionTrainer(Trainer):
    """Trainings of the insertion, whose part and misalignment belong to the variant."""

    def _run_options(self) -> dict[str, Any]:
        options = {**self.variant.options, "task": insertion_of(self.variant), "preset": _INSERTION_PRESET}
        return {"options": options, "envs": 32 if self.effort.shorter > 1 else None}

    def environments(self, variant: Variant) -> TaskBatch:
        return make_task("insertion", self.effort.envs, **{**variant.options, "task": insertion_of(variant)})


def trainer_for(task: str, variant: Variant, effort: Effort, command: Sequence[str]) -> Trainer:
    """The trainer of a variant of a task."""
    return (InsertionTrainer if task == "insertion" else Trainer)(task, variant, effort, command)


def run_trial(
    plan: Reproduction,
    variant: Variant,
    seed: int,
    *,
    folder: Path,
    effort: Effort,
    command: Sequence[str],
    report: Report,
) -> dict[str, Any]:
    """Trains and evaluates what is missing of a variant and a seed; returns its rows and learning curves.

    Parameters
    ----------
    folder: of the task; the trial is in VARIANT/seed_N
    command: that repeats the reproduction, stored with the result
    report: called with a text and the completed part of a training

    The rows are those of `gelflow eval`, on the same evaluation episodes.
    """
    trained = plan.variant(variant.trained_as or variant.name)
    trainer = trainer_for(plan.task, trained, effort, command)
    training = folder / folder_name(trained.name) / f"seed_{seed}"
    checkpoint = trainer.train(training, seed, report)
    path = folder / folder_name(variant.name) / f"seed_{seed}" / EVALUATION
    episodes = effort.episodes(plan.episodes)
    identity = {
        "checkpoint": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
        "episodes": episodes,
        "evaluation": {**variant.options, **variant.evaluation},
    }
    of_training = {"curves": trainer.curves(training, plan.curve), "training_minutes": trainer.minutes(training)}
    stored = _read(path)
    if stored is not None and stored["identity"] == json.loads(json.dumps(identity)):
        return stored | of_training
    report("evaluating", 0.0)
    start = time.perf_counter()
    rows = _evaluate(checkpoint, trainer.environments(variant), episodes=episodes, seed=seed)
    values = {
        "format": 1,
        "identity": identity,
        "seed": seed,
        "rows": [row.to_json() for row in rows],
        "evaluation_minutes": (time.perf_counter() - start) / 60,
        "processor": processor(),
        "versions": versions(),
    }
    return _write(path, values) | of_training


def folder_name(variant: str) -> str:
    """Name of the folder of a variant."""
    return "".join(letter if letter.isalnum() else "_" for letter in variant)


def _evaluate(checkpoint: Path, task: TaskBatch, *, episodes: int, seed: int) -> list[EvaluationResult]:
    at = _EVALUATION_SEED + seed
    compared = actors(load_network(checkpoint, task=task.description), task, seed=at)
    return [run_episodes(actor, task, episodes=episodes, seed=at).result(name) for name, actor in compared.items()]


def _read(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (OSError, ValueError) as error:
        raise UsageError(f"{path} is damaged ({type(error).__name__}); delete it to evaluate again") from error


def _write(path: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Writes JSON atomically; returns it as it will be read."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(to_plain(values), indent=1) + "\n"
    replace_file(path, text.encode())
    return dict(json.loads(text))
