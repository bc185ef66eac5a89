"""Plans of attempts with the highest expected information about what a calibration leaves open.

The hole's pose and the parameters are not known when a plan is made. The information of an attempt is therefore
averaged over scenarios: parameters from the prior, or from a fit with its uncertainty, and misalignments from the task.
An attempt that ends without contact in a scenario, such as one whose part enters the hole, has no information there,
since a calibration does not use it. All attempts are made on one part, so that they share one misalignment.
"""

import contextlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.policies.calibration.model.error_model import DRIFT
from gelflow.policies.calibration.model.parameters import FARTHEST
from gelflow.policies.calibration.model.reading_model import ReadingModel, displacement_scale
from gelflow.policies.calibration.model.shear_model import Descents
from gelflow.policies.calibration.planning.information import Attempts, Known, information, pose_prior, without_pose
from gelflow.policies.calibration.problem import in_hole
from gelflow.policies.calibration.recordings import Recordings
from gelflow.session.motion_plan import PlannedMotion
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

SCENARIOS = 12
MOTIONS = 5  # of a plan
USUAL_NOISE = 1.5e-4  # of the difference of two readings of a marker, before anything is recorded [N]
_OFFSETS = (3e-3, 6e-3, 9e-3)  # of the candidates from the taught hole [m]
_YAWS = np.radians([-8.0, 0.0, 8.0])
STOP_SHEAR_MM = 0.25  # mean shear along the finger at which contact stops a planned descent in an unknown lab
_CONTACT_SHEAR_MM = 0.04  # mean shear that counts as contact at the end of a descent, as in a lab file
_LEVELS = 8  # depths at which the stop is searched, a constant ratio apart
_FIRST_LEVEL = 0.44e-3  # [m] below the start of an attempt, shortly before the rim
_SPREAD = 0.7  # of the scenarios' parameters, relative to the prior


@dataclass(frozen=True)
class Plan:
    """Motions in the order of their information, and what they are expected to determine."""

    motions: tuple[PlannedMotion, ...]
    gains: tuple[float, ...]  # decrease of the parameters' entropy by each motion, mean of the scenarios [nat]
    widths: dict[str, tuple[float, float]]  # parameter → width of its interval relative to the prior, before and after


def plan_motions(
    recordings: Recordings,
    *,
    known: Known | None = None,
    count: int = MOTIONS,
    workspace: tuple[float, float, float] | None = None,
    stop_shear_mm: float = STOP_SHEAR_MM,
    scenarios: int = SCENARIOS,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Plan:
    """The `count` attempts with the highest expected information.

    Parameters
    ----------
    recordings: give task, unit, grasp and the markers that are compared, and the noise if they have attempts
    known: what is known already, see `Calibration.known`; None: the priors
    workspace: largest |x|, |y| [m], |yaw| [rad] of the gripper about the taught hole; None: that of the task
    stop_shear_mm: mean shear along the finger at which contact stops a descent: more has more information
    scenarios: number of scenarios over which the information is averaged
    progress: gets the number of finished scenarios

    Raises UsageError when the workspace leaves no candidate, or none with contact, and SimulationError when no scenario
    can be simulated.
    """
    readings = ReadingModel(recordings)
    task, rng = recordings.task, np.random.default_rng((seed, 0x9A2))
    poses = candidates(task, workspace)
    noise = recordings.noise() / readings.scale if len(recordings) else USUAL_NOISE
    drift = DRIFT if known is None else known.drift
    per_newton = displacement_scale(readings.forces.scene)
    found = []
    for k in range(scenarios):
        point = _point(len(readings.fitted), known, rng)
        misalignment = task.draw_misalignment(rng, 1)[0]
        with contextlib.suppress(SimulationError):  # a gripper that cannot hold the part
            depths, shear = _stops(readings, point, in_hole(misalignment, poses), stop_shear_mm / per_newton)
            attempts = Attempts(misalignment, poses, np.zeros(len(poses)), depths)
            each = information(readings, point, attempts, noise, used=recordings.used, drift=drift)
            found.append(np.where((shear > _CONTACT_SHEAR_MM / per_newton)[:, None, None], each, 0.0))
        progress(k + 1)
    if not found:
        raise SimulationError("no plan: the attempts cannot be simulated with the parameters of any scenario")
    before: Array = np.eye(len(readings.fitted)) if known is None else np.asarray(np.linalg.inv(known.covariance))
    if not any(each.any() for each in found):
        raise UsageError(
            "no motion to plan: none within the workspace is expected to touch the rim; allow a larger workspace, or "
            "record insertions first"
        )
    chosen, gains, after = _greedy(np.stack(found), before, pose_prior(task), count)
    motions = tuple(PlannedMotion(x, y, yaw, task.descent, stop_shear_mm) for x, y, yaw in poses[chosen].tolist())
    names = [p.name for p in readings.fitted]
    widths = (np.sqrt(np.diag(np.linalg.inv(before))), after)
    return Plan(motions, gains, {name: (float(a), float(b)) for name, a, b in zip(names, *widths, strict=True)})


def candidates(task: InsertionTask, workspace: tuple[float, float, float] | None) -> Array:
    """Planar poses (n, 3) about the taught hole within the workspace. Raises UsageError when there is none."""
    limit = np.minimum(task.workspace, task.workspace if workspace is None else workspace)
    directions = np.arange(8) * np.pi / 4
    poses = np.array(
        [(r * np.cos(a), r * np.sin(a), yaw) for r, a, yaw in itertools.product(_OFFSETS, directions, _YAWS)]
    )
    inside: Array = poses[(np.abs(poses) <= limit + 1e-12).all(1)]
    if not len(inside):
        x, y, yaw = 1e3 * limit[0], 1e3 * limit[1], np.degrees(limit[2])
        least = 1e3 * min(_OFFSETS)
        raise UsageError(
            f"no motion to plan within the workspace of {x:g} mm, {y:g} mm and {yaw:g}°: the motions of a plan are at "
            f"least {least:g} mm from the taught hole"
        )
    return inside


def _point(count: int, known: Known | None, rng: np.random.Generator) -> Array:
    """Whitened parameters of a scenario: of the prior, or of what is known."""
    drawn = np.clip(rng.normal(size=count), -1.7, 1.7)
    if known is None:
        return _SPREAD * drawn
    return np.asarray(np.clip(known.mean + np.linalg.cholesky(known.covariance) @ drawn, -FARTHEST, FARTHEST))


def _stops(readings: ReadingModel, point: Array, poses: Array, stop_shear: float) -> tuple[Array, Array]:
    """Depths [m] at which a mean shear of `stop_shear` [N] stops attempts, and the shear there [N], (n,) each.

    `poses` (n, 3) are those of the gripper in the hole frame.
    """
    n, task = len(poses), readings.forces.task
    depths = np.geomspace(_FIRST_LEVEL, task.descent, _LEVELS)
    values = {name: np.full(n * _LEVELS, value) for name, value in readings.values(point).items()}
    descents = Descents(np.repeat(poses, _LEVELS, 0), np.zeros(n * _LEVELS), np.tile(depths, n))
    reading, _ = readings.read(values, descents)
    shear = np.abs(reading.reshape(n, _LEVELS, 2, -1, 2)[..., 0].mean(3)).max(2)
    stopped = shear > stop_shear
    level = np.where(stopped.any(1), stopped.argmax(1), _LEVELS - 1)
    return np.asarray(depths[level]), np.asarray(shear[np.arange(n), level])


def _greedy(found: Array, before: Array, pose: Array, count: int) -> tuple[list[int], tuple[float, ...], Array]:
    """Attempts chosen one after the other for the highest mean gain; their gains [nat]; the widths after all of them.

    `found` are the informations (scenarios, candidates, count + 3, count + 3); a pose may be chosen once.
    """
    sums = np.zeros_like(found[:, 0])
    entropy = np.full(len(found), np.linalg.slogdet(before)[1])
    chosen: list[int] = []
    gains = []
    for _ in range(min(count, found.shape[1])):
        total = np.linalg.slogdet(before + without_pose(sums[:, None] + found, pose))[1]
        gain = 0.5 * (total - entropy[:, None])
        mean = gain.mean(0)
        mean[chosen] = -np.inf
        best = int(mean.argmax())
        chosen.append(best)
        gains.append(float(mean[best]))
        sums, entropy = sums + found[:, best], total[:, best]
    variances = np.linalg.inv(before + without_pose(sums, pose))
    widths = np.sqrt(np.diagonal(variances, axis1=1, axis2=2)).mean(0)
    return chosen, tuple(gains), widths
