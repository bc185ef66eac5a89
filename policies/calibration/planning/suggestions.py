"""Attempts to record next: those whose flow maps have the most information about the parameters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.policies.calibration.model.error_model import DRIFT
from gelflow.policies.calibration.planning.information import Attempts, Known, information, pose_prior, without_pose
from gelflow.policies.calibration.problem import Problem

Array = NDArray[np.float64]

_DEPTH = 0.8e-3  # of a usual descent that contact stops [m]
# Text, offset from the centre of the hole [m, m, rad], and depth beyond the usual one [m].
_CANDIDATES: tuple[tuple[str, tuple[float, float, float], float], ...] = (
    ("one attempt 4 mm to the side along x", (4e-3, 0.0, 0.0), 0.0),
    ("one attempt 4 mm to the side along y", (0.0, 4e-3, 0.0), 0.0),
    ("one attempt with 8° yaw", (0.0, 0.0, np.radians(8)), 0.0),
    ("one attempt 4 mm along x and y with 5° yaw", (4e-3, 4e-3, np.radians(5)), 0.0),
    ("one attempt 4 mm along x, pressed 0.5 mm deeper", (4e-3, 0.0, 0.0), 0.5e-3),
    ("one attempt 4 mm along y, pressed 0.5 mm deeper", (0.0, 4e-3, 0.0), 0.5e-3),
    ("one attempt 4 mm along x and y with 5° yaw, pressed 0.5 mm deeper", (4e-3, 4e-3, np.radians(5)), 0.5e-3),
)


@dataclass(frozen=True)
class Suggestion:
    """One attempt, and how it narrows the intervals."""

    text: str
    pose: tuple[float, float, float]  # of the gripper in the hole frame [m, m, rad]
    depth: float  # [m]
    gain: float  # decrease of the parameters' entropy [nat]
    narrowed: dict[str, float]  # parameter → width of its interval relative to the present one, below 0.9


def suggest(problem: Problem, known: Known | None, count: int = 3) -> list[Suggestion]:
    """The `count` attempts with the highest information, the best first; `known` None: only the priors are known."""
    parameters = len(problem.fitted)
    known = known or Known(np.zeros(parameters), np.eye(parameters), DRIFT)
    present = np.linalg.inv(known.covariance)
    before = np.sqrt(np.diag(known.covariance))
    noise, used = problem.errors.noise, problem.errors.used
    found = []
    for text, pose, deeper in _CANDIDATES:
        depth = _DEPTH + deeper
        try:
            attempt = Attempts(np.zeros(3), np.array([pose]), np.zeros(1), np.array([depth]))
            added = information(problem.readings, known.mean, attempt, noise, used=used, drift=known.drift)[0]
            after = np.linalg.inv(present + without_pose(added, pose_prior(problem.recordings.task)))
        except SimulationError:
            continue
        gain = 0.5 * float(np.linalg.slogdet(known.covariance)[1] - np.linalg.slogdet(after)[1])
        ratio = np.sqrt(np.diag(after)) / before
        narrowed = {p.name: float(r) for p, r in zip(problem.fitted, ratio, strict=True) if r < 0.9}
        found.append(Suggestion(text, pose, depth, gain, narrowed))
    return sorted(found, key=lambda suggestion: -suggestion.gain)[:count]
