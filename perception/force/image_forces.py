"""Forces on the gel in the axes of an image: right, down, and into the gel."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force.estimator import ForceEstimate, ForceEstimator
from gelflow.perception.force.slip import SlipEstimate, SlipEstimator

_NOISE_PX = 0.05  # of a tracked displacement along one axis


@dataclass(frozen=True)
class GridScale:
    """The scale of a tracked grid."""

    pitch_mm: float
    pixels_per_mm: float  # mean


@dataclass(frozen=True)
class GridAxes:
    """The axes of a grid that is rotated in the image: along its rows, and along its columns.

    Vectors and positions have the shape (..., 2) and any unit.
    """

    angle: float = 0.0  # of the rows, clockwise from the right axis of the image [rad]

    @classmethod
    def of(cls, rest: NDArray[np.float64], rows: int, cols: int) -> "GridAxes":
        """The mean axes of markers whose positions at rest are `rest` (right, down) [px], shape (markers, 2)."""
        nodes = rest.reshape(rows, cols, 2)
        along, across = (np.diff(nodes, axis=axis).mean((0, 1)) for axis in (1, 0))
        along, across = along / np.linalg.norm(along), across / np.linalg.norm(across)
        return cls(math.atan2(along[1] - across[0], along[0] + across[1]))  # the rotation nearest to both

    def to_grid(self, vectors: ArrayLike) -> NDArray[np.float64]:
        """Vectors (right, down) of the image, along rows and columns."""
        return np.asarray(np.asarray(vectors, float) @ self._axes.T)

    def to_image(self, vectors: ArrayLike) -> NDArray[np.float64]:
        """Vectors along rows and columns, as (right, down) in the image."""
        return np.asarray(np.asarray(vectors, float) @ self._axes)

    def deviation_to_image(self, deviation: ArrayLike) -> NDArray[np.float64]:
        """Standard deviations along (right, down) from those along rows and columns, taken as independent."""
        return np.asarray(np.sqrt(np.square(np.asarray(deviation, float)) @ self._axes**2))

    @property
    def _axes(self) -> NDArray[np.float64]:
        """Unit vectors (right, down) along rows and columns, one per row."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return np.array([[cos, sin], [-sin, cos]])


class ImageForces:
    """Forces and slip from tracked images of one camera."""

    def __init__(self, gel: ElasticGel, rows: int, cols: int, scale: GridScale, axes: GridAxes | None = None) -> None:
        """`axes` are those of the grid in the image; None where displacements are along its rows and columns, as those
        of a calibration are.

        Raises UsageError for a grid without forces, see `ForceEstimator`.
        """
        noise = _NOISE_PX / scale.pixels_per_mm * 1e-3
        grid = Grid(rows, cols, scale.pitch_mm)
        self._axes = axes or GridAxes()
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
        """Forces (right, down) at `stamp` [s] for displacements (right, down) [mm], shape (markers, 2).

        None if fewer than half of the markers are valid.
        """
        displacement = self._axes.to_grid(displacement_mm)[:, ::-1] * 1e-3
        estimate = self._estimator.estimate(displacement, valid, stamp)
        self.slip = self._slip.estimate(estimate, displacement, valid, stamp)
        return None if estimate is None else _in_image(estimate, self._axes)


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


def record_in_image(record: dict[str, Any], axes: GridAxes) -> dict[str, Any]:
    """The plain data of a `force_record` in the axes of the grid, in those of the image."""
    centre = record["centre_mm"]
    return record | {
        "shear": axes.to_image(record["shear"]).tolist(),
        "shear_deviation": axes.deviation_to_image(record["shear_deviation"]).tolist(),
        "centre_mm": None if centre is None else axes.to_image(centre).tolist(),
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


def _in_image(estimate: ForceEstimate, axes: GridAxes) -> ForceEstimate:
    """`estimate` along columns and rows, in the axes (right, down) of the image."""
    centre = estimate.centre_of_pressure
    return replace(
        estimate,
        shear=axes.to_image(estimate.shear[::-1]),
        moment=-estimate.moment,
        centre_of_pressure=None if centre is None else axes.to_image(centre[::-1]),
        shear_deviation=axes.deviation_to_image(estimate.shear_deviation[::-1]),
        shear_field=axes.to_image(estimate.shear_field[:, ::-1]),
    )
