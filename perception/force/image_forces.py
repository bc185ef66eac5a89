"""Forces on the gel in the axes of an image: right, down, and into the gel."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.geometry import rotated
from gelflow.observation import Grid
from gelflow.perception.force.estimator import ForceEstimate, ForceEstimator
from gelflow.perception.force.slip import SlipEstimate, SlipEstimator

_NOISE_PX = 0.05  # of a tracked displacement along one axis


@dataclass(frozen=True)
class GridScale:
    """The scale of a tracked grid, and the axes of its displacements in millimetres."""

    pitch_mm: float
    pixels_per_mm: float  # mean
    along_grid: bool = False  # displacements are along rows and columns, as with a calibration, not along the image


def grid_angle(rest: NDArray[np.float64], rows: int, cols: int) -> float:
    """Rotation of a grid in the image, from the right axis towards the down axis [rad].

    `rest` are the positions of the markers at rest (right, down) [px], shape (markers, 2).
    """
    nodes = rest.reshape(rows, cols, 2)
    along, across = (np.diff(nodes, axis=axis).mean((0, 1)) for axis in (1, 0))
    along, across = along / np.linalg.norm(along), across / np.linalg.norm(across)
    return math.atan2(along[1] - across[0], along[0] + across[1])  # the rotation nearest to rows and columns


class ImageForces:
    """Forces and slip from tracked images of one camera."""

    def __init__(self, gel: ElasticGel, rows: int, cols: int, scale: GridScale, angle: float = 0.0) -> None:
        """`angle` is the `grid_angle`. Raises UsageError for a grid without forces, see `ForceEstimator`."""
        noise = _NOISE_PX / scale.pixels_per_mm * 1e-3
        grid = Grid(rows, cols, scale.pitch_mm)
        self.angle = angle
        self._along_grid = scale.along_grid
        self._modulus_deviation = gel.youngs_modulus_deviation
        self._estimator = ForceEstimator(gel, grid, noise=noise)
        self._slip = SlipEstimator(grid, friction=gel.friction or None, friction_deviation=gel.friction_deviation)
        self.slip: SlipEstimate | None = None  # in the last image; None where the forces are not known

    def reset(self) -> None:
        """Clear the history, and an observed friction."""
        self._estimator.reset()
        self._slip.reset()
        self.slip = None

    def estimate(
        self, displacement_mm: NDArray[np.float64], valid: NDArray[np.bool_], stamp: float
    ) -> ForceEstimate | None:
        """Forces (right, down) in the axes of the image, at `stamp` [s].

        The displacements (right, down) [mm], shape (markers, 2), are in the axes that `GridScale.along_grid` states.
        None if fewer than half of the markers are valid.
        """
        along = displacement_mm if self._along_grid else rotated(displacement_mm, -self.angle)
        displacement = along[:, ::-1] * 1e-3
        estimate = self._estimator.estimate(displacement, valid, stamp)
        self.slip = self._slip.estimate(estimate, displacement, valid, stamp)
        return None if estimate is None else _in_image(estimate, self.angle, self._modulus_deviation)


def force_record(estimate: ForceEstimate, slip: SlipEstimate | None = None) -> dict[str, Any]:
    """Totals and slip as plain data, as in `gelflow.Force` of sessions: forces [N], moments [N m], lengths [mm]."""
    centre = estimate.centre_of_pressure
    return {
        "contact": estimate.contact,
        "shear": estimate.shear,
        "shear_deviation": estimate.shear_deviation,
        "normal": estimate.normal,
        "normal_deviation": estimate.normal_deviation,
        "moment": estimate.moment,
        "moment_deviation": estimate.moment_deviation,
        "centre_mm": None if centre is None else 1e3 * centre,
        "contact_area_mm2": 1e6 * estimate.contact_area,
        "unexplained": estimate.unexplained,
        **({} if slip is None else slip_record(slip)),
    }


def slip_record(slip: SlipEstimate) -> dict[str, Any]:
    """The slip as plain data."""
    return {
        "stick_share": slip.stick_share,
        "stick_share_deviation": slip.stick_share_deviation,
        "gross_slip": slip.gross,
        "gross_slip_since": slip.since,
        "gross_slip_confidence": slip.confidence,
        "friction": slip.friction,
        "friction_observed": slip.friction_observed,
    }


def _in_image(estimate: ForceEstimate, angle: float, modulus_deviation: float) -> ForceEstimate:
    """`estimate` along columns and rows, in the axes (right, down) of an image in which the grid is rotated.

    `modulus_deviation` is the relative standard deviation of Young's modulus that the estimate contains.
    """
    centre, shear = estimate.centre_of_pressure, rotated(estimate.shear[::-1], angle)
    # The error of the modulus is one factor of the shear; the other errors along rows and columns are taken as
    # independent.
    other = np.maximum(estimate.shear_deviation**2 - (modulus_deviation * estimate.shear) ** 2, 0.0)[::-1]
    shares = np.array([[math.cos(angle), math.sin(angle)], [math.sin(angle), math.cos(angle)]]) ** 2
    return replace(
        estimate,
        shear=shear,
        moment=-estimate.moment,
        centre_of_pressure=None if centre is None else rotated(centre[::-1], angle),
        shear_deviation=np.sqrt(shares @ other + (modulus_deviation * shear) ** 2),
        shear_field=rotated(estimate.shear_field[:, ::-1], angle),
    )
