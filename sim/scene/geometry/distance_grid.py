"""Signed distance grids of meshes, with a cache on disk.

Signed distances at the nodes of a regular grid are interpolated by a tri-cubic B-spline, which has continuous second
derivatives (sim/csrc/geometry/grid_shape.hpp). Building a grid takes seconds, so grids are cached in $GELFLOW_CACHE or
in the user's cache folder. The cache may be deleted at any time.
"""

import hashlib
import os
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, nearest_points, signed_distances

Array = NDArray[np.float64]

DEFAULT_RESOLUTION = 64
MIN_RESOLUTION, MAX_RESOLUTION = 4, 512
CELLS_PER_ROUNDING = 2  # at least

_VERSION = 1  # of the construction; part of the cache key
_MARGIN = 3  # cells around the mesh
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # of a cell
_PROJECTION_ITERATIONS = 4
_MAX_SWEEPS, _SWEEP_TOLERANCE = 60, 1e-9  # of Hildreth's method; tolerance [m]
_PADDING = 8  # nodes of linear extrapolation, so that boundary effects of the spline filter decay outside the grid


@dataclass(frozen=True)
class DistanceGrid:
    """A signed distance field as a tri-cubic B-spline on a regular grid, in the frame of its mesh."""

    origin: Array  # lowest corner of the first cell [m]
    spacing: float  # edge of a cell [m]
    coefficients: NDArray[np.float32]  # of the B-spline [m], shape cells + 3

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of cells along x, y, z."""
        nx, ny, nz = self.coefficients.shape
        return nx - 3, ny - 3, nz - 3

    @property
    def nbytes(self) -> int:
        """Size in the compiled model [bytes]: the coefficients, and one byte per cell for the broad phase."""
        return self.coefficients.nbytes + int(np.prod(self.cells))


def distance_grid(
    mesh: TriangleMesh, name: str, *, resolution: int = DEFAULT_RESOLUTION, rounding: float = 0.0
) -> DistanceGrid:
    """The distance grid of a mesh, from the cache if possible.

    Parameters
    ----------
    mesh: a closed mesh
    name: of the mesh, for messages
    resolution: number of cells along the longest side
    rounding: radius of convex edges and corners [m]: a morphological opening with a ball of this radius

    Raises UsageError if the mesh is not closed, if the rounding is too large for the mesh or too small for the cells,
    and if libigl is needed and not installed.
    """
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        raise UsageError(f"resolution must be from {MIN_RESOLUTION} to {MAX_RESOLUTION} cells, got {resolution}")
    file = cache_folder() / f"{_key(mesh, resolution, rounding)}.npz"
    if (cached := _read(file)) is not None:
        return cached
    grid = build_grid(mesh, name, resolution=resolution, rounding=rounding)
    _write(file, grid)
    return grid


def build_grid(mesh: TriangleMesh, name: str, *, resolution: int, rounding: float = 0.0) -> DistanceGrid:
    """Like `distance_grid`, without the cache."""
    mesh = closed_mesh(mesh, name)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    spacing = float((high - low).max()) / resolution
    if 0 < rounding < CELLS_PER_ROUNDING * spacing:
        needed = int(np.ceil(CELLS_PER_ROUNDING * float((high - low).max()) / rounding))
        raise UsageError(
            f"mesh {name!r}: a rounding of {rounding:g} m is below {CELLS_PER_ROUNDING} cells of {spacing:.3g} m; "
            f"set resolution = {needed} or more"
        )
    cells = np.ceil((high - low) / spacing - 1e-6).astype(int) + 2 * _MARGIN
    origin = (low + high - cells * spacing) / 2
    nodes = _nodes(origin, spacing, cells + 1)
    distances, nearest = signed_distances(mesh, nodes, name)
    if not (distances < -spacing / 2).any():
        raise UsageError(
            f"mesh {name!r} is thinner than the cells of {spacing:.3g} m of its grid; set a larger resolution"
        )
    if rounding > 0:
        distances = _opened(name, nodes, distances, nearest, cells + 1, spacing, rounding)
    return spline_grid(distances.reshape(cells + 1), origin, spacing)


def spline_grid(distances: Array, origin: Array, spacing: float) -> DistanceGrid:
    """The B-spline that interpolates distances [m] at the corners of cells, shape cells + 1; the first at `origin`."""
    from scipy import ndimage  # deferred: only meshes need it

    padded = np.pad(distances, _PADDING, mode="reflect", reflect_type="odd")
    inner = slice(_PADDING - 1, 1 - _PADDING)
    coefficients = ndimage.spline_filter(padded, order=3, mode="mirror")[inner, inner, inner]
    return DistanceGrid(np.asarray(origin), spacing, np.ascontiguousarray(coefficients, dtype=np.float32))


def _nodes(origin: Array, spacing: float, counts: Array) -> Array:
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _opened(
    name: str,
    nodes: Array,
    distances: Array,
    nearest: Array,
    counts: NDArray[np.int64],
    spacing: float,
    rounding: float,
) -> Array:
    """Distances at the nodes to the morphological opening of the solid: its edges and corners are rounded.

    Inside the solid eroded by the rounding, distances do not change. Outside they are the distance to the eroded solid
    minus the rounding. Marching cubes triangulates the surface of the eroded solid, but cuts off its edges; therefore
    the nearest points are refined with the distances and normals at the nodes around them.
    """
    from skimage import measure

    if not (distances < -rounding).any():
        raise UsageError(
            f"mesh {name!r}: a rounding of {rounding:g} m removes the whole mesh; it must be below half its thickness"
        )
    marching_cubes: Any = measure.marching_cubes
    vertices, faces, *_ = marching_cubes(distances.reshape(counts), -rounding, spacing=(spacing,) * 3)
    eroded = TriangleMesh(vertices.astype(float) + nodes[0], faces.astype(np.int64))
    outside = np.flatnonzero(distances > -rounding)
    x = nodes[outside]
    y = nearest_points(eroded, x, name)
    normals = (nodes - nearest) / np.where(distances == 0, 1, distances)[:, None]
    offsets = distances - (normals * nodes).sum(1)  # plane at each node: distance(p) ≈ normal · p + offset
    start, step = y.copy(), np.zeros(len(x))
    for _ in range(_PROJECTION_ITERATIONS):  # at most one cell per iteration: the planes hold near their nodes only
        first = np.floor((y - nodes[0]) / spacing).astype(int).clip(0, counts - 2)
        around = np.ravel_multi_index(tuple((first[:, None] + _CORNERS).T), tuple(counts)).T
        move = _project(x, normals[around], -rounding - offsets[around]) - y
        step = np.linalg.norm(move, axis=1) / spacing
        y += move / np.maximum(step, 1)[:, None]
    diverged = (step > 0.5) | (np.linalg.norm(y - start, axis=1) > 2 * spacing)
    y[diverged] = start[diverged]
    result = distances.copy()
    result[outside] = np.linalg.norm(x - y, axis=1) - rounding
    return result


def _project(x: Array, normals: Array, bounds: Array) -> Array:
    """Projections of x (n, 3) onto intersections of half spaces: normal · y ≤ bound, (n, k, 3) and (n, k).

    Hildreth's method: dual coordinate ascent, one multiplier at a time.
    """
    y, multipliers = x.copy(), np.zeros_like(bounds)
    active = np.arange(len(x))
    for _ in range(_MAX_SWEEPS):
        largest = np.zeros(len(active))
        for k in range(bounds.shape[1]):
            normal = normals[active, k]
            change = np.maximum((normal * y[active]).sum(1) - bounds[active, k], -multipliers[active, k])
            multipliers[active, k] += change
            y[active] -= change[:, None] * normal
            largest = np.maximum(largest, np.abs(change))
        active = active[largest > _SWEEP_TOLERANCE]
    return y


def cache_folder() -> Path:
    """Folder of the cached grids: $GELFLOW_CACHE, or `gelflow` in the user's cache folder."""
    if folder := os.environ.get("GELFLOW_CACHE"):
        return Path(folder)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "gelflow"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gelflow"


def _key(mesh: TriangleMesh, resolution: int, rounding: float) -> str:
    content = hashlib.sha256(f"{_VERSION} {resolution} {rounding!r} {len(mesh.vertices)}".encode())
    content.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    content.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return "grid-" + content.hexdigest()[:32]


def _read(file: Path) -> DistanceGrid | None:
    """The grid in a cache file; None if the file is missing or invalid."""
    try:
        with np.load(file, allow_pickle=False) as content:
            if int(content["format"]) != 1:
                return None
            grid = DistanceGrid(content["origin"], float(content["spacing"]), content["coefficients"])
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile):
        return None
    c = grid.coefficients
    valid = c.dtype == np.float32 and c.ndim == 3 and min(c.shape) > 2 * _MARGIN and np.isfinite(c).all()
    return grid if valid and grid.origin.shape == (3,) and grid.spacing > 0 else None


def _write(file: Path, grid: DistanceGrid) -> None:
    """Write a cache file atomically. Without write access the grid is not cached."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent) as folder:
            temporary = Path(folder) / file.name
            np.savez(temporary, format=1, origin=grid.origin, spacing=grid.spacing, coefficients=grid.coefficients)
            os.replace(temporary, file)
    except OSError:
        return
