"""Fisher information of attempts that are not recorded yet."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import SimulationError
from gelflow.policies.calibration.model.error_model import DRIFT, ErrorModel
from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.model.shear_model import QUANTITIES, Descents
from gelflow.policies.calibration.problem import POSE_STEP, in_hole
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

_STEP = 0.2  # of differences in parameters and start heights, in standard deviations of their priors


@dataclass(frozen=True)
class Known:
    """Knowledge about the whitened parameters: a normal distribution, and the drift of the pads [N]."""

    mean: Array
    covariance: Array
    drift: float


@dataclass(frozen=True)
class Attempts:
    """n attempts, as in `Recordings`."""

    misalignment: Array  # of the part on which each is made (n, 3), or of all (3,)
    planar_pose: Array  # of the gripper in the taught frame of the hole (n, 3)
    z: Array  # start heights above the nominal one (n,) [m]
    depth: Array  # (n,) [m]

    def descents(self, shift: Array | float = 0.0) -> Descents:
        """The descents, with `shift` added to all misalignments."""
        return Descents(in_hole(self.misalignment + shift, self.planar_pose), self.z, self.depth)


def information(
    readings: ReadingModel,
    point: Array,
    attempts: Attempts,
    noise: float,
    *,
    used: NDArray[np.bool_],
    drift: float = DRIFT,
) -> Array:
    """Fisher information of each of n attempts about the whitened parameters and its misalignment.

    Shape (n, count + 3, count + 3), with the misalignment in units of `POSE_STEP`; the start height of each attempt is
    unknown. `noise` is the standard deviation of the difference of two readings of a marker [N], `drift` that of a
    common shift of a pad [N]; `used` are the markers that are compared (markers,). Slopes are differences of simulated
    readings, which are faster than exact derivatives for many descents. Raises SimulationError when no descent can be
    simulated.
    """
    reading, columns, ok = _slopes(readings, point, attempts)
    if not ok.any():
        raise SimulationError("no descent can be simulated with these parameters")
    errors = ErrorModel(noise, np.sqrt((reading[:, used] ** 2).mean((1, 2))), used, drift=drift)
    rows = np.arange(len(reading))
    jacobian = np.stack([errors.whiten(columns[..., i], rows) for i in range(columns.shape[-1])], -1)
    full = np.einsum("nki,nkj->nij", jacobian, jacobian) / errors.cluster_size[:, None, None]
    full[:, -1, -1] += 1.0
    of_height = full[:, :-1, -1]
    result = full[:, :-1, :-1] - of_height[:, :, None] * of_height[:, None, :] / full[:, -1:, -1:]
    return np.where(ok[:, None, None], result, 0.0)


def _slopes(readings: ReadingModel, point: Array, attempts: Attempts) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Readings (n, markers, 2) [N]; their slopes (n, markers, 2, count + 4); and whether all simulations succeeded.

    Slopes are by each whitened parameter, by the misalignment in units of `POSE_STEP`, and by the start height in
    standard deviations. Those by parameters of the pads are exact.
    """
    n, count = len(attempts.depth), len(readings.fitted)
    simulated = [i for i, p in enumerate(readings.fitted) if p.name in QUANTITIES]
    # One variation of all descents after the other: none, parameters, height, misalignments.
    points = [point[:count] + _STEP * np.eye(count)[i] for i in simulated]
    points = [point[:count], *points, *([point[:count]] * 7)]
    shifts = [np.zeros(3)] * (len(simulated) + 2) + [s * row for row in np.diag(POSE_STEP) for s in (1.0, -1.0)]
    raised = np.zeros(len(points))
    raised[len(simulated) + 1] = _STEP * readings.height_spread
    values = {name: np.repeat(value, n) for name, value in readings.values(np.stack(points)).items()}
    pose = np.concatenate([attempts.descents(shift).pose for shift in shifts])
    z = np.repeat(raised, n) + np.tile(attempts.z, len(points))
    forces = {name: values[name] for name in QUANTITIES}
    shear, ok = readings.forces.shear(forces, Descents(pose, z, np.tile(attempts.depth, len(points))))
    read = readings.pads.read(shear, values).reshape(len(points), n, *shear.shape[1:])
    columns = np.zeros((n, *read.shape[2:], count + 4))
    for k, i in enumerate(simulated):
        columns[..., i] = (read[1 + k] - read[0]) / _STEP
    for i, slope in readings.pad_slopes(point, shear[:n]).items():
        columns[..., i] = slope
    columns[..., -1] = (read[len(simulated) + 1] - read[0]) / _STEP
    for axis in range(3):
        first = len(simulated) + 2 + 2 * axis
        columns[..., count + axis] = (read[first] - read[first + 1]) / 2
    return read[0], columns, np.asarray(ok.reshape(len(points), n).all(0))


def pose_prior(task: InsertionTask) -> Array:
    """Information about the misalignment of a part before its first attempt, in units of `POSE_STEP`, (3, 3)."""
    spread = np.maximum(np.asarray(task.misalignment), 1e-6) / np.sqrt(3) / POSE_STEP
    return np.diag(1 / spread**2)


def without_pose(information: Array, pose: Array) -> Array:
    """Information about the parameters alone, from (…, count + 3, count + 3) and that about the pose before, (3, 3)."""
    count = information.shape[-1] - 3
    of_pose = information[..., count:, count:] + pose
    mixed = information[..., :count, count:]
    return np.asarray(information[..., :count, :count] - mixed @ np.linalg.solve(of_pose, np.swapaxes(mixed, -1, -2)))
