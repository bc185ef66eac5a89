"""Triangle meshes: validation, and signed distances by libigl.

libigl is imported only when a distance grid is built that is not in the cache.
"""

import importlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

Array = NDArray[np.float64]
T = TypeVar("T")

_CHUNK_SIZE = 50_000  # points per call of libigl; larger for large meshes, because each call builds a tree of the mesh
_PROGRESS_DELAY = 2.0  # [s] before a progress bar is shown


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh; the vertices of a face are counter-clockwise seen from outside."""

    vertices: Array  # [m], shape (n, 3)
    faces: NDArray[np.int64]  # shape (m, 3)

    def areas_and_normals(self) -> tuple[Array, Array]:
        """Areas of the triangles [m²], shape (m,), and unit normals, shape (m, 3); 0 for degenerate triangles."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1)
        return length / 2, cross / np.maximum(length, 1e-300)[:, None]

    def volume(self) -> float:
        """Enclosed volume [m³]; negative if the faces are oriented inwards."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float((a * np.cross(b, c)).sum() / 6)


def read_mesh(path: Path) -> TriangleMesh:
    """The triangles of an .obj, .stl, .ply or .off file, in its own unit.

    Raises UsageError when the file cannot be read, and if libigl is not installed.
    """
    if not path.is_file():
        raise UsageError(f"no such mesh file: {path}")
    try:
        vertices, faces, *_ = _igl(path.name).read_triangle_mesh(str(path))
    except (RuntimeError, ValueError) as error:
        raise UsageError(f"cannot read the mesh {path}: {' '.join(str(error).split())}") from None
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
        raise UsageError(f"the mesh {path} has no triangles")
    return TriangleMesh(vertices, faces)


def closed_mesh(mesh: TriangleMesh, name: str) -> TriangleMesh:
    """The mesh with equal vertices merged and degenerate triangles removed.

    Raises UsageError if the surface is not closed, not consistently oriented, or oriented inwards.
    """
    vertices, merged = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    # In a closed, oriented surface each edge occurs equally often in both directions.
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] < edges[:, 1]
    edge_ids = np.sort(edges, axis=1) @ [len(vertices), 1]
    _, index, uses = np.unique(edge_ids, return_inverse=True, return_counts=True)
    balance = np.bincount(index.reshape(-1), weights=np.where(forward, 1.0, -1.0))
    open_edges, inconsistent = int((uses == 1).sum()), int(((uses > 1) & (balance != 0)).sum())
    if open_edges:
        raise UsageError(
            f"mesh {name!r} is not watertight: {open_edges} of its {len(uses)} edges belong to one triangle only; "
            "close the holes, or use a primitive geometry"
        )
    if inconsistent:
        raise UsageError(
            f"mesh {name!r} is not watertight: at {inconsistent} of its {len(uses)} edges the triangles are not "
            "consistently oriented or not paired; make the normals consistent"
        )
    clean = TriangleMesh(vertices, faces)
    if not len(faces) or not clean.volume() > 0:
        raise UsageError(f"mesh {name!r} is inside out or flat: its volume is {clean.volume():.3g} m³; flip its faces")
    return clean


def signed_distances(mesh: TriangleMesh, points: Array, name: str) -> tuple[Array, Array]:
    """Signed distances of points (n, 3) to a closed mesh [m], shape (n,), and the nearest points on it, (n, 3).

    The sign is that of the generalized winding number: negative inside. `name` is for messages. Raises UsageError if
    libigl is not installed, and if parts of the mesh overlap.
    """
    igl = _igl(name)
    far = 1e-3 * float(np.ptp(mesh.vertices, axis=0).max())  # closer to the surface the winding number is not reliable
    results = []
    for chunk in with_progress(f"distances to mesh {name}", _chunks(points, mesh)):
        squared, _, nearest = igl.point_mesh_squared_distance(chunk, mesh.vertices, mesh.faces)
        winding = igl.fast_winding_number(mesh.vertices, mesh.faces, chunk)  # approximately 1 inside, 0 outside
        if (winding[squared > far**2] > 1.5).any():
            raise UsageError(f"mesh {name!r}: its parts overlap; merge them into one surface")
        results.append((np.where(winding > 0.5, -1.0, 1.0) * np.sqrt(squared), nearest))
    distances, nearest_points = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
    return distances, nearest_points


def nearest_points(mesh: TriangleMesh, points: Array, name: str) -> Array:
    """The nearest points on a mesh of points (n, 3) [m], shape (n, 3). Raises UsageError without libigl."""
    igl = _igl(name)
    chunks = with_progress(f"rounding of mesh {name}", _chunks(points, mesh))
    return np.concatenate([igl.point_mesh_squared_distance(chunk, mesh.vertices, mesh.faces)[2] for chunk in chunks])


def with_progress(label: str, items: Sequence[T]) -> Iterator[T]:
    """Iterate over items; after two seconds a progress bar is shown on the terminal."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    console = Console(stderr=True)
    start = time.monotonic()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(label), total=len(items), visible=False)
        for item in items:
            yield item
            bar.update(task, advance=1, visible=time.monotonic() - start > _PROGRESS_DELAY)


def _chunks(points: Array, mesh: TriangleMesh) -> list[Array]:
    chunks = -(-len(points) // max(_CHUNK_SIZE, 2 * len(mesh.faces)))
    return np.array_split(np.ascontiguousarray(points), max(1, chunks))


def _igl(name: str) -> Any:
    try:
        return importlib.import_module("igl")
    except ImportError:
        raise UsageError(
            f"mesh {name!r}: its distance grid needs libigl, which is not installed; pip install libigl"
        ) from None
