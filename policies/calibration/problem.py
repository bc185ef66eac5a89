"""The least-squares problem of a calibration: residuals of flow maps, priors, and their derivatives."""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import compose_planar
from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.model.shear_model import Descents
from gelflow.policies.calibration.recordings import Recordings
from gelflow.sim.tasks.insertion_randomization import NOMINAL

Array = NDArray[np.float64]

MODEL_ERROR = 0.02  # of a flow map that the model is not expected to reproduce, relative to its root mean square
CORRELATED = 9.0  # neighbouring markers that share this error: their residuals count as one
# Standard deviation of a common shift of all markers of a pad between two readings [N]: that of each reading is up to
# 3e-3, three times the limit of the randomization.
DRIFT = 3e-3 * math.sqrt(2 / 3)
# Half distance of the poses between which slopes by x, y [m] and yaw [rad] are taken. The forces have steps where
# contact points cross edges of the hole: the slope of a smaller distance does not predict a finite change of pose.
POSE_STEP = np.array([0.5e-3, 0.5e-3, np.radians(1.0)])
_HUBER = 3.0  # residuals beyond this many standard deviations count linearly


@dataclass(frozen=True)
class Linearization:
    """Residuals of all attempts at a point, and their Jacobian."""

    residuals: Array  # (n, markers * 2), whitened
    jacobian: Array  # (n, markers * 2, unknowns)


class Problem:
    """Residuals of recorded flow maps as a function of whitened unknowns.

    The unknowns are the parameters, then the start height of each attempt; all have a standard normal prior. Poses are
    separate: the forces do not change with a pose until a contact point crosses an edge of the hole, so that poses have
    no useful gradient and are searched (`gelflow.policies.calibration.poses`).
    """

    def __init__(self, recordings: Recordings, *, threads: int | None = None, preset: str | None = None) -> None:
        if not len(recordings):
            raise UsageError("the recordings have no attempt with contact: there is nothing to fit")
        self.readings = ReadingModel(recordings, threads=threads, preset=preset)
        self.fitted = self.readings.fitted
        self._scale = self.readings.scale
        self.noise = recordings.noise() / self._scale
        self._set_recordings(recordings, MODEL_ERROR)

    def of(self, insertion: int) -> "Problem":
        """The same problem with the attempts of one insertion only."""
        result = copy.copy(self)
        result._set_recordings(self.recordings.of(np.array([insertion])), self._model_error)
        return result

    def _set_recordings(self, recordings: Recordings, model_error: float) -> None:
        self.recordings = recordings
        self.data = recordings.flow.reshape(len(recordings), -1, 2) / self._scale
        self.markers = self.data.shape[1]
        self._power = np.sqrt((self.data**2).mean((1, 2)))
        self.set_model_error(model_error)

    def set_model_error(self, relative: float) -> None:
        """Set the error of flow maps that residuals allow for; large values make the cost smooth."""
        self._model_error = relative
        self.sigma: Array = np.sqrt(self.noise**2 + (relative * self._power) ** 2 + 1e-12)
        self._shift = part_of_mean(self.sigma, self.markers / 2)

    @property
    def insertions(self) -> int:
        """Number of insertions, each with its own pose."""
        return int(self.recordings.insertion.max()) + 1

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.fitted) + len(self.recordings)

    def values(self, point: Array) -> dict[str, Array]:
        """Values of the parameters from points (…, unknowns)."""
        return self.readings.values(point)

    def heights(self, point: Array) -> Array:
        """Start heights (…, n) [m] from points (…, unknowns)."""
        return self.recordings.height_spread * point[..., len(self.fitted) :]

    def predicted(
        self, values: Mapping[str, Array], rows: NDArray[np.int64], misalignment: Array, z: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Flow maps (m, markers, 2) [N] of the attempts `rows` (m,), and whether they could be simulated."""
        pose = in_hole(misalignment, self.recordings.planar_pose[rows])
        return self.readings.read(values, Descents(pose, z, self.recordings.depth[rows]))

    def flow(self, point: Array, misalignment: Array) -> Array:
        """Flow maps (n, markers, 2) of all attempts, in the unit of the recordings; zero where a simulation fails."""
        n = len(self.recordings)
        values = {name: np.full(n, value) for name, value in self.values(point).items()}
        poses = misalignment[self.recordings.insertion]
        return self._scale * self.predicted(values, np.arange(n), poses, self.heights(point))[0]

    def scene_point(self) -> Array:
        """Whitened parameters with the values of the scene, and the grasp of the recordings."""
        point = np.zeros(len(self.fitted))
        nominal = NOMINAL.sample(np.random.default_rng(0), 1, friction="elastic")
        for i, parameter in enumerate(self.fitted):
            if parameter.name in nominal and not parameter.name.startswith("grasp"):
                value = 0.0 if parameter.name == "crosstalk" else float(nominal[parameter.name][0])
                point[i] = float(parameter.whitened(np.array(value)))
        return point

    def recorded_flow(self) -> Array:
        """Recorded flow maps (n, markers, 2), in the unit of the recordings."""
        return self._scale * self.data

    def whiten(self, difference: Array, rows: NDArray[np.int64]) -> Array:
        """Whitened residuals (m, markers * 2) of differences (m, markers, 2) of the attempts `rows`."""
        per_pad = difference.reshape(len(rows), 2, -1, 2)
        per_pad = per_pad - self._shift[rows][:, None, None, None] * per_pad.mean(2, keepdims=True)
        return np.asarray(per_pad.reshape(len(rows), -1) / self.sigma[rows][:, None])

    def residuals(self, point: Array, misalignment: Array) -> tuple[Array, bool]:
        """Whitened residuals (n, markers * 2) with the misalignment (insertions, 3) of each insertion."""
        residuals, ok = self.residuals_of(point[None], misalignment[None])
        return residuals[0], bool(ok.all())

    def residuals_of(self, points: Array, misalignment: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Whitened residuals (m, n, markers * 2) and whether they could be simulated (m, n), of m guesses.

        A guess has unknowns (size,) and a misalignment (insertions, 3).
        """
        m, n = len(points), len(self.recordings)
        rows = np.tile(np.arange(n), m)
        values = {name: np.repeat(value, n) for name, value in self.values(points).items()}
        poses = misalignment[:, self.recordings.insertion].reshape(-1, 3)
        flow, ok = self.predicted(values, rows, poses, self.heights(points).reshape(-1))
        return self.whiten(flow - self.data[rows], rows).reshape(m, n, -1), ok.reshape(m, n)

    def normal_equations(self, residuals: Array, jacobian: Array, point: Array) -> tuple[Array, Array]:
        """Gauss-Newton Hessian and gradient of `cost`, from flat residuals (m,) and their Jacobian (m, unknowns)."""
        weights = huber_weights(residuals) / CORRELATED
        return jacobian.T @ (weights[:, None] * jacobian) + np.eye(self.size), jacobian.T @ (
            weights * residuals
        ) + point

    def linearize(self, point: Array, misalignment: Array) -> Linearization:
        """Residuals and their exact Jacobian."""
        n, count = len(self.recordings), len(self.fitted)
        pose = in_hole(misalignment[self.recordings.insertion], self.recordings.planar_pose)
        descents = Descents(pose, self.heights(point), self.recordings.depth)
        reading, slopes = self.readings.slopes(point, descents)
        rows = np.arange(n)
        jacobian = np.zeros((n, self.markers * 2, self.size))
        for i in range(count):
            jacobian[:, :, i] = self.whiten(slopes[i], rows)
        jacobian[rows, :, count + rows] = self.whiten(slopes[count], rows)
        return Linearization(self.whiten(reading - self.data, rows), jacobian)

    @staticmethod
    def chi(residuals: Array) -> float:
        """Robust root mean square of whitened residuals: 1 as expected from noise and model error."""
        return float(np.sqrt((huber_weights(residuals) * residuals**2).mean()))

    def cost(self, residuals: Array, point: Array) -> float:
        """Robust negative log posterior."""
        return float(huber(residuals).sum() / CORRELATED + 0.5 * point @ point)


def part_of_mean(sigma: Array, markers: float) -> Array:
    """The part of a pad's mean whose subtraction whitens residuals with a common shift of the pad.

    `sigma` is the standard deviation of its `markers`, of which `CORRELATED` count as one.
    """
    return np.asarray(1 - sigma / np.sqrt(sigma**2 + markers / CORRELATED * DRIFT**2))


def huber(residuals: Array) -> Array:
    """Half the square of residuals, linear beyond the limit."""
    size = np.abs(residuals)
    return np.where(size <= _HUBER, 0.5 * residuals**2, _HUBER * (size - 0.5 * _HUBER))


def huber_weights(residuals: Array) -> Array:
    """Weights of residuals in iteratively reweighted least squares."""
    return np.minimum(1.0, _HUBER / np.maximum(np.abs(residuals), 1e-12))


def in_hole(misalignment: Array, planar_pose: Array) -> Array:
    """Gripper poses in the hole frame (…, 3) from misalignments and planar poses (…, 3)."""
    return compose_planar(misalignment, planar_pose)
