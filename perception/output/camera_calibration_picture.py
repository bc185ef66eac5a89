"""Picture of a camera calibration: fitted grid, residuals and rectified image."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.figures import VERMILION, save
from gelflow.perception.camera_calibration import CameraCalibration

_MAGNIFICATION = 20  # of the residuals
_SEGMENTS = 8  # of a grid line between two markers: the lens bends it

Floats = NDArray[np.float64]


def draw_calibration(
    image: NDArray[np.uint8], rest: Floats, measured: NDArray[np.bool_], fit: CameraCalibration, path: Path
) -> None:
    """Draw the image with fitted grid and magnified residuals, and beside it the rectified image.

    `rest` are the marker positions [px], shape (markers, 2), and `measured` selects those that were measured. Raises
    UsageError when the picture cannot be written.
    """
    from matplotlib.figure import Figure  # deferred: slow to import

    figure = Figure(figsize=(13, 6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(image[..., ::-1])
    for line in _grid_lines(fit):
        left.plot(*fit.to_pixels(line).T, color="#56B4E9", linewidth=0.8)
    position = rest[measured]
    residual = position - fit.to_pixels(fit.marker_positions_mm())[measured]
    left.quiver(
        *position.T,
        *(_MAGNIFICATION * residual.T),
        color=VERMILION,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.003,
        zorder=3,
    )
    left.set(xlim=(-0.5, fit.width - 0.5), ylim=(fit.height - 0.5, -0.5), xticks=[], yticks=[])
    left.set_title(
        f"residual of the fitted grid: {fit.residual_px:.2f} px rms; arrows: residuals × {_MAGNIFICATION}", fontsize=10
    )
    right.imshow(fit.rectify(image)[..., ::-1], extent=_extent(fit))
    right.set(
        xlabel="x (right) [mm]",
        ylabel="y (down) [mm]",
        title="rectified image: straight, equally spaced rows and columns",
    )
    right.title.set_fontsize(10)
    save(figure, path, dpi=110)


def _grid_lines(fit: CameraCalibration) -> list[Floats]:
    """Rows and columns of the grid [mm], each of shape (points, 2)."""
    markers = fit.marker_positions_mm().reshape(fit.rows, fit.cols, 2)
    ends = [(row[0], row[-1], fit.cols) for row in markers]
    ends += [(column[0], column[-1], fit.rows) for column in markers.swapaxes(0, 1)]
    return [np.asarray(np.linspace(first, last, _SEGMENTS * count)) for first, last, count in ends]


def _extent(fit: CameraCalibration) -> tuple[float, ...]:
    """Left, right, bottom and top of the rectified image [mm]."""
    across, down = (fit.cols + 1) * fit.spacing_mm / 2, (fit.rows + 1) * fit.spacing_mm / 2
    return -across, across, down, -down
