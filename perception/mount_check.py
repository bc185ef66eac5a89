"""Checks of a camera's mount with an image at rest: the scale, and which lines of the printed grid are visible."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.perception.camera_calibration import CameraCalibration
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.frames import CameraMount
from gelflow.perception.grid_detection.grid import find_extent
from gelflow.perception.grid_detection.grid_part import GridExtent, Polarity, Skipped
from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackingResult

# Largest difference of the spacing from the pitch, relative to the pitch. A uniform scale at the centre of the image
# differs from the median over the grid by at most 5 % for a tilt of 8° about both axes, seen from 25 mm or more, and a
# lens that moves the corners by 10 %.
TOLERANCE = 0.1
_SPACINGS = (0.01, 50.0)  # between which markers may be apart [mm]; a scale in mm/px gives more
_ROW_TOLERANCE = 0.4  # of the distance of a marker from its calibrated position / pitch; at 0.5 rows are exchanged
_MIN_VISIBLE = 0.8  # fraction of valid markers of the visible part, at rest
_MIN_PART = 0.4  # smallest visible part of the printed grid for which the success of the policy was measured
_MAX_CHOICES = 4  # possible ranges that a message lists

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
        check_calibrated_scale(mount.calibration, rest)
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


def check_one_spacing(rest: TrackingResult) -> None:
    """Raise UsageError when the spacings of the markers within rows and within columns differ by more than 10 %."""
    in_row, in_column = neighbour_spacing(rest.position, rest.valid, rest.rows, rest.cols)
    if max(in_row, in_column) > (1 + TOLERANCE) * min(in_row, in_column):
        raise UsageError(
            f"neighbouring markers are {in_row:.1f} px apart in a row and {in_column:.1f} px in a column: forces need "
            "markers with one spacing, seen from the front"
        )


def check_uniform_scale(pixels_per_mm: float, spacing: float, pitch: float = 0.0) -> None:
    """Raise UsageError when the spacing of the markers [px] by a uniform scale is impossible, or not the pitch [mm].

    It must be within 0.01 to 50 mm, and within 10 % of the pitch, which is 0 where it is not known.
    """
    smallest, largest = _SPACINGS
    if not smallest * pixels_per_mm <= spacing <= largest * pixels_per_mm:
        raise UsageError(
            f"a scale of {pixels_per_mm:g} px/mm is impossible for markers {spacing:.1f} px apart: their spacing must "
            f"be within {smallest:g} to {largest:g} mm; correct --pixels-per-mm"
        )
    if pitch and not _agree(spacing / pixels_per_mm, pitch):
        raise UsageError(
            f"markers {spacing:.1f} px apart are {spacing / pixels_per_mm:.3g} mm apart by a scale of "
            f"{pixels_per_mm:g} px/mm, but the pitch of the profile is {pitch:g} mm: --pixels-per-mm "
            f"{spacing / pitch:.4g} would fit"
        )


def check_calibrated_scale(calibration: CameraCalibration, rest: TrackingResult) -> None:
    """Raise UsageError when the calibration does not give its spacing, within 10 %, for the markers `rest`, at rest."""
    spacing = neighbour_spacing(calibration.to_mm(rest.position), rest.valid, rest.rows, rest.cols)
    if not all(_agree(one, calibration.spacing_mm) for one in spacing):
        raise UsageError(
            f"by the calibration neighbouring markers are {spacing[0]:.3f} mm apart in a row and {spacing[1]:.3f} mm "
            f"in a column, but their pitch is {calibration.spacing_mm:g} mm: calibrate the camera in its present "
            "position"
        )


def _agree(value: float, expected: float) -> bool:
    return abs(value / expected - 1) <= TOLERANCE


@dataclass(frozen=True)
class VisiblePart:
    """The lines of a printed grid that an image shows, in the orientation of the image."""

    rows: int  # of the printed grid
    cols: int  # of the printed grid
    skipped: Skipped
    anchor: tuple[float, float]  # as in `GridRequest`

    @classmethod
    def of_calibration(cls, calibration: CameraCalibration) -> "VisiblePart":
        """The part that a camera showed when it was calibrated."""
        above, _, left, _ = calibration.skipped
        right, down = calibration.marker_pixels(above + calibration.rows // 2, left + calibration.cols // 2).tolist()
        return cls(*calibration.printed_grid, calibration.skipped, (right, down))

    @property
    def lines(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and last visible row, from 1 at the top of the image, and first and last column, from 1 at its left."""
        above, below, left, right = self.skipped
        return (above + 1, self.rows - below), (left + 1, self.cols - right)

    @property
    def shape(self) -> tuple[int, int]:
        """Visible (rows, columns)."""
        above, below, left, right = self.skipped
        return self.rows - above - below, self.cols - left - right

    def tracker_config(self, polarity: Polarity = "auto") -> TrackerConfig:
        """Tracker configuration for this part."""
        anchor = self.anchor if any(self.skipped) else None
        return TrackerConfig(*self.shape, either_way=False, polarity=polarity, skipped=self.skipped, anchor=anchor)


def find_visible_part(
    image: NDArray[np.uint8], rows: int, cols: int, *, either_way: bool = True, polarity: Polarity = "auto"
) -> list[VisiblePart]:
    """The possible visible parts of a printed grid of `rows` × `cols` in `image` (B G R), likely ones first.

    There are several where the image border cuts lines off on a side that the image does not identify, and none where
    the image shows another grid. The transposed grid is also considered with `either_way`. Raises TrackerInitError
    when no grid is found.
    """
    extent = find_extent(image, polarity)
    shapes = {(rows, cols), (cols, rows)} if either_way else {(rows, cols)}
    parts = [
        VisiblePart(*shape, skipped, extent.middle)
        for shape in sorted(shapes, reverse=(rows, cols) > (cols, rows))
        for skipped in extent.possible_skips(*shape)
    ]
    # A camera usually looks at the middle of the grid.
    return sorted(parts, key=lambda part: abs(np.diff(np.reshape(part.skipped, (2, 2)))).sum())


def start_at_rest(mount: CameraMount, image: NDArray[np.uint8]) -> TrackingResult:
    """The markers in `image` (B G R) of the gel at rest, found as `mount` describes them.

    Raises PeerError when the visible part is less than 40 % of the printed grid, or fewer than 80 % of its markers are
    measured, with the lines for the lab file where the image shows another part. Raises UsageError for a wrong scale.
    """
    count, printed = mount.visible_count, mount.rows * mount.cols
    if count < _MIN_PART * printed:
        raise PeerError(
            f"the image shows {count} of {printed} markers, at least {_MIN_PART:.0%} are required: move the camera"
        )
    try:
        rest = MarkerTracker(mount.tracker_config()).start(image)
    except TrackerInitError as error:
        raise PeerError(f"{error}; {_advice(mount, image)}") from None
    visible = int(rest.valid.sum())
    if visible < _MIN_VISIBLE * mount.visible_count:
        raise PeerError(f"{visible} of {mount.visible_count} markers are visible; {_advice(mount, image)}")
    check_scale(mount, rest)
    return rest


def _advice(mount: CameraMount, image: NDArray[np.uint8]) -> str:
    """The lab file's keys for the part of the printed grid that an image shows, if it is another one than stated.

    Raises TrackerInitError when the image shows no grid at all.
    """
    extent = find_extent(image)
    if (extent.rows, extent.cols) == mount.image_grid:
        return "check the gel, its light and the camera"
    skips = extent.possible_skips(*mount.printed_grid)
    if mount.calibration is not None:
        skips = [skipped for skipped in skips if _is_calibrated_part(mount.calibration, extent, skipped)]
    choices = [mount.pad_lines(skipped) for skipped in skips]
    if not choices:
        rows, cols = mount.printed_grid
        return f"it shows {extent.rows} rows of {extent.cols} markers, which is no part of {rows} rows of {cols}"
    lines = [f"visible_rows = {list(rows)} and visible_cols = {list(cols)}" for rows, cols in choices]
    several = ", or ".join(lines[:_MAX_CHOICES]) + (", or …" if len(lines) > _MAX_CHOICES else "")
    text = f"write {several} in the lab file"
    if len(lines) > 1:
        text = f"the image does not show which lines are outside: look at the gel and {text}"
    if mount.calibration is None:
        rows, cols = mount.printed_grid
        text += f", or calibrate the camera with gelflow calibrate-camera --rows {rows} --cols {cols}"
    return text


def _is_calibrated_part(calibration: CameraCalibration, extent: GridExtent, skipped: Skipped) -> bool:
    """Whether the middle marker of a part is at its calibrated position."""
    position = calibration.marker_pixels(skipped[0] + extent.rows // 2, skipped[2] + extent.cols // 2)
    off = calibration.to_mm(np.array([extent.middle, position]))
    return float(np.linalg.norm(off[0] - off[1])) < _ROW_TOLERANCE * calibration.spacing_mm


def lines_text(lines: tuple[tuple[int, int], tuple[int, int]], rows: int, cols: int) -> str:
    """The visible rows and columns of a printed grid."""
    (first_row, last_row), (first_col, last_col) = lines
    return f"rows {first_row}-{last_row} of {rows}, columns {first_col}-{last_col} of {cols}"


def visible_text(mount: CameraMount, rest: TrackingResult) -> str:
    """The number of measured markers, and the visible lines of the printed grid."""
    count, total = int(rest.valid.sum()), mount.rows * mount.cols
    return f"{count} of {total} markers: {lines_text(mount.pad_lines(mount.skipped), mount.rows, mount.cols)}"
