"""Closed meshes of solids with known exact distances, for tests and studies of distance grids."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from gelflow.sim.scene.geometry.mesh import TriangleMesh

Array = NDArray[np.float64]


def hull(points: Array) -> TriangleMesh:
    """Convex hull of points, with outward triangles."""
    convex = ConvexHull(points)
    faces = convex.simplices.astype(np.int64)
    a, b, c = (points[faces[:, i]] for i in range(3))
    inwards = (np.cross(b - a, c - a) * convex.equations[:, :3]).sum(1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return TriangleMesh(points, faces)


def box(half: tuple[float, float, float]) -> TriangleMesh:
    """Box centred at the origin, with half lengths `half` [m]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    return hull(signs * half)


def sphere(radius: float, count: int = 4000) -> TriangleMesh:
    """Polyhedron with `count` vertices on a sphere."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    around = np.sqrt(1 - height**2)
    return hull(radius * np.column_stack([around * np.cos(angle), around * np.sin(angle), height]))


def cylinder(radius: float, half_length: float, around: int = 720) -> TriangleMesh:
    """Prism about z with vertices on a cylinder, from triangles of similar edge lengths."""
    step = 2 * np.pi * radius / around
    rings, rows = round(radius / step / 4), round(2 * half_length / step / 4) + 1
    inwards = radius * np.arange(1, rings + 1) / rings
    heights = np.linspace(-half_length, half_length, rows)
    profile = np.concatenate(  # (distance from the axis, height), from the centre of one end to that of the other
        [
            np.column_stack([inwards[:-1], np.full(rings - 1, -half_length)]),
            np.column_stack([np.full(rows, radius), heights]),
            np.column_stack([inwards[-2::-1], np.full(rings - 1, half_length)]),
        ]
    )
    n, turn = len(profile), 2 * np.pi * np.arange(around) / around
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    ring = profile[:, None, :1] * circle
    corners = np.concatenate([ring, np.broadcast_to(profile[:, None, 1:], (n, around, 1))], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([corners, [[0, 0, -half_length], [0, 0, half_length]]])
    row, i = np.meshgrid(np.arange(n - 1), np.arange(around), indexing="ij")
    a, b = row * around + i, row * around + (i + 1) % around
    quads = [np.stack([a, b, b + around], axis=-1), np.stack([a, b + around, a + around], axis=-1)]
    first, second = np.arange(around), np.roll(np.arange(around), -1)
    low, high, top = n * around, n * around + 1, (n - 1) * around
    ends = [
        np.stack([second, first, np.full(around, low)], axis=-1),
        np.stack([top + first, top + second, np.full(around, high)], axis=-1),
    ]
    faces = np.concatenate([*(q.reshape(-1, 3) for q in quads), *ends])
    return TriangleMesh(vertices, faces.astype(np.int64))


def bracket(arm: float, thick: float, depth: float) -> TriangleMesh:
    """L-bracket: arms from the origin along x and y, extruded from −depth/2 to depth/2 along z."""
    outline = np.array([[0, 0], [arm, 0], [arm, thick], [thick, thick], [thick, arm], [0, arm]], dtype=float)
    n = len(outline)
    ends = [np.column_stack([outline, np.full(n, z)]) for z in (-depth / 2, depth / 2)]
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    walls = [t for i in range(n) for t in ([i, (i + 1) % n, n + i], [(i + 1) % n, n + (i + 1) % n, n + i])]
    return TriangleMesh(np.concatenate(ends), np.concatenate([cap[:, ::-1], cap + n, walls]).astype(np.int64))


def bracket_distance(points: Array, arm: float, thick: float, depth: float) -> Array:
    """Exact signed distance of points (n, 3) to `bracket` [m], shape (n,)."""
    outline = np.array([[0, 0], [arm, 0], [arm, thick], [thick, thick], [thick, arm], [0, arm]], dtype=float)
    flat = points[:, :2]
    a, b = outline, np.roll(outline, -1, axis=0)
    along = ((flat[:, None] - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
    nearest = a + np.clip(along, 0, 1)[..., None] * (b - a)
    inside = ((flat > 0) & (flat < thick)).any(1) & (flat > 0).all(1) & (flat < arm).all(1)
    across = np.linalg.norm(flat[:, None] - nearest, axis=-1).min(1) * np.where(inside, -1, 1)
    beyond = np.column_stack([across, np.abs(points[:, 2]) - depth / 2])
    result: Array = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)
    return result


def obj(mesh: TriangleMesh) -> str:
    """Mesh in Wavefront OBJ format."""
    corners = "".join("v {:.17g} {:.17g} {:.17g}\n".format(*v) for v in mesh.vertices)
    return corners + "".join("f {} {} {}\n".format(*(f + 1)) for f in mesh.faces)
