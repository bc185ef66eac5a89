"""Camera calibration: the mapping from image positions to gel positions, from one image of the gel at rest.

The printed markers form a regular grid of known spacing and serve as the calibration target. For an image position with
offset p = (right, down) from the lens centre, in half diagonals of the image, the position on the gel is

    (x w, y w, w)ᵀ = matrix (p₁, p₂, 1 + k₁ |p|² + k₂ |p|⁴ + k₃ |p|⁶)ᵀ      [mm]

which is a homography after the division model of lens distortion (Fitzgibbon 2001; k < 0: barrel). x points right along
the rows of the grid, y down along its columns; the origin is the grid centre. A displacement maps to the difference of
two mapped positions, which includes the variation of the scale by perspective and distortion.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from gelflow.errors import PeerError, UsageError
from gelflow.perception.scale_error import scale_error
from gelflow.session.records import from_plain, to_plain

FORMAT = 1

_SPACINGS = 0.01, 1000  # of markers [mm]
_MIN_MARKERS = 16  # fewer markers do not determine a lens
_MAX_RESIDUAL = 0.1  # root mean square residual of a gel at rest / marker spacing
_MAX_SCALE_ERROR = 0.025  # relative, of lengths on the gel
_OUTLIER = 5.0  # residual of an outlier / median residual
_EVIDENCE = 10.0  # decrease of the Bayesian information criterion that justifies a larger model ("very strong")
_MAX_OFF_CENTER = 0.5  # largest distance of the lens centre from the image centre [half diagonals]
_MAX_EVALUATIONS = 20  # of a fit; a well-determined fit needs less than ten
_NEWTON_STEPS = 12  # of the inverse distortion; it converges earlier
_READING = 1.0  # standard deviation of a point that is read in an image, along one axis [px]
_MIN_INLIERS = 0.9  # fraction of inliers among the visible markers
_EXACT = 1e-3  # [px]: residuals below do not discriminate models

# Lens models: (number of radial coefficients, whether the lens centre is fitted).
_MODELS = ((0, False), (1, False), (2, False), (3, False), (1, True), (2, True), (3, True))

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class CameraCalibration:
    """The mapping from image positions of one camera to positions on its gel, and its residuals."""

    width: int  # of the images [px]
    height: int  # of the images [px]
    rows: int  # rows of markers in the image
    cols: int  # markers in a row
    spacing_mm: float  # of neighbouring markers on the gel at rest
    matrix: tuple[tuple[float, ...], ...]  # 3 × 3, see the module docstring
    radial: tuple[float, ...]  # up to three coefficients k₁, k₂, k₃
    center: tuple[float, float]  # lens centre in the image (right, down) [px]
    residual_px: float  # root mean square distance of the markers from the fitted grid
    largest_px: float  # largest distance of a marker from the fitted grid
    skipped: tuple[int, int, int, int] = (0, 0, 0, 0)  # printed lines not in the image: above, below, left, right
    # Relative standard deviation of a length on the gel, due to an uneven print. None: the file does not contain it.
    scale_error: float | None = None
    # Share of the residuals' variance that changes slowly over the image, 0 to 1: a stretched print or a touched gel.
    smooth_share: float | None = None

    def __post_init__(self) -> None:
        whole = (self.width, self.height, self.rows, self.cols)
        try:
            good = all(type(number) is int and number >= 1 for number in whole)
            good &= len(self.skipped) == 4 and all(type(number) is int and number >= 0 for number in self.skipped)
            good &= np.shape(self.matrix) == (3, 3) and len(self.radial) <= 3 and len(self.center) == 2
            derived = (self.residual_px, self.scale_error or 0.0, self.smooth_share or 0.0)
            numbers = np.array([*np.ravel(self.matrix), *self.radial, *self.center, self.spacing_mm, *derived])
            good &= numbers.dtype.kind in "if" and bool(np.isfinite(numbers).all())
            good = good and self.spacing_mm > 0 and np.linalg.det(self.matrix) != 0
        except (TypeError, ValueError):
            good = False
        if not good:
            raise UsageError("its values are not a valid image-to-gel mapping: calibrate the camera again")

    @property
    def printed_grid(self) -> tuple[int, int]:
        """(rows, columns) of the printed grid in the orientation of the image, lines outside the image included."""
        above, below, left, right = self.skipped
        return self.rows + above + below, self.cols + left + right

    @cached_property
    def _matrix(self) -> Floats:
        return np.array(self.matrix, dtype=float)

    @property
    def _half_diagonal(self) -> float:
        return float(np.hypot(self.width, self.height)) / 2

    def to_mm(self, positions: ArrayLike) -> Floats:
        """Gel positions (x right, y down) [mm] of image positions (right, down) [px], both of shape (n, 2)."""
        offset = (np.asarray(positions, dtype=float) - self.center) / self._half_diagonal
        homogeneous = np.column_stack([offset, _stretch((offset**2).sum(axis=1), self.radial)]) @ self._matrix.T
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])

    def to_pixels(self, positions_mm: ArrayLike) -> Floats:
        """Inverse of `to_mm`: image positions [px] of gel positions [mm], both of shape (n, 2)."""
        offset = _project(np.asarray(np.linalg.inv(self._matrix)), np.asarray(positions_mm, dtype=float), self.radial)
        return np.asarray(offset * self._half_diagonal + self.center)

    def displacement_mm(self, position: ArrayLike, displacement: ArrayLike) -> Floats:
        """Displacements [mm] of markers at `position` [px] with `displacement` [px] from rest, all of shape (n, 2)."""
        position = np.asarray(position, dtype=float)
        return self.to_mm(position) - self.to_mm(position - np.asarray(displacement, dtype=float))

    def pixels_per_mm(self) -> tuple[float, float]:
        """Scale at the grid centre [px/mm], along rows and along columns."""
        middle, right, down = self.to_pixels(np.array([[0, 0], [0.1, 0], [0, 0.1]]))
        return float(np.linalg.norm(right - middle)) / 0.1, float(np.linalg.norm(down - middle)) / 0.1

    def marker_positions_mm(self) -> Floats:
        """Marker positions on the gel at rest [mm], shape (rows * cols, 2), row by row."""
        right, down = np.meshgrid(np.arange(self.cols), np.arange(self.rows))
        middle = ((self.cols - 1) / 2, (self.rows - 1) / 2)
        return np.asarray((np.stack([right.ravel(), down.ravel()], axis=1) - middle) * self.spacing_mm)

    def marker_pixels(self, row: float, col: float) -> Floats:
        """Image position [px], shape (2,), at rest, of a marker by its row and column in the printed grid, from 0."""
        above, _, left, _ = self.skipped
        offset = (col - left - (self.cols - 1) / 2, row - above - (self.rows - 1) / 2)
        return np.asarray(self.to_pixels(self.spacing_mm * np.array([offset]))[0])

    def check_size(self, image: Image) -> None:
        """Raises PeerError when `image` does not have the size of this calibration."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            raise PeerError(
                f"the calibration is for images of {self.width} × {self.height} px, this one has {width} × {height}: "
                "calibrate the camera with its current settings"
            )

    def rectify(self, image: Image) -> Image:
        """`image` mapped to a fronto-parallel view of the grid with a border of one spacing, at uniform scale."""
        self.check_size(image)
        scale = max(self.pixels_per_mm())
        size = np.array([self.cols + 1, self.rows + 1]) * self.spacing_mm  # (right, down) [mm]
        right, down = ((np.arange(round(length * scale)) + 0.5) / scale - length / 2 for length in size)
        mesh = np.stack(np.meshgrid(right, down), axis=-1)
        positions = self.to_pixels(mesh.reshape(-1, 2)).reshape(mesh.shape).astype(np.float32)
        return np.asarray(cv2.remap(image, positions[..., 0], positions[..., 1], cv2.INTER_CUBIC), dtype=np.uint8)


def fit_calibration(
    rest: Floats, visible: NDArray[np.bool_], *, rows: int, cols: int, spacing_mm: float, size: tuple[int, int]
) -> CameraCalibration:
    """Fits the calibration that maps the markers at rest to a regular grid.

    Parameters
    ----------
    rest: marker positions (right, down) [px], shape (rows * cols, 2), row by row
    visible: which markers were measured, shape (rows * cols,)
    rows, cols: shape of the grid in the image
    spacing_mm: marker spacing on the gel [mm]
    size: width and height of the image [px]

    The Bayesian information criterion selects the lens model. Raises UsageError for an invalid spacing, PeerError when
    too few markers are visible or the residuals are too large.
    """
    if not _SPACINGS[0] <= spacing_mm <= _SPACINGS[1]:
        raise UsageError(f"the marker spacing must be within {_SPACINGS[0]} to {_SPACINGS[1]} mm, got {spacing_mm}")
    if visible.sum() < _MIN_MARKERS:
        raise PeerError(
            f"{visible.sum()} markers are visible, at least {_MIN_MARKERS} are required: show more of the gel"
        )
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    initial = CameraCalibration(*size, rows, cols, spacing_mm, unit, (), middle, 0.0, 0.0)
    # Outliers are markers with a large residual even under the largest model.
    distance = _distances(_fit(initial, rest, visible, *_MODELS[-1]), rest)
    inliers = visible & (distance <= max(_OUTLIER * float(np.median(distance[visible])), _EXACT))
    best = _fit(initial, rest, inliers, *_MODELS[0])
    for coefficients, off_center in _MODELS[1:]:
        if off_center and not best.radial:
            break  # without distortion the lens centre is undetermined
        fit = _fit(initial, rest, inliers, coefficients, off_center)
        gain = _criterion(best, _distances(best, rest)[inliers]) - _criterion(fit, _distances(fit, rest)[inliers])
        if gain > _EVIDENCE and _is_one_to_one(fit):
            best = fit
    return _checked(best, rest, visible, inliers)


def scale_by_ruler(
    fit: CameraCalibration, points: Floats, length_mm: float, *, pixel: float = 1.0
) -> CameraCalibration:
    """`fit` with the scale at which two image points (2, 2) [px] are `length_mm` apart on the gel.

    `scale_error` of the result includes the error of reading each point to one pixel of the image in which they were
    read. `pixel` is the size of such a pixel in pixels of `fit`: below 1 if `fit` belongs to a reduced image. Raises
    UsageError for points outside the image or too close to each other, and for an invalid length or spacing.
    """
    if not ((points >= -0.5) & (points <= np.array([fit.width, fit.height]) - 0.5)).all():
        raise UsageError(f"the points of the ruler must be in the image of {fit.width} × {fit.height} px")
    if not 0 < length_mm < np.inf:
        raise UsageError(f"the length on the ruler must be above 0 mm, got {length_mm:g}")
    pixels = float(np.linalg.norm(points[1] - points[0]))
    reading = np.sqrt(2) * _READING * pixel / max(pixels, 1e-9)
    error = float(np.hypot(fit.scale_error or 0.0, reading))
    if error > _MAX_SCALE_ERROR:
        raise UsageError(
            f"the points of the ruler are {pixels / pixel:.0f} px apart, and reading them makes the scale uncertain by "
            f"{100 * error:.1f} %, limit {100 * _MAX_SCALE_ERROR:g} %: choose points further apart"
        )
    (first, last) = fit.to_mm(points)
    factor = length_mm / float(np.linalg.norm(last - first))
    spacing = factor * fit.spacing_mm
    if not _SPACINGS[0] <= spacing <= _SPACINGS[1]:
        raise UsageError(f"by the ruler, markers are {spacing:g} mm apart: check its points [px] and length [mm]")
    x, y, w = fit.matrix
    matrix = (tuple(factor * value for value in x), tuple(factor * value for value in y), w)
    return replace(fit, spacing_mm=spacing, matrix=matrix, scale_error=error)


def _checked(
    fit: CameraCalibration, rest: Floats, visible: NDArray[np.bool_], inliers: NDArray[np.bool_]
) -> CameraCalibration:
    """`fit` with its residuals. Raises PeerError when they are too large."""
    distance, pixels = _distances(fit, rest)[inliers], fit.spacing_mm * min(fit.pixels_per_mm())
    nodes = fit.marker_positions_mm()[inliers]
    uneven = (fit.to_mm(rest[inliers]) - nodes) / fit.spacing_mm
    error, smooth = scale_error(nodes / fit.spacing_mm, uneven, degree=3 if fit.radial else 2)
    residual = float(np.sqrt(np.mean(distance**2)))
    if residual > _MAX_RESIDUAL * pixels or inliers.sum() < _MIN_INLIERS * visible.sum():
        raise PeerError(
            f"the markers do not form a regular grid behind a lens: root mean square residual {residual:.2f} px of "
            f"{inliers.sum()} of {visible.sum()} markers, limit {_MAX_RESIDUAL * pixels:.2f} px; check that the gel is "
            "undamaged and without contact, and its markers evenly spaced"
        )
    if error > _MAX_SCALE_ERROR:
        raise PeerError(
            f"the grid of markers is distorted: the scale is uncertain by {100 * error:.1f} %, limit "
            f"{100 * _MAX_SCALE_ERROR:g} %; check that the gel is undamaged and without contact"
        )
    return replace(fit, residual_px=residual, largest_px=float(distance.max()), scale_error=error, smooth_share=smooth)


def _fit(
    initial: CameraCalibration, rest: Floats, inliers: NDArray[np.bool_], coefficients: int, off_center: bool
) -> CameraCalibration:
    """Least-squares fit of the image positions, with `coefficients` radial ones and optionally the lens centre."""
    nodes, measured = initial.marker_positions_mm()[inliers], rest[inliers]
    half = initial._half_diagonal
    middle = np.array(initial.center)
    plane, _ = cv2.findHomography(nodes, (measured - middle) / half)
    if plane is None:
        raise PeerError("the markers lie on one line: show more of the gel")

    def projected(values: Floats) -> Floats:
        center = values[8 + coefficients :] if off_center else np.zeros(2)
        to_picture = np.append(values[:8], 1.0).reshape(3, 3)
        return _project(to_picture, nodes, values[8 : 8 + coefficients]) + center

    start = np.concatenate([plane.ravel()[:8] / plane[2, 2], np.zeros(coefficients + 2 * off_center)])
    target = (measured - middle) / half
    limits = np.concatenate([np.full(8, np.inf), np.full(coefficients, 2.0), np.full(2 * off_center, _MAX_OFF_CENTER)])
    solution = least_squares(
        lambda values: (projected(values) - target).ravel(),
        start,
        bounds=(-limits, limits),
        x_scale="jac",
        max_nfev=_MAX_EVALUATIONS,
    )
    inverse = np.linalg.inv(np.append(solution.x[:8], 1.0).reshape(3, 3))
    center = middle + half * solution.x[8 + coefficients :] if off_center else middle
    return replace(
        initial,
        matrix=tuple(tuple(map(float, row)) for row in inverse),
        radial=tuple(map(float, solution.x[8 : 8 + coefficients])),
        center=(float(center[0]), float(center[1])),
    )


def _project(to_picture: Floats, nodes: Floats, radial: Sequence[float] | Floats) -> Floats:
    """Image offsets from the lens centre [half diagonals] of gel positions [mm], both of shape (n, 2)."""
    homogeneous = np.column_stack([nodes, np.ones(len(nodes))]) @ to_picture.T
    offset = homogeneous[:, :2] / homogeneous[:, 2:]
    if len(radial) == 0:
        return np.asarray(offset)
    undistorted = np.linalg.norm(offset, axis=1)
    # Newton's method for r = undistorted · stretch(r²), starting from the undistorted radius.
    radius = undistorted.copy()
    for _ in range(_NEWTON_STEPS):
        square = radius**2
        slope = undistorted * 2 * radius * sum((i + 1) * k * square**i for i, k in enumerate(radial))
        radius -= (radius - undistorted * _stretch(square, radial)) / (1 - slope)
    return np.asarray(offset * (radius / np.maximum(undistorted, 1e-300))[:, None])


def _stretch(square: Floats, radial: Sequence[float] | Floats) -> Floats:
    """1 + k₁ r² + k₂ r⁴ + … of squared radii."""
    return np.asarray(1.0 + sum((k * square ** (i + 1) for i, k in enumerate(radial)), np.zeros_like(square)))


def _distances(fit: CameraCalibration, rest: Floats) -> Floats:
    """Distance of each marker from its grid node [px], shape (markers,)."""
    return np.asarray(np.linalg.norm(fit.to_pixels(fit.marker_positions_mm()) - rest, axis=1))


def _criterion(fit: CameraCalibration, distance: Floats) -> float:
    """Bayesian information criterion of a fit with the given residuals."""
    numbers = 2 * len(distance)
    middle = ((fit.width - 1) / 2, (fit.height - 1) / 2)
    parameters = 8 + len(fit.radial) + 2 * (fit.center != middle)
    return float(numbers * np.log(np.mean(distance**2) / 2 + _EXACT**2) + parameters * np.log(numbers))


def _is_one_to_one(fit: CameraCalibration) -> bool:
    """Whether the distortion is one-to-one in the image: r / stretch(r²) increases up to the corners."""
    corners = np.array([[0, 0], [0, fit.height], [fit.width, 0], [fit.width, fit.height]]) - fit.center
    radius = np.linspace(0, np.linalg.norm(corners, axis=1).max() / fit._half_diagonal, 200)
    stretch = _stretch(radius**2, fit.radial)
    return bool((stretch > 0).all() and (np.diff(radius / stretch) > 0).all())


def save_calibration(calibration: CameraCalibration, path: str | Path) -> None:
    """Writes `calibration` to a new JSON file. Raises UsageError when it exists or cannot be written."""
    text = json.dumps({"format": FORMAT, **to_plain(calibration)}, indent=1) + "\n"
    try:
        with Path(path).open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UsageError(f"{path} exists; name a new file") from None
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}; name a writable file") from None


def load_calibration(path: str | Path) -> CameraCalibration:
    """Reads a file that `save_calibration` wrote. Raises UsageError for foreign, newer and damaged files."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(
            f"cannot read {path}: {error.strerror}; gelflow calibrate-camera creates such a file"
        ) from None
    except (ValueError, RecursionError):  # of JSON and of UTF-8
        raise UsageError(f"{path} is not a calibration: invalid JSON; gelflow calibrate-camera creates one") from None
    written = data.pop("format", None) if isinstance(data, dict) else None
    if type(written) is not int:
        raise UsageError(f"{path} is not a calibration: it has no format; gelflow calibrate-camera creates one")
    if written != FORMAT:
        raise UsageError(f"{path} has calibration format {written}; this gelflow reads format {FORMAT}: update gelflow")
    return from_plain(CameraCalibration, data, what=str(path))
