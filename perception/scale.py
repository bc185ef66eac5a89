"""Check of the scale of a camera: the spacing of its markers at rest against their printed pitch."""

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.perception.calibration import Calibration
from gelflow.perception.frames import CameraMount
from gelflow.perception.tracker import TrackingResult

# Largest difference of the spacing from the pitch, relative to the pitch. A uniform scale at the centre of the image
# differs from the median over the grid by at most 5 % for a tilt of 8° about both axes, seen from 25 mm or more, and a
# lens that moves the corners by 10 %.
TOLERANCE = 0.1

Floats = NDArray[np.float64]


def neighbour_spacing(position: Floats, valid: NDArray[np.bool_], rows: int, cols: int) -> tuple[float, float]:
    """Median distance of valid neighbours within a row and within a column, in the unit of `position`.

    `position` has shape (rows * cols, 2), `valid` (rows * cols,). NaN in a direction without valid neighbours.
    """
    grid, known = position.reshape(rows, cols, 2), valid.reshape(rows, cols)
    medians = []
    for axis in (1, 0):
        first, last = slice(None, -1), slice(1, None)
        both = known[:, first] & known[:, last] if axis == 1 else known[first] & known[last]
        distance = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)[both]
        medians.append(float(np.median(distance)) if len(distance) else float("nan"))
    return medians[0], medians[1]


def check_scale(mount: CameraMount, rest: TrackingResult) -> None:
    """Raise UsageError when the scale of `mount` does not give the printed pitch for the markers `rest`, at rest.

    The median spacing within rows and within columns must each be within 10 % of the pitch. A mount without a scale
    passes. The rotation of a camera by 180° and its mirroring cannot be checked with one image.
    """
    if mount.calibration is not None:
        _check_calibration(mount.calibration, rest, mount.pitch)
        return
    if mount.pixels_per_mm is None:
        return
    pixels = neighbour_spacing(rest.position, rest.valid, rest.rows, rest.cols)
    scales = [spacing / mount.pitch for spacing in pixels]  # [px/mm]
    if all(_agree(scale, mount.pixels_per_mm) for scale in scales):
        return
    fitting = float(np.sqrt(scales[0] * scales[1]))
    if all(_agree(scale, fitting) for scale in scales):
        advice = f"pixels_per_mm = {fitting:.4g} would fit"
    else:
        advice = "no single pixels_per_mm fits both directions: calibrate the camera"
    raise UsageError(
        f"neighbouring markers are {pixels[0]:.1f} px apart in a row and {pixels[1]:.1f} px in a column, but "
        f"pitch {mount.pitch:g} mm × {mount.pixels_per_mm:g} px/mm is {mount.pitch * mount.pixels_per_mm:.4g} px: "
        f"{advice}"
    )


def _check_calibration(calibration: Calibration, rest: TrackingResult, pitch: float) -> None:
    """Raise UsageError when the calibration does not give `pitch` [mm] as the spacing of the markers `rest`."""
    spacing = neighbour_spacing(calibration.to_mm(rest.position), rest.valid, rest.rows, rest.cols)
    if not all(_agree(one, pitch) for one in spacing):
        raise UsageError(
            f"by the calibration neighbouring markers are {spacing[0]:.3f} mm apart in a row and {spacing[1]:.3f} mm "
            f"in a column, but their pitch is {pitch:g} mm: calibrate the camera in its present position"
        )


def _agree(value: float, expected: float) -> bool:
    return abs(value / expected - 1) <= TOLERANCE
