"""The least-squares problem of a calibration: residuals of flow maps, priors, and their derivatives."""

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import compose_planar
from gelflow.policies.calibration.model.error_model import ErrorModel
from gelflow.policies.calibration.model.fidelity import COARSE, EXACT, Fidelity
from gelflow.policies.calibration.model.reading_model import ReadingModel
from gelflow.policies.calibration.model.shear_model import Descents
from gelflow.policies.calibration.recordings import Recordings
from gelflow.sim.tasks.insertion_randomization import NOMINAL

Array = NDArray[np.float64]

# Half distance of the poses between which slopes by x, y [m] and yaw [rad] are taken. The forces have steps where
# contact points cross edges of the hole: the slope of a smaller distance does not predict a finite change of pose.
POSE_STEP = np.array([0.5e-3, 0.5e-3, np.radians(1.0)])


@dataclass(frozen=True)
class Linearization:
    """Residuals of all attempts at a point, and their Jacobian."""

    residuals: Array  # (n, 2 * markers), whitened
    jacobian: Array  # (n, 2 * markers, unknowns)


class Problem:
    """Residuals of recorded flow maps as a function of whitened unknowns.

    The unknowns are the parameters, then the start height of each attempt; all have a standard normal prior. Poses are
    separate: the forces do not change with a pose until a contact point crosses an edge of the hole, so that poses have
    no useful gradient and are searched (`gelflow.policies.calibration.poses`).
    """

    def __init__(self, recordings: Recordings, *, threads: int | None = None, fidelity: Fidelity = EXACT) -> None:
        if not len(recordings):
            raise UsageError("the recordings have no attempt with contact: there is nothing to fit")
        if not recordings.used.reshape(2, -1).any(1).all():
            raise UsageError(
                "no marker of a pad can be compared: its camera shows too few lines of the printed grid, or all of its "
                "markers are too noisy"
            )
        self.readings = ReadingModel(recordings, threads=threads, fidelity=fidelity)
        self._threads = threads
        self.fitted = self.readings.fitted
        self._scale = self.readings.scale
        self._set_recordings(recordings)
        self.errors = ErrorModel(recordings.noise() / self._scale, self._rms(), recordings.used)

    @property
    def coarse(self) -> "Problem":
        """A copy in the coarse simulation."""
        result = copy.copy(self)
        result.readings = ReadingModel(self.recordings, threads=self._threads, fidelity=COARSE)
        return result

    def of(self, insertion: int) -> "Problem":
        """The same problem with the attempts of one insertion only."""
        result = copy.copy(self)
        result._set_recordings(self.recordings.of(np.array([insertion])))
        result.errors = dataclasses.replace(self.errors, rms=result._rms())
        return result

    def _set_recordings(self, recordings: Recordings) -> None:
        self.recordings = recordings
        self.data = recordings.flow.reshape(len(recordings), -1, 2) / self._scale

    def _rms(self) -> Array:
        """Root mean square of the compared markers of each flow map [N], (n,)."""
        return np.asarray(np.sqrt((self.data[:, self.recordings.used] ** 2).mean((1, 2))))

    def allow_for(self, *, model_error: float | None = None, drift: float | None = None) -> None:
        """Set the errors that residuals allow for, see `ErrorModel`; a large model error makes the cost smooth."""
        if model_error is not None:
            self.errors = dataclasses.replace(self.errors, model_error=model_error)
        if drift is not None:
            self.errors = dataclasses.replace(self.errors, drift=drift)

    def allow_for_present_drift(self, point: Array, misalignment: Array) -> None:
        """Allow for the common shifts of pads that the differences at a point show."""
        difference = self.flow(point, misalignment) / self._scale - self.data
        self.allow_for(drift=self.errors.estimated_drift(difference))

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

    def residuals(self, point: Array, misalignment: Array) -> tuple[Array, bool]:
        """Whitened residuals (n, 2 * markers) with the misalignment (insertions, 3) of each insertion."""
        residuals, ok = self.residuals_of(point[None], misalignment[None])
        return residuals[0], bool(ok.all())

    def residuals_of(self, points: Array, misalignment: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Whitened residuals (m, n, 2 * markers) and whether they could be simulated (m, n), of m guesses.

        A guess has unknowns (size,) and a misalignment (insertions, 3).
        """
        m, n = len(points), len(self.recordings)
        rows = np.tile(np.arange(n), m)
        values = {name: np.repeat(value, n) for name, value in self.values(points).items()}
        poses = misalignment[:, self.recordings.insertion].reshape(-1, 3)
        flow, ok = self.predicted(values, rows, poses, self.heights(points).reshape(-1))
        return self.errors.whiten(flow - self.data[rows], rows).reshape(m, n, -1), ok.reshape(m, n)

    def normal_equations(self, residuals: Array, jacobian: Array, point: Array) -> tuple[Array, Array]:
        """Gauss-Newton Hessian and gradient of `cost`, from flat residuals (m,) and their Jacobian (m, unknowns)."""
        weights = self.errors.weights(residuals.reshape(len(self.recordings), -1)).reshape(-1)
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
        jacobian = np.zeros((n, 2 * self.errors.markers, self.size))
        for i in range(count):
            jacobian[:, :, i] = self.errors.whiten(slopes[i], rows)
        jacobian[rows, :, count + rows] = self.errors.whiten(slopes[count], rows)
        return Linearization(self.errors.whiten(reading - self.data, rows), jacobian)

    def cost(self, residuals: Array, point: Array) -> float:
        """Robust negative log posterior."""
        return float(self.errors.misfit(residuals).sum() + self.errors.log_determinant + 0.5 * point @ point)


def in_hole(misalignment: Array, planar_pose: Array) -> Array:
    """Gripper poses in the hole frame (…, 3) from misalignments and planar poses (…, 3)."""
    return compose_planar(misalignment, planar_pose)
