"""The distance grid of a mesh: what makes it a shape that can be touched.

Signed distances at the nodes of a regular grid become the coefficients of a tri-cubic B-spline, which goes through
them all and has continuous second derivatives (grid_shape.hpp). Building takes seconds, so grids are kept in
a folder of the user: $GELFLOW_CACHE, or the system's place for such things. The folder may be deleted at any time.
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
from scipy import ndimage

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, nearest_points, signed_distances

Array = NDArray[np.float64]

DEFAULT_RESOLUTION = 64
MIN_RESOLUTION, MAX_RESOLUTION = 4, 512
CELLS_PER_ROUNDING = 2  # at least

_VERSION = 1  # of how a grid is built: with it old grids in the cache are passed over
_MARGIN = 3  # cells around the mesh
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # of a cell
_LOOKS = 4
_PUSHES, _SETTLED = 60, 1e-9  # rounds at most; [m] that none of a round's moves is longer than
_PAD = 8  # nodes beyond those, straight on: the filter forgets the end of the grid on the way


@dataclass(frozen=True)
class DistanceGrid:
    """A signed distance as a tri-cubic B-spline on a regular grid, in the frame of its mesh."""

    origin: Array  # lowest corner of the first cell [m]
    spacing: float  # edge of a cell [m]
    coefficients: NDArray[np.float32]  # [m], shape cells + 3

    @property
    def cells(self) -> tuple[int, int, int]:
        """Along x, y, z."""
        nx, ny, nz = self.coefficients.shape
        return nx - 3, ny - 3, nz - 3

    @property
    def nbytes(self) -> int:
        """Bytes in the core's model: the coefficients, and one per cell for skipping what is far."""
        return self.coefficients.nbytes + int(np.prod(self.cells))


def distance_grid(
    mesh: TriangleMesh, name: str, *, resolution: int = DEFAULT_RESOLUTION, rounding: float = 0.0
) -> DistanceGrid:
    """The grid of a mesh, from the cache or built and put there.

    Parameters
    ----------
    mesh: a closed surface
    name: of the mesh in messages
    resolution: cells along the longest side
    rounding: radius that edges and corners are rounded with [m]: the solid made a rounding smaller and then larger

    Raises UsageError when the mesh is not closed, is rounded to nothing or too finely for its cells, or when libigl
    is needed and not installed.
    """
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        raise UsageError(f"resolution must be from {MIN_RESOLUTION} to {MAX_RESOLUTION} cells, got {resolution}")
    file = cache_folder() / f"{_key(mesh, resolution, rounding)}.npz"
    if (found := _read(file)) is not None:
        return found
    grid = build_grid(mesh, name, resolution=resolution, rounding=rounding)
    _write(file, grid)
    return grid


def build_grid(mesh: TriangleMesh, name: str, *, resolution: int, rounding: float = 0.0) -> DistanceGrid:
    """As `distance_grid`, without the cache."""
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
            f"mesh {name!r} is thinner than the cells of {spacing:.3g} m that its grid would have; "
            "set a larger resolution"
        )
    if rounding > 0:
        distances = _opened(name, nodes, distances, nearest, cells + 1, spacing, rounding)
    return spline_grid(distances.reshape(cells + 1), origin, spacing)


def spline_grid(distances: Array, origin: Array, spacing: float) -> DistanceGrid:
    """The spline through distances [m], shape cells + 1, at the corners of cells; the first is at `origin`."""
    straight_on = np.pad(distances, _PAD, mode="reflect", reflect_type="odd")
    inner = slice(_PAD - 1, 1 - _PAD)
    coefficients = ndimage.spline_filter(straight_on, order=3, mode="mirror")[inner, inner, inner]
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
    """Distances at the nodes to the part of the solid that a ball of this radius reaches: edges and corners are round.

    Where the ball's centre can be, the inner solid, the distance is as it was; elsewhere it is the distance to the
    inner solid less the rounding. The inner solid's surface is first triangulated, which cuts its edges off; then the
    nearest point is found anew from what the distances at the eight nodes about it say.
    """
    from skimage import measure

    if not (distances < -rounding).any():
        raise UsageError(
            f"mesh {name!r}: a rounding of {rounding:g} m leaves nothing of it; it must be below half its thickness"
        )
    marching_cubes: Any = measure.marching_cubes
    vertices, faces, *_ = marching_cubes(distances.reshape(counts), -rounding, spacing=(spacing,) * 3)
    inner = TriangleMesh(vertices.astype(float) + nodes[0], faces.astype(np.int64))
    outside = np.flatnonzero(distances > -rounding)
    x = nodes[outside]
    y = nearest_points(inner, x, name)
    normals = (nodes - nearest) / np.where(distances == 0, 1, distances)[:, None]
    levels = distances - (normals * nodes).sum(1)  # the distance is nearly normal · point + level
    start, moves = y.copy(), np.zeros(len(x))
    for _ in range(_LOOKS):  # a cell at a time: the eight do not see what is further away
        first = np.floor((y - nodes[0]) / spacing).astype(int).clip(0, counts - 2)
        about = np.ravel_multi_index(tuple((first[:, None] + _CORNERS).T), tuple(counts)).T
        way = _into_half_spaces(x, normals[about], -rounding - levels[about]) - y
        moves = np.linalg.norm(way, axis=1) / spacing
        y += way / np.maximum(moves, 1)[:, None]
    lost = (moves > 0.5) | (np.linalg.norm(y - start, axis=1) > 2 * spacing)
    y[lost] = start[lost]
    result = distances.copy()
    result[outside] = np.linalg.norm(x - y, axis=1) - rounding
    return result


def _into_half_spaces(x: Array, normals: Array, bounds: Array) -> Array:
    """The points nearest to x (n, 3) with normal · point ≤ bound for k unit normals (n, k, 3), bounds (n, k).

    Hildreth's method: one multiplier at a time is made as good as it can be.
    """
    y, pushes = x.copy(), np.zeros_like(bounds)
    todo = np.arange(len(x))
    for _ in range(_PUSHES):
        largest = np.zeros(len(todo))
        for k in range(bounds.shape[1]):
            normal = normals[todo, k]
            change = np.maximum((normal * y[todo]).sum(1) - bounds[todo, k], -pushes[todo, k])
            pushes[todo, k] += change
            y[todo] -= change[:, None] * normal
            largest = np.maximum(largest, np.abs(change))
        todo = todo[largest > _SETTLED]
    return y


def cache_folder() -> Path:
    """Where grids are kept: $GELFLOW_CACHE, or gelflow in the user's folder for caches."""
    if given := os.environ.get("GELFLOW_CACHE"):
        return Path(given)
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "gelflow"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gelflow"


def _key(mesh: TriangleMesh, resolution: int, rounding: float) -> str:
    content = hashlib.sha256(f"{_VERSION} {resolution} {rounding!r} {len(mesh.vertices)}".encode())
    content.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    content.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return "grid-" + content.hexdigest()[:32]


def _read(file: Path) -> DistanceGrid | None:
    """The grid in a file of the cache; None where there is none, or none that can be used."""
    try:
        with np.load(file, allow_pickle=False) as found:
            if int(found["format"]) != 1:
                return None
            grid = DistanceGrid(found["origin"], float(found["spacing"]), found["coefficients"])
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile):
        return None
    c = grid.coefficients
    usable = c.dtype == np.float32 and c.ndim == 3 and min(c.shape) > 2 * _MARGIN and np.isfinite(c).all()
    return grid if usable and grid.origin.shape == (3,) and grid.spacing > 0 else None


def _write(file: Path, grid: DistanceGrid) -> None:
    """Put the grid into the cache, whole or not at all; where nothing can be written it is built again next time."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=file.parent) as folder:
            part = Path(folder) / file.name
            np.savez(part, format=1, origin=grid.origin, spacing=grid.spacing, coefficients=grid.coefficients)
            os.replace(part, file)
    except OSError:
        return
