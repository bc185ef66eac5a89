"""Forces on the gel in the axes of an image: right, down, and into the gel."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


class ImageForces:
    """Forces and slip from tracked images of one camera."""

    def __init__(self, gel: ElasticGel, rows: int, cols: int, scale: GridScale) -> None:
        """Raises UsageError for a grid without forces, see `ForceEstimator`."""
        noise = _NOISE_PX / scale.pixels_per_mm * 1e-3
        grid = Grid(rows, cols, scale.pitch_mm)
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
        displacement = displacement_mm[:, ::-1] * 1e-3
        estimate = self._estimator.estimate(displacement, valid, stamp)
        self.slip = self._slip.estimate(estimate, displacement, valid, stamp)
        return None if estimate is None else _exchanged_axes(estimate)


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


def _exchanged_axes(estimate: ForceEstimate) -> ForceEstimate:
    centre = estimate.centre_of_pressure
    return replace(
        estimate,
        shear=estimate.shear[::-1],
        moment=-estimate.moment,
        centre_of_pressure=None if centre is None else centre[::-1],
        shear_deviation=estimate.shear_deviation[::-1],
        shear_field=estimate.shear_field[:, ::-1],
    )
