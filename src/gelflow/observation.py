"""The observation format: tactile frames, and the normalized flow map computed from them.

Frames come from the simulator, from tracked markers of camera images, or from a recorded session. Policies receive
flow maps, and every flow map is computed by `normalize`. Axes of each pad: z is the outward normal, x points from the
finger's base to its tip (+rows), y = z × x (+cols). A shear vector is the force of the object on the pad; a marker's
displacement has the same sign. Sensor 0 is the left finger, at the gripper's −x side.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError

Unit = Literal["N", "mm", "px"]

_ON_EDGE = 1e-5  # distance from the hull of the markers, relative to them, up to which a point counts as inside

# Lower limit of the divisor by unit, about three times the noise of the sources with that unit: for N the largest
# marker noise of `Randomization` (1 mN), for mm and px the rest jitter that `gelflow track` reports. It keeps the flow
# map of a frame without contact near zero instead of amplifying the noise.
MIN_DIVISORS: Mapping[str, float] = MappingProxyType({"N": 3e-3, "mm": 0.02, "px": 0.3})


@dataclass(frozen=True)
class Grid:
    """A regular grid of markers on a pad: rows along x (base to tip), columns along y."""

    rows: int
    cols: int
    pitch: float  # distance between neighbours [mm]
    center: tuple[float, float] = (0.0, 0.0)  # (x, y) of the grid's centre on the pad [mm]

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1 or not self.pitch > 0:
            raise UsageError(f"a grid needs rows, cols ≥ 1 and pitch > 0, got {self}")

    def positions(self) -> NDArray[np.float64]:
        """Positions on the pad (x, y) [mm], shape (rows * cols, 2), row by row."""
        x = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch + self.center[0]
        y = (np.arange(self.cols) - (self.cols - 1) / 2) * self.pitch + self.center[1]
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class TactileFrame:
    """Marker vectors of all tactile sensors at one time."""

    shear: NDArray[np.float32]  # in `unit`, shape (sensors, markers, 2): x, y on the pad; NaN where `valid` is False
    valid: NDArray[np.bool_]  # shape (sensors, markers); False for markers that were not measured
    positions: NDArray[np.float32]  # marker positions on the pad at rest [mm], shape (markers, 2)
    stamp: float  # [s]
    unit: Unit
    normal: NDArray[np.float32] | None = None  # in `unit`, shape (sensors, markers), ≥ 0 in compression
    grid: Grid | None = None

    def __post_init__(self) -> None:
        sensors_markers = self.shear.shape[:2]
        if self.shear.ndim != 3 or self.shear.shape[2] != 2:
            raise UsageError(f"shear must have shape (sensors, markers, 2), got {self.shear.shape}")
        if self.valid.shape != sensors_markers or self.valid.dtype != bool:
            got = f"{self.valid.dtype} {self.valid.shape}"
            raise UsageError(f"valid must be an array of bool of shape {sensors_markers}, got {got}")
        if self.positions.shape != (sensors_markers[1], 2):
            raise UsageError(f"positions must have shape ({sensors_markers[1]}, 2), got {self.positions.shape}")
        if self.unit not in MIN_DIVISORS:
            raise UsageError(f"unit must be one of {', '.join(MIN_DIVISORS)}, got {self.unit!r}")


@dataclass(frozen=True)
class FlowMap:
    """The normalized flow map of one attempt, the observation of a policy."""

    image: NDArray[np.float32]  # shape (frames * sensors * 2, rows, cols); largest vector has length ≤ 1
    divisor: float  # of the normalization, in `unit`; keeps the magnitude of the forces
    unit: Unit
    filled: NDArray[np.bool_]  # shape (frames * sensors, rows, cols): True for values interpolated from neighbours


def normalize(shear: Any, reference: Any, *, min_divisor: float) -> tuple[Any, Any]:
    """Normalize marker vectors to a flow map, for NumPy arrays and torch tensors.

    Parameters
    ----------
    shear: any leading batch, then (frames, sensors, rows, cols, 2)
    reference: the frame at rest, same leading batch, (sensors, rows, cols, 2)
    min_divisor: smallest divisor, in the unit of shear, above 0

    Returns
    -------
    image (…, frames * sensors * 2, rows, cols) and divisor (…), by which the difference was divided: the larger of
    `min_divisor` and the longest vector over all frames, sensors and markers together. Differentiable in torch.
    """
    if not min_divisor > 0:
        raise UsageError(f"min_divisor must be above 0, got {min_divisor}")
    flow = shear - reference[..., None, :, :, :, :]
    frames, sensors, rows, cols = flow.shape[-5:-1]
    lead = tuple(flow.shape[:-5])
    squared = (flow * flow).sum(-1).reshape(*lead, frames * sensors * rows * cols)
    # The argument of the square root is never zero, so its gradient is finite at rest.
    largest = squared.max(-1)
    largest = largest if isinstance(largest, np.ndarray | np.generic) else largest.values
    divisor = largest.clip(min_divisor * min_divisor, None) ** 0.5
    image = flow / divisor[..., None, None, None, None, None]
    # (…, frames, sensors, rows, cols, 2) → (…, frames, sensors, 2, rows, cols)
    order = (*range(len(lead)), *(len(lead) + axis for axis in (0, 1, 4, 2, 3)))
    image = image.transpose(order) if isinstance(image, np.ndarray) else image.permute(order)
    return image.reshape(*lead, frames * sensors * 2, rows, cols), divisor


def resampling_weights(positions: ArrayLike, grid: Grid) -> NDArray[np.float64]:
    """Weights of the interpolation of marker values to `grid`: linear between markers, nearest outside their hull.

    `positions` [mm], shape (markers, 2). Returns shape (rows * cols, markers); every row sums to 1. The row of a
    grid point that coincides with a marker selects that marker exactly, so equal grids are unchanged. Raises UsageError
    when the markers of another grid lie on one line.
    """
    points = np.asarray(positions, dtype=float)
    targets = grid.positions()
    weights = np.zeros((len(targets), len(points)))
    distance = np.linalg.norm(targets[:, None] - points[None], axis=-1)
    nearest = distance.argmin(axis=1)
    exact = distance.min(axis=1) < 1e-6 * grid.pitch
    inside = np.full(len(targets), -1)
    if not exact.all() and len(points) >= 3:
        from scipy.spatial import Delaunay, QhullError  # deferred: only different grids need it

        try:
            mesh = Delaunay(points)
        except QhullError:
            raise UsageError(
                f"the {len(points)} markers lie on one line: their values cannot be interpolated to a grid of "
                f"{grid.rows} × {grid.cols} markers"
            ) from None
        # Points on the edge of the hull may lie outside by the rounding of positions in single precision.
        inside = mesh.find_simplex(targets, tol=_ON_EDGE)
    for i, (target, simplex) in enumerate(zip(targets, inside, strict=True)):
        if exact[i] or simplex < 0:
            weights[i, nearest[i]] = 1.0
        else:
            transform = mesh.transform[simplex]
            two = transform[:2] @ (target - transform[2])
            three = np.clip([*two, 1 - two.sum()], 0.0, None)
            weights[i, mesh.simplices[simplex]] = three / three.sum()
    return weights


def interpolation_weights(grid: Grid, positions: ArrayLike) -> NDArray[np.float64]:
    """Weights of the interpolation of values on `grid` to `positions` [mm], shape (n, 2): bilinear.

    The outermost cells continue linearly for one pitch beyond the border, and the values there are constant further
    out. Returns shape (n, rows * cols); every row sums to 1.
    """
    from scipy.interpolate import RegularGridInterpolator  # deferred: only different grids need it

    nodes = grid.positions()
    rows, cols = nodes[:: grid.cols, 0], nodes[: grid.cols, 1]
    each = np.eye(len(nodes)).reshape(grid.rows, grid.cols, -1)
    weights = RegularGridInterpolator((rows, cols), each, bounds_error=False, fill_value=None)
    within = np.clip(positions, nodes.min(0) - grid.pitch, nodes.max(0) + grid.pitch)
    return np.asarray(weights(within))


def fill_invalid(frame: TactileFrame) -> NDArray[np.float64]:
    """Shear of a frame, with invalid markers replaced by the inverse-distance mean of the 6 nearest valid markers.

    Returns shape (sensors, markers, 2). Raises UsageError when a sensor has fewer than 6 valid markers, or a valid one
    that is not finite.
    """
    shear = frame.shear.astype(float)
    for sensor, valid in enumerate(frame.valid):
        if not np.isfinite(shear[sensor, valid]).all():
            raise UsageError(
                f"sensor {sensor} has a valid marker whose shear is not finite; set its flag valid to False"
            )
        if valid.all():
            continue
        if valid.sum() < 6:
            raise UsageError(f"sensor {sensor} has {valid.sum()} valid markers of {valid.size}; at least 6 are needed")
        invalid = np.flatnonzero(~valid)
        distance = np.linalg.norm(frame.positions[invalid, None] - frame.positions[None, valid], axis=-1)
        near = np.argsort(distance, axis=1)[:, :6]
        weight = 1 / np.take_along_axis(distance, near, axis=1)
        values = shear[sensor, valid][near]
        shear[sensor, invalid] = (weight[..., None] * values).sum(1) / weight.sum(1)[:, None]
    return shear


def flow_map(
    frames: Sequence[TactileFrame],
    reference: TactileFrame,
    *,
    grid: Grid,
    min_divisors: Mapping[str, float] = MIN_DIVISORS,
) -> FlowMap:
    """The normalized flow map of `frames` against `reference`, on `grid`.

    Raises UsageError when frames differ in unit, sensors or markers, a sensor has fewer than 6 valid markers, or a
    valid marker is not finite.
    """
    if not frames:
        raise UsageError("a flow map needs at least one frame")
    for frame in frames:
        if frame.unit != reference.unit:
            raise UsageError(f"frames are in {frame.unit!r} but the reference is in {reference.unit!r}")
        if frame.shear.shape != reference.shear.shape:
            raise UsageError(f"a frame has shape {frame.shear.shape}, the reference {reference.shear.shape}")
        if not np.allclose(frame.positions, reference.positions, atol=1e-3):
            raise UsageError("frames and reference have different marker positions")
    weights = resampling_weights(reference.positions, grid)
    sensors = reference.shear.shape[0]

    def on_grid(values: NDArray[np.float64]) -> NDArray[np.float64]:
        resampled: NDArray[np.float64] = np.einsum("gm,smc->sgc", weights, values)
        return resampled.reshape(sensors, grid.rows, grid.cols, 2)

    stack = np.stack([on_grid(fill_invalid(frame)) for frame in frames])
    image, divisor = normalize(stack, on_grid(fill_invalid(reference)), min_divisor=min_divisors[reference.unit])
    used = weights > 0
    interpolated = np.stack([(~(frame.valid & reference.valid))[:, None] & used for frame in frames]).any(-1)
    filled = interpolated.reshape(len(frames) * sensors, grid.rows, grid.cols)
    return FlowMap(image.astype(np.float32), float(divisor), reference.unit, filled)
