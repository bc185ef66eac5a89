"""The learning curve of a training run, as a CSV table and as a picture."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gelflow.errors import UsageError
from gelflow.figures import BLUE, VERMILION, save
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.training.folder import create_folder

# Files in the folder of a training of the insertion.
CHECKPOINT, CURVE, PICTURE = "insertion.safetensors", "learning_curve.csv", "learning_curve.png"


@dataclass(frozen=True)
class LearningCurvePoint:
    """One point of the learning curve."""

    attempts: int
    minutes: float
    reward: float  # mean over the attempts since the last point; nan at an evaluation
    success: float  # success rate of the latest training episodes; nan before the first one ends
    spread: float  # standard deviation of the actions
    evaluation: EvaluationResult | None = None


@dataclass(frozen=True)
class TrainingResult:
    """The files of a training with stable-baselines3, its best validation result, and the time it took."""

    checkpoint: Path
    best: EvaluationResult
    curve: Path
    picture: Path
    seconds: Mapping[str, float] = field(default_factory=dict)  # "simulation", "learning"; empty if not measured


def create_training_folder(out: Path) -> None:
    """Creates the folder of a new training. Raises UsageError if it contains a trained policy or cannot be written."""
    if (out / CHECKPOINT).exists():  # never overwrite the result of another run
        raise UsageError(f"{out} already holds a trained policy; choose another folder or delete it")
    create_folder(out)


COLUMNS = ("attempts", "minutes", "reward", "success", "spread", "evaluated success", "evaluated corrections")


def write_table(path: Path, points: Sequence[LearningCurvePoint]) -> None:
    """Writes the points as CSV with a header line; only evaluations fill the last two columns."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for p in points:
            tail = [f"{p.evaluation.success:.4f}", f"{p.evaluation.length:.3f}"] if p.evaluation else ["", ""]
            numbers = [f"{value:.4f}" for value in (p.minutes, p.reward, p.success, p.spread)]
            writer.writerow([p.attempts, *numbers, *tail])


def draw(path: Path, points: Sequence[LearningCurvePoint]) -> None:
    """Draws success rate and reward over attempts."""
    from matplotlib.figure import Figure  # imported on use: slow

    figure = Figure(figsize=(8, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    updates = [p for p in points if p.evaluation is None]
    evaluated = [(p.attempts / 1000, p.evaluation) for p in points if p.evaluation is not None]
    x = [p.attempts / 1000 for p in updates]
    top.plot(x, [100 * p.success for p in updates], "--", color="0.45", label="training, with exploration")
    x_evaluated = [attempts for attempts, _ in evaluated]
    low, high = np.array([e.confidence_interval() for _, e in evaluated]).reshape(-1, 2).T * 100
    label = "evaluation, 95 % confidence interval"
    top.plot(x_evaluated, [100 * e.success for _, e in evaluated], "o-", color=BLUE, label=label)
    top.fill_between(x_evaluated, low, high, color=BLUE, alpha=0.2, linewidth=0)
    title = "Insertion policy in simulation"
    if evaluated:
        attempts, last = evaluated[-1]
        title += f": {100 * last.success:.0f} % of the parts inserted after {attempts:.0f} thousand attempts"
    top.set(ylabel="parts inserted [%]", ylim=(0, 100), title=title)
    top.legend(loc="lower right")
    bottom.plot(x, [p.reward for p in updates], color=VERMILION)
    bottom.set(xlabel="attempts [thousands]", ylabel="mean reward per attempt [-]")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    save(figure, path, dpi=120)
