"""Where a place in a camera's picture lies on the gel: crop, perspective and lens, from one picture of the gel at rest.

The markers are printed on a regular grid of known spacing, so the grid itself is the calibration target. With a
place's offset from the lens's centre in half diagonals of the picture, p = (right, down), its place on the gel is

    (x w, y w, w)ᵀ = matrix (p₁, p₂, 1 + k₁ |p|² + k₂ |p|⁴ + k₃ |p|⁶)ᵀ      [mm]

that is a homography after the division model of a lens (k < 0: barrel). x runs along the lines of the grid to the
right, y down its columns, the origin is the grid's centre. The mapping of a displacement is the difference of two
mapped places: exact, where one scale would be wrong by what the perspective and the lens change over the picture.
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
from gelflow.session.records import from_plain, to_plain

FORMAT = 1

_FEWEST = 16  # markers: with fewer a lens fits noise
_WORST = 0.03  # of the spacing: a fit with larger residuals (root mean square) is no gel at rest
_OUTLIER = 5.0  # times the median residual: a marker farther off was measured wrongly
_EVIDENCE = 10.0  # gain of the Bayesian information criterion for which more of a lens is believed: "very strong"
_OFF_CENTER = 0.5  # half diagonals: a lens's centre farther from the picture's is no lens
_STEPS = 20  # of a fit: it needs less than ten, unless the markers do not determine it
_NEWTON = 12  # steps; they end at rounding long before
_USED = 0.9  # of the seen markers: a fit that leaves out more is no gel at rest either
_EXACT = 1e-3  # [px]: below this no residual tells one model from another

# What may be fitted beside the homography: (radial coefficients, whether the lens's centre is not the picture's).
_MODELS = ((0, False), (1, False), (2, False), (3, False), (1, True), (2, True), (3, True))

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Calibration:
    """The mapping from the pictures of one camera to its gel, and how well it fitted the markers."""

    width: int  # of the pictures [px]
    height: int  # of the pictures [px]
    rows: int  # lines of markers in the picture
    cols: int  # markers in a line
    spacing_mm: float  # of neighbouring markers on the gel at rest
    matrix: tuple[tuple[float, ...], ...]  # 3 × 3, see above
    radial: tuple[float, ...]  # k₁, k₂, k₃: as many of these as the markers determine, or none
    center: tuple[float, float]  # of the lens in the picture (right, down) [px]
    residual_px: float  # root mean square distance of the markers from the fitted grid
    largest_px: float  # largest such distance

    def __post_init__(self) -> None:
        whole = (self.width, self.height, self.rows, self.cols)
        try:
            good = all(type(number) is int and number >= 1 for number in whole)
            good &= np.shape(self.matrix) == (3, 3) and len(self.radial) <= 3 and len(self.center) == 2
            numbers = np.array([*np.ravel(self.matrix), *self.radial, *self.center, self.spacing_mm, self.residual_px])
            good &= numbers.dtype.kind in "if" and bool(np.isfinite(numbers).all())
            good = good and self.spacing_mm > 0 and np.linalg.det(self.matrix) != 0
        except (TypeError, ValueError):
            good = False
        if not good:
            raise UsageError("its numbers are no mapping from a picture to a gel: calibrate the camera anew")

    @cached_property
    def _matrix(self) -> Floats:
        return np.array(self.matrix, dtype=float)

    @property
    def _half_diagonal(self) -> float:
        return float(np.hypot(self.width, self.height)) / 2

    def to_mm(self, places: ArrayLike) -> Floats:
        """Places on the gel (x right, y down) [mm] of places in the picture (right, down) [px], both shape (n, 2)."""
        offset = (np.asarray(places, dtype=float) - self.center) / self._half_diagonal
        homogeneous = np.column_stack([offset, _stretch((offset**2).sum(axis=1), self.radial)]) @ self._matrix.T
        return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])

    def to_pixels(self, places_mm: ArrayLike) -> Floats:
        """The reverse of `to_mm`: [mm] to [px], both shape (n, 2)."""
        offset = _project(np.asarray(np.linalg.inv(self._matrix)), np.asarray(places_mm, dtype=float), self.radial)
        return np.asarray(offset * self._half_diagonal + self.center)

    def displacement_mm(self, position: ArrayLike, displacement: ArrayLike) -> Floats:
        """Displacements [mm] of markers that are at `position` [px] after `displacement` [px], all shape (n, 2)."""
        position = np.asarray(position, dtype=float)
        return self.to_mm(position) - self.to_mm(position - np.asarray(displacement, dtype=float))

    def pixels_per_mm(self) -> tuple[float, float]:
        """The scale at the grid's centre [px/mm]: along its lines, and along its columns."""
        middle, right, down = self.to_pixels(np.array([[0, 0], [0.1, 0], [0, 0.1]]))
        return float(np.linalg.norm(right - middle)) / 0.1, float(np.linalg.norm(down - middle)) / 0.1

    def marker_positions_mm(self) -> Floats:
        """Where the markers are on the gel at rest [mm], shape (rows * cols, 2), line by line."""
        right, down = np.meshgrid(np.arange(self.cols), np.arange(self.rows))
        middle = ((self.cols - 1) / 2, (self.rows - 1) / 2)
        return np.asarray((np.stack([right.ravel(), down.ravel()], axis=1) - middle) * self.spacing_mm)

    def check_size(self, image: Image) -> None:
        """Raises PeerError when `image` has another size than the pictures that this calibration is for."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            raise PeerError(
                f"the calibration is for images of {self.width} × {self.height} px, this one has {width} × {height}: "
                "calibrate the camera as it is used now"
            )

    def rectify(self, image: Image) -> Image:
        """`image` as a camera straight above would see it: the grid and one spacing around it, at the same scale."""
        self.check_size(image)
        scale = max(self.pixels_per_mm())
        size = np.array([self.cols + 1, self.rows + 1]) * self.spacing_mm  # (right, down) [mm]
        right, down = (np.arange(round(length * scale)) / scale - length / 2 for length in size)
        mesh = np.stack(np.meshgrid(right, down), axis=-1)
        places = self.to_pixels(mesh.reshape(-1, 2)).reshape(mesh.shape).astype(np.float32)
        return np.asarray(cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_CUBIC), dtype=np.uint8)


def fit_calibration(
    rest: Floats, seen: NDArray[np.bool_], *, rows: int, cols: int, spacing_mm: float, size: tuple[int, int]
) -> Calibration:
    """The calibration that lays markers at rest onto a regular grid.

    `rest` (right, down) [px], shape (rows * cols, 2), line by line; `seen` says which were measured; `size` (width,
    height) of the picture [px]. Of the lens only what the markers determine is fitted, by the Bayesian information
    criterion. Raises UsageError for an impossible spacing, PeerError when too few markers are seen or no plane
    behind a lens shows them so.
    """
    if not 0.01 <= spacing_mm <= 1000:
        raise UsageError(f"the spacing of the markers must be within 0.01 to 1000 mm, got {spacing_mm}")
    if seen.sum() < _FEWEST:
        raise PeerError(f"{seen.sum()} markers are seen, at least {_FEWEST} are needed: show more of the gel")
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    blank = Calibration(*size, rows, cols, spacing_mm, unit, (), middle, 0.0, 0.0)
    # The lens with everything in it first: a marker that lies far off even that was measured wrongly.
    distance = _distances(_fit(blank, rest, seen, *_MODELS[-1]), rest)
    used = seen & (distance <= max(_OUTLIER * float(np.median(distance[seen])), _EXACT))
    best = _fit(blank, rest, used, *_MODELS[0])
    for coefficients, off_center in _MODELS[1:]:
        if off_center and not best.radial:
            break  # a lens that does nothing has no centre
        fit = _fit(blank, rest, used, coefficients, off_center)
        gain = _criterion(best, _distances(best, rest)[used]) - _criterion(fit, _distances(fit, rest)[used])
        if gain > _EVIDENCE and _unfolded(fit):
            best = fit
    distance = _distances(best, rest)[used]
    residual = float(np.sqrt(np.mean(distance**2)))
    limit = _WORST * spacing_mm * min(best.pixels_per_mm())
    if not residual <= limit or used.sum() < _USED * seen.sum():
        raise PeerError(
            f"the markers do not lie on a regular grid behind a lens: {residual:.2f} px off (root mean square of "
            f"{used.sum()} of {seen.sum()}), at most {limit:.2f} px are believed; is the gel untouched and whole, and "
            "are its markers evenly spaced?"
        )
    return replace(best, residual_px=residual, largest_px=float(distance.max()))


def _fit(blank: Calibration, rest: Floats, used: NDArray[np.bool_], coefficients: int, off_center: bool) -> Calibration:
    """Least squares of the distances in the picture, with so many radial coefficients, and the lens's centre or not."""
    nodes, measured = blank.marker_positions_mm()[used], rest[used]
    half = blank._half_diagonal
    middle = np.array(blank.center)
    plane, _ = cv2.findHomography(nodes, (measured - middle) / half)
    if plane is None:
        raise PeerError("the markers lie on one line: show more of the gel")

    def placed(values: Floats) -> Floats:
        center = values[8 + coefficients :] if off_center else np.zeros(2)
        to_picture = np.append(values[:8], 1.0).reshape(3, 3)
        return _project(to_picture, nodes, values[8 : 8 + coefficients]) + center

    start = np.concatenate([plane.ravel()[:8] / plane[2, 2], np.zeros(coefficients + 2 * off_center)])
    target = (measured - middle) / half
    limits = np.concatenate([np.full(8, np.inf), np.full(coefficients, 2.0), np.full(2 * off_center, _OFF_CENTER)])
    found = least_squares(
        lambda values: (placed(values) - target).ravel(),
        start,
        bounds=(-limits, limits),
        x_scale="jac",
        max_nfev=_STEPS,
    )
    inverse = np.linalg.inv(np.append(found.x[:8], 1.0).reshape(3, 3))
    center = middle + half * found.x[8 + coefficients :] if off_center else middle
    return replace(
        blank,
        matrix=tuple(tuple(map(float, row)) for row in inverse),
        radial=tuple(map(float, found.x[8 : 8 + coefficients])),
        center=(float(center[0]), float(center[1])),
    )


def _project(to_picture: Floats, nodes: Floats, radial: Sequence[float] | Floats) -> Floats:
    """Places on the gel [mm], shape (n, 2), in the picture, from the lens's centre in half diagonals, shape (n, 2)."""
    homogeneous = np.column_stack([nodes, np.ones(len(nodes))]) @ to_picture.T
    straight = homogeneous[:, :2] / homogeneous[:, 2:]
    if len(radial) == 0:
        return np.asarray(straight)
    wanted = np.linalg.norm(straight, axis=1)
    # r = wanted · stretch(r²), by Newton's method from the place without a lens.
    radius = wanted.copy()
    for _ in range(_NEWTON):
        square = radius**2
        slope = wanted * 2 * radius * sum((i + 1) * k * square**i for i, k in enumerate(radial))
        radius -= (radius - wanted * _stretch(square, radial)) / (1 - slope)
    return np.asarray(straight * (radius / np.maximum(wanted, 1e-300))[:, None])


def _stretch(square: Floats, radial: Sequence[float] | Floats) -> Floats:
    """1 + k₁ r² + k₂ r⁴ + … of squared radii."""
    return np.asarray(1.0 + sum((k * square ** (i + 1) for i, k in enumerate(radial)), np.zeros_like(square)))


def _distances(fit: Calibration, rest: Floats) -> Floats:
    """How far each marker lies from its node of the grid [px], shape (markers,)."""
    return np.asarray(np.linalg.norm(fit.to_pixels(fit.marker_positions_mm()) - rest, axis=1))


def _criterion(fit: Calibration, distance: Floats) -> float:
    """The Bayesian information criterion: what a parameter more must gain to be believed."""
    numbers = 2 * len(distance)
    middle = ((fit.width - 1) / 2, (fit.height - 1) / 2)
    parameters = 8 + len(fit.radial) + 2 * (fit.center != middle)
    return float(numbers * np.log(np.mean(distance**2) / 2 + _EXACT**2) + parameters * np.log(numbers))


def _unfolded(fit: Calibration) -> bool:
    """Whether the lens maps the whole picture one to one: the mapped radius r / stretch(r²) grows up to the corners."""
    corners = np.array([[0, 0], [0, fit.height], [fit.width, 0], [fit.width, fit.height]]) - fit.center
    radius = np.linspace(0, np.linalg.norm(corners, axis=1).max() / fit._half_diagonal, 200)
    stretch = _stretch(radius**2, fit.radial)
    return bool((stretch > 0).all() and (np.diff(radius / stretch) > 0).all())


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Writes `calibration` to a new file. Raises UsageError when there is one already, or it can't be written."""
    text = json.dumps({"format": FORMAT, **to_plain(calibration)}, indent=1) + "\n"
    try:
        with Path(path).open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UsageError(f"{path} exists; name a new file") from None
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}; name a file one can write") from None


def load_calibration(path: str | Path) -> Calibration:
    """Reads what `save_calibration` wrote. Raises UsageError when the file is another, newer or damaged one."""
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}; gelflow calibrate-camera makes such a file") from None
    except ValueError:  # of JSON and of UTF-8
        raise UsageError(f"{path} is no calibration: not valid JSON; gelflow calibrate-camera makes one") from None
    written = data.pop("format", None) if isinstance(data, dict) else None
    if type(written) is not int:
        raise UsageError(f"{path} is no calibration: it has no format; gelflow calibrate-camera makes one")
    if written != FORMAT:
        raise UsageError(f"{path} has calibration format {written}; this gelflow reads format {FORMAT}: update gelflow")
    return from_plain(Calibration, data, what=str(path))
