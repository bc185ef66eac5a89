"""Triangle meshes of a model file: checked to be closed, and their signed distances.

The distances come from libigl, which is imported when a mesh is in contact and its grid is not yet in the cache.
"""

import importlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

Array = NDArray[np.float64]
T = TypeVar("T")

_CHUNK = 50_000  # points whose distances are asked for at once, or more where the mesh is large: each time it is sorted
_PATIENCE = 2.0  # [s] that pass before a bar is shown


@dataclass(frozen=True)
class TriangleMesh:
    """A surface of triangles, counter-clockwise seen from outside."""

    vertices: Array  # [m], shape (n, 3)
    faces: NDArray[np.int64]  # shape (m, 3)

    def areas_and_normals(self) -> tuple[Array, Array]:
        """Of the triangles: areas [m²], shape (m,), and unit normals, shape (m, 3), zero where there is no area."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        crossed = np.cross(b - a, c - a)
        length = np.linalg.norm(crossed, axis=1)
        return length / 2, crossed / np.maximum(length, 1e-300)[:, None]

    def volume(self) -> float:
        """What the surface encloses [m³]; negative where it is turned inside out."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        return float((a * np.cross(b, c)).sum() / 6)


def closed_mesh(mesh: TriangleMesh, name: str) -> TriangleMesh:
    """The mesh with equal vertices made one and triangles without three corners left out.

    Raises UsageError where the surface is not closed, is turned inside out, or is too large for its numbers.
    """
    vertices, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    # Each edge must be gone along as often one way as the other.
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] < edges[:, 1]
    number = np.sort(edges, axis=1) @ [len(vertices), 1]
    _, which, uses = np.unique(number, return_inverse=True, return_counts=True)
    balance = np.bincount(which.reshape(-1), weights=np.where(forward, 1.0, -1.0))
    holes, turned = int((uses == 1).sum()), int(((uses > 1) & (balance != 0)).sum())
    if holes:
        raise UsageError(
            f"mesh {name!r} is not watertight: {holes} of its {len(uses)} edges have a triangle on one side only; "
            "close the holes, or touch simple geometry instead"
        )
    if turned:
        raise UsageError(
            f"mesh {name!r} is not watertight: at {turned} of its {len(uses)} edges the triangles do not face the same "
            "way or do not come in pairs; make its normals consistent"
        )
    clean = TriangleMesh(vertices, faces)
    if not len(faces) or not clean.volume() > 0:
        raise UsageError(f"mesh {name!r} is inside out or flat: it encloses {clean.volume():.3g} m³; turn its faces")
    return clean


def signed_distances(mesh: TriangleMesh, points: Array, name: str) -> tuple[Array, Array]:
    """Distance of points (n, 3) to a closed mesh, negative inside [m], shape (n,), and the nearest points, (n, 3).

    Raises UsageError when libigl is not installed, and where parts of the mesh overlap.
    """
    igl = _igl(name)
    far = 1e-3 * float(np.ptp(mesh.vertices, axis=0).max())  # on the surface itself turns may be anything
    parts = []
    for some in with_progress(f"distances to mesh {name}", _chunks(points, mesh)):
        squared, _, nearest = igl.point_mesh_squared_distance(some, mesh.vertices, mesh.faces)
        turns = igl.fast_winding_number(mesh.vertices, mesh.faces, some)  # about: 1 inside, 0 outside
        if (turns[squared > far**2] > 1.5).any():
            raise UsageError(f"mesh {name!r}: its parts overlap; unite them to one surface")
        parts.append((np.where(turns > 0.5, -1.0, 1.0) * np.sqrt(squared), nearest))
    distances, nearest_points = (np.concatenate(part) for part in zip(*parts, strict=True))
    return distances, nearest_points


def nearest_points(mesh: TriangleMesh, points: Array, name: str) -> Array:
    """The points of a mesh nearest to points (n, 3) [m], shape (n, 3). Raises UsageError without libigl."""
    igl = _igl(name)
    chunks = with_progress(f"rounding of mesh {name}", _chunks(points, mesh))
    return np.concatenate([igl.point_mesh_squared_distance(some, mesh.vertices, mesh.faces)[2] for some in chunks])


def with_progress(what: str, items: Sequence[T]) -> Iterator[T]:
    """The items, one by one; after two seconds a bar on the terminal shows how far they are."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    begin = time.monotonic()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=len(items), visible=False)
        for item in items:
            yield item
            bar.update(task, advance=1, visible=time.monotonic() - begin > _PATIENCE)


def _chunks(points: Array, mesh: TriangleMesh) -> list[Array]:
    return np.array_split(np.ascontiguousarray(points), max(1, -(-len(points) // max(_CHUNK, 2 * len(mesh.faces)))))


def _igl(name: str) -> Any:
    try:
        return importlib.import_module("igl")
    except ImportError:
        raise UsageError(
            f"mesh {name!r}: its distances are computed with libigl, which is not installed; pip install libigl"
        ) from None
