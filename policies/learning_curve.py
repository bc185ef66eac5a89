"""The learning curve of a training run, as a CSV table and as a picture."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gelflow.policies.evaluation import EvaluationResult


@dataclass(frozen=True)
class LearningCurvePoint:
    """One point of the learning curve."""

    attempts: int
    minutes: float
    reward: float  # mean over the attempts since the last point; nan at an evaluation
    success: float  # success rate of the latest training episodes; nan before the first one ends
    spread: float  # standard deviation of the actions
    evaluation: EvaluationResult | None = None


COLUMNS = ("attempts", "minutes", "reward", "success", "spread", "evaluated success", "evaluated attempts")


def write_table(path: Path, points: Sequence[LearningCurvePoint]) -> None:
    """Writes the points as CSV with a header line; only evaluations fill the last two columns."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for p in points:
            tail = [f"{p.evaluation.success:.4f}", f"{p.evaluation.attempts:.3f}"] if p.evaluation else ["", ""]
            numbers = [f"{value:.4f}" for value in (p.minutes, p.reward, p.success, p.spread)]
            writer.writerow([p.attempts, *numbers, *tail])


def draw(path: Path, points: Sequence[LearningCurvePoint]) -> None:
    """Draws success rate and reward over attempts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # imported on use: slow
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True)
    updates = [p for p in points if p.evaluation is None]
    evaluated = [(p.attempts, p.evaluation) for p in points if p.evaluation is not None]
    x = np.array([p.attempts for p in updates]) / 1000
    top.plot(x, [100 * p.success for p in updates], color="0.55", label="training, with exploration")
    x_evaluated = [attempts / 1000 for attempts, _ in evaluated]
    low, high = np.array([e.confidence_interval() for _, e in evaluated]).reshape(-1, 2).T * 100
    top.plot(x_evaluated, [100 * e.success for _, e in evaluated], "o-", color="#0072b2", label="evaluation, 95 %")
    top.fill_between(x_evaluated, low, high, color="#0072b2", alpha=0.2, linewidth=0)
    top.set(ylabel="parts inserted [%]", ylim=(0, 100), title="Insertion policy, simulation")
    top.legend(loc="lower right")
    bottom.plot(x, [p.reward for p in updates], color="#d55e00")
    bottom.set(xlabel="attempts [thousands]", ylabel="mean reward per attempt [-]")
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
