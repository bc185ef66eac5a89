"""Forces on a gel from the displacements of its markers, image by image."""

import math
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from gelflow.errors import UsageError
from gelflow.gel.creep import CreepCorrection
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force._contact_fit import ContactFit
from gelflow.perception.force.contact_fit import LayerModel, fit_contact

Array = NDArray[np.float64]

MAX_MARKERS = 1000  # the equations have (3 n)² entries
_RELATIVE_NOISE = 0.01  # of the layer model, relative to the displacements
_CONTACT_SIGNIFICANCE = 5.0  # standard deviations of the mean square displacement without a contact
_FEWEST_MEASURED = 0.5  # of the markers
_PRESSED = 0.1  # cells with this share of the largest normal load count as contact area
# Added to the deviations for errors of the layer model and of the contact's assumed shape, relative to the value;
# measured, see docs/guide/sensing/forces.md.
_SHEAR_ERROR, _NORMAL_ERROR, _MOMENT_ERROR = 0.015, 0.06, 0.06
# Held while the number of threads of the linear algebra is limited: it is one number for the whole process.
_blas_limit = threading.Lock()


def check_force_grid(rows: int, cols: int) -> None:
    """Raise UsageError for a grid of markers that is too large or too small for forces."""
    if rows < 3 or cols < 3 or rows * cols > MAX_MARKERS:
        raise UsageError(f"forces need a grid of at least 3 × 3 and at most {MAX_MARKERS} markers, got {rows} × {cols}")


def checked_displacement(
    displacement: Array, valid: NDArray[np.bool_], markers: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Both as arrays. Raises UsageError for another shape, and for a valid displacement that is not finite."""
    displacement, valid = np.asarray(displacement, float), np.asarray(valid, bool)
    if displacement.shape != (markers, 2) or valid.shape != (markers,):
        raise UsageError(
            f"expected displacements of shape ({markers}, 2) and valid of shape ({markers},), got "
            f"{displacement.shape} and {valid.shape}"
        )
    if not np.isfinite(displacement[valid]).all():
        raise UsageError("a displacement of a valid marker is not finite")
    return displacement, valid


@dataclass(frozen=True)
class ForceEstimate:
    """Forces of an object on the gel, in the axes of the displacements; the normal force is positive in compression.

    Deviations are standard deviations. Without a contact all forces are 0, and the deviations are those that the
    noise of the displacements would cause.
    """

    contact: bool
    shear: Array  # total force along the gel [N], shape (2,)
    normal: float  # total force into the gel [N]
    moment: float  # about the normal through the centre of pressure, from the first axis to the second [N m]
    centre_of_pressure: Array | None  # [m], shape (2,); None without a contact
    contact_area: float  # [m²], a multiple of the area of a marker's cell
    shear_deviation: Array  # along each axis [N], shape (2,)
    normal_deviation: float  # [N]
    moment_deviation: float  # [N m]
    shear_field: Array  # force on the cell of each marker [N], shape (markers, 2)
    normal_field: Array  # [N], shape (markers,)
    unexplained: float  # share of the displacements that these forces do not explain, rms


class ForceEstimator:
    """Forces on an elastic gel with a regular grid of markers.

    The displacements are inverted with the elastic layer that the simulator uses too; `contact_fit` describes what
    separates normal from shear forces. The fit of an image starts from that of the one before.
    """

    def __init__(self, gel: ElasticGel, grid: Grid, *, noise: float = 2e-6) -> None:
        """`noise` is the standard deviation of a measured displacement along one axis [m].

        Raises UsageError for a grid that is too large or too small, or a noise that is not above 0.
        """
        check_force_grid(grid.rows, grid.cols)
        if not 0 < noise < math.inf:
            raise UsageError(f"noise must be above 0 m, got {noise:g}")
        self.gel, self.grid = gel, grid
        self._pitch = grid.pitch * 1e-3
        self._noise = noise / self._pitch
        self._positions = grid.positions() * 1e-3
        self._middle = self._positions.mean(0)
        self._blas = ThreadpoolController().select(user_api="blas")
        self._model = LayerModel(grid.rows, grid.cols, gel.poisson_ratio, gel.thickness / self._pitch)
        self._fit: ContactFit | None = None
        self._creep = CreepCorrection(gel.creep, gel.creep_time)

    def reset(self) -> None:
        """Clear the history."""
        self._fit = None
        self._creep.reset()

    def estimate(
        self, displacement: Array, valid: NDArray[np.bool_], stamp: float | None = None
    ) -> ForceEstimate | None:
        """The forces for one image, or None if fewer than half of the markers are measured.

        Parameters
        ----------
        displacement: from rest [m], shape (markers, 2), along rows and columns of the grid; ignored where not valid
        valid: whether a marker is measured, shape (markers,)
        stamp: time of the image [s]; needed for a gel with creep only

        Raises UsageError for arrays of another shape, valid displacements that are not finite, and a missing stamp.
        """
        markers = len(self._positions)
        displacement, valid = checked_displacement(displacement, valid, markers)
        if self.gel.creep:
            if stamp is None or not math.isfinite(stamp):
                raise UsageError("a gel with creep needs the time of each image: give stamp [s]")
            displacement = self._creep.undo(displacement, np.repeat(valid[:, None], 2, axis=1), stamp)
        displacement = displacement / self._pitch
        measured = displacement[valid]
        if len(measured) < _FEWEST_MEASURED * markers:
            self._fit = None
            return None
        # The matrices are small: threads of the linear algebra would only wait for each other.
        with _blas_limit, self._blas.limit(limits=1):
            return self._estimate(displacement, valid, measured)

    def _estimate(self, displacement: Array, valid: NDArray[np.bool_], measured: Array) -> ForceEstimate:
        mean_square = float(np.vdot(measured, measured)) / measured.size
        if mean_square < self._noise**2 * (1 + _CONTACT_SIGNIFICANCE / math.sqrt(measured.size / 2)):
            self._fit = None
            return self._no_contact()
        noise = math.hypot(self._noise, _RELATIVE_NOISE * math.sqrt(mean_square))
        fit = self._fit = fit_contact(self._model, displacement, valid, noise, self._fit)
        if not fit.normal.any():
            self._fit = None
            return self._no_contact()
        return self._contact(fit, measured.size)

    def _contact(self, fit: ContactFit, values: int) -> ForceEstimate:
        """`values` is the number of measured values, two for each marker."""
        force = self.gel.youngs_modulus * self._pitch**2  # unit of the loads [N]
        sums, normal = fit.sums, fit.normal
        total, pressed, moment = force * sums.shear, force * sums.normal, force * self._pitch * sums.moment
        spread = force * np.sqrt(fit.rigid_covariance.diagonal() * max(1.0, fit.cost / values))
        modulus = self.gel.youngs_modulus_deviation
        return ForceEstimate(
            contact=True,
            shear=total,
            normal=pressed,
            moment=moment,
            centre_of_pressure=self._middle + self._pitch * sums.centre,
            contact_area=float((normal > _PRESSED * normal.max()).sum()) * self._pitch**2,
            shear_deviation=np.array(
                [math.hypot(spread[axis], _SHEAR_ERROR * math.hypot(*total), modulus * total[axis]) for axis in (0, 1)]
            ),
            normal_deviation=math.hypot(spread[2], _NORMAL_ERROR * pressed, modulus * pressed),
            moment_deviation=math.hypot(self._pitch * spread[3], _MOMENT_ERROR * moment, modulus * moment),
            shear_field=force * fit.shear(self._model.position).T,
            normal_field=force * normal,
            unexplained=fit.unexplained,
        )

    def _no_contact(self) -> ForceEstimate:
        """No forces, with the deviations of sums that follow from the long-wave limits of the layer.

        A uniform displacement u needs the shear G u / h on the layer; the first moment of the displacements that a
        normal force N causes is 2 b N h² / G, with b from B in `elastic_layer` at small w.
        """
        kappa = 3 - 4 * self.gel.poisson_ratio
        spreading = abs(1 - (1 - 2 * self.gel.poisson_ratio) * kappa) * 2 / (1 + kappa) ** 2
        n, cell, thickness = len(self._positions), self._pitch**2, self.gel.thickness
        noise, arm = self._noise * self._pitch, self._positions - self._middle
        stiffness = self.gel.youngs_modulus / (2 * (1 + self.gel.poisson_ratio)) * cell
        radius = math.sqrt(float((arm**2).sum()))
        shear = stiffness / thickness * noise * math.sqrt(n)
        return ForceEstimate(
            contact=False,
            shear=np.zeros(2),
            normal=0.0,
            moment=0.0,
            centre_of_pressure=None,
            contact_area=0.0,
            shear_deviation=np.full(2, shear),
            normal_deviation=stiffness / (2 * max(spreading, 0.01) * thickness**2) * noise * radius,
            moment_deviation=stiffness / thickness * noise * radius,
            shear_field=np.zeros((n, 2)),
            normal_field=np.zeros(n),
            unexplained=0.0,
        )
