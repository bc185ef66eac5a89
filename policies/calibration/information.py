"""Fisher information of attempts that are not recorded yet."""

import numpy as np
from numpy.typing import NDArray

from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.model.shear_model import Descents
from gelflow.policies.calibration.problem import CORRELATED, DRIFT, MODEL_ERROR
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

# Half distance of the poses from whose readings a slope is taken [m, m, rad]. The forces have steps where contact
# points cross edges of the hole, so that the slope of a smaller distance says nothing about a finite change of pose.
POSE_STEP = np.array([0.5e-3, 0.5e-3, np.radians(1.0)])


def information(readings: ReadingModel, point: Array, descents: Descents, noise: float) -> Array:
    """Fisher information of each of n descents about the whitened parameters and its pose, (n, count + 3, count + 3).

    The pose is in units of `POSE_STEP`; the start height of each descent is unknown. `noise` is the standard deviation
    of the difference of two readings of a marker [N]. Raises SimulationError when a descent cannot be simulated.
    """
    reading, slopes = readings.slopes(point, descents)
    columns = np.stack([*slopes[:-1], *pose_slopes(readings, point, descents), slopes[-1]], -1)
    sigma = np.sqrt(noise**2 + (MODEL_ERROR**2) * (reading**2).mean((1, 2)) + 1e-12)
    per_pad = columns.reshape(len(sigma), 2, -1, 2, columns.shape[-1])
    shift = 1 - sigma / np.sqrt(sigma**2 + per_pad.shape[2] * DRIFT**2)  # a common shift of a pad is unknown as well
    per_pad = per_pad - shift[:, None, None, None, None] * per_pad.mean(2, keepdims=True)
    jacobian = per_pad.reshape(len(sigma), -1, columns.shape[-1]) / sigma[:, None, None]
    full = np.einsum("nki,nkj->nij", jacobian, jacobian) / CORRELATED
    full[:, -1, -1] += 1.0
    of_height = full[:, :-1, -1]
    return np.asarray(full[:, :-1, :-1] - of_height[:, :, None] * of_height[:, None, :] / full[:, -1:, -1:])


def pose_prior(task: InsertionTask) -> Array:
    """Information about the misalignment of a part before its first attempt, in units of `POSE_STEP`, (3, 3)."""
    spread = np.maximum(np.asarray(task.misalignment), 1e-6) / np.sqrt(3) / POSE_STEP
    return np.diag(1 / spread**2)


def pose_slopes(readings: ReadingModel, point: Array, descents: Descents) -> list[Array]:
    """Changes (n, markers, 2) of the readings [N] per `POSE_STEP` in x, y and yaw of the hole frame."""
    n, axes = len(descents.depth), len(POSE_STEP)
    shifts = np.vstack([sign * np.diag(POSE_STEP) for sign in (1.0, -1.0)])
    pose = (descents.pose[:, None] + shifts[None]).reshape(-1, 3)
    values = {name: np.full(len(pose), value) for name, value in readings.values(point).items()}
    moved, _ = readings.read(values, Descents(pose, np.repeat(descents.z, 6), np.repeat(descents.depth, 6)))
    moved = moved.reshape(n, 2, axes, *moved.shape[1:])
    return [(moved[:, 0, i] - moved[:, 1, i]) / 2 for i in range(axes)]


def without_pose(information: Array, pose: Array) -> Array:
    """Information about the parameters alone, from (…, count + 3, count + 3) and that about the pose before, (3, 3)."""
    count = information.shape[-1] - 3
    of_pose = information[..., count:, count:] + pose
    mixed = information[..., :count, count:]
    return np.asarray(information[..., :count, :count] - mixed @ np.linalg.solve(of_pose, np.swapaxes(mixed, -1, -2)))
