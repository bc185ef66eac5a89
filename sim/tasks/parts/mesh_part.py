"""Parts whose shape is a watertight mesh: outline, grasped sides, mass, contact points and symmetry."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.part import Part
from gelflow.sim.scene.contacts import PointsDef
from gelflow.sim.scene.geometry.distance_grid import distance_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, nearest_points, read_mesh
from gelflow.sim.scene.geometry.sampling import mesh_surface
from gelflow.sim.scene.mjcf.mechanics import BodyDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.tasks.parts.geometry import PartGeometry, with_points
from gelflow.sim.tasks.parts.outline import Outline, Polygons

Array = NDArray[np.float64]

PAD_RADIUS = 18e-3  # of the pads of the insertion scene [m]
_OUTLINE_PIXEL, _SIDE_PIXEL = 0.05e-3, 0.25e-3  # of the pictures of a mesh from below and from the side [m]
_GRID_SPACING = 0.5e-3  # of the distance grid, at most [m]
_FACE_SPACING, _EDGE_SPACING = 5e-3, 2.7e-3  # of contact points on faces and on sharp edges [m]
_SHARP = np.cos(np.radians(30.0))  # cosine of the angle between the faces of a sharp edge
_SAME_SHAPE = 0.15e-3  # distance [m] at which a rotated or mirrored mesh is the same
_LARGEST_SYMMETRY = 12
_ROUND = (2, 3, 5, 7, 11)  # a shape with all of these rotations is round


@dataclass(frozen=True)
class Picture:
    """A mesh seen along an axis: the lowest and the highest coordinate along it at each pixel, NaN beside the mesh."""

    low: Array  # [m], shape (columns, rows)
    high: Array
    origin: Array  # of the first pixel's centre [m], shape (2,)
    pixel: float  # [m]

    def pixels(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Indices of the pixels at points (…, 2), clipped to the picture, and whether the points are within it."""
        at = np.round((points - self.origin) / self.pixel).astype(int)
        last = np.array(self.low.shape) - 1
        within = np.asarray(((at >= 0) & (at <= last)).all(-1))
        at = np.clip(at, 0, last)
        return at[..., 0], at[..., 1], within


def picture(mesh: TriangleMesh, *, along: int, pixel: float) -> Picture:
    """The mesh seen along the axis `along` (0, 1, 2), with a border of two pixels."""
    first, second = (axis for axis in range(3) if axis != along)
    flat, depth = mesh.vertices[:, [first, second]], mesh.vertices[:, along]
    origin = flat.min(0) - 2 * pixel + pixel / 2
    shape = np.ceil((flat.max(0) - origin) / pixel).astype(int) + 3
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    for face in mesh.faces:
        corners, heights = (flat[face] - origin) / pixel, depth[face]
        edges = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]])
        area = np.linalg.det(edges)
        if abs(area) < 1e-9:  # seen edge-on
            continue
        start = np.ceil(corners.min(0)).astype(int)
        end = np.floor(corners.max(0)).astype(int) + 1
        x, y = np.meshgrid(*(np.arange(a, b) for a, b in zip(start, end, strict=True)), indexing="ij")
        share = np.stack([x - corners[0, 0], y - corners[0, 1]], axis=-1) @ np.linalg.inv(edges).T
        inside = (share >= -1e-9).all(-1) & (share.sum(-1) <= 1 + 1e-9)
        height = heights[0] + share @ (heights[1:] - heights[0])
        window = (slice(start[0], end[0]), slice(start[1], end[1]))
        low[window] = np.where(inside, np.minimum(low[window], height), low[window])
        high[window] = np.where(inside, np.maximum(high[window], height), high[window])
    empty = ~np.isfinite(low)
    return Picture(np.where(empty, np.nan, low), np.where(empty, np.nan, high), origin, pixel)


def load_part_mesh(path: Path, scale: float) -> TriangleMesh:
    """A closed mesh in metres whose bounding box is centred at the origin.

    Raises UsageError when the file cannot be read, or the mesh is not watertight (the message has the number of open
    edges).
    """
    raw = read_mesh(path)
    mesh = closed_mesh(TriangleMesh(raw.vertices * scale, raw.faces), path.name)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    return TriangleMesh(mesh.vertices - (low + high) / 2, mesh.faces)


def file_digest(path: Path) -> str:
    """SHA-256 of a file. Raises UsageError when it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UsageError(f"cannot read the mesh {path}: {error.strerror}") from None


def grasped_sides(mesh: TriangleMesh, grasp_height: tuple[float, float]) -> tuple[float, float]:
    """x of the sides [m] that the pads meet at grasps in a range of heights above the mesh's centre.

    Raises UsageError when the pads do not meet the part.
    """
    side = picture(mesh, along=0, pixel=_SIDE_PIXEL)
    y, z = (side.origin[axis] + side.pixel * np.arange(side.low.shape[axis]) for axis in (0, 1))
    low, high = grasp_height
    near_y, near_z = np.abs(y) <= PAD_RADIUS, (z >= low - PAD_RADIUS) & (z <= high + PAD_RADIUS)
    window = np.ix_(near_y, near_z)
    if np.isnan(side.low[window]).all():
        raise UsageError("the pads do not meet the part; check grasp.height and the scale of the mesh")
    return float(np.nanmin(side.low[window])), float(np.nanmax(side.high[window]))


def found_symmetry(mesh: TriangleMesh, name: str) -> tuple[int, tuple[str, ...]]:
    """The rotations about z that leave a mesh unchanged (0: round, see `Part.symmetry`), and its mirror axes."""
    points = np.concatenate([mesh.vertices, mesh_surface(mesh, count=400)[0]])

    def unchanged(moved: Array) -> bool:
        return bool(np.linalg.norm(moved - nearest_points(mesh, moved, name), axis=1).max() < _SAME_SHAPE)

    def turned(parts: int) -> bool:
        angle = 2 * np.pi / parts
        cos, sin = np.cos(angle), np.sin(angle)
        return unchanged(points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))

    mirror = tuple(axis for axis, signs in (("x", (-1, 1, 1)), ("y", (1, -1, 1))) if unchanged(points * signs))
    if all(turned(parts) for parts in _ROUND):
        return 0, mirror
    return max((n for n in range(2, _LARGEST_SYMMETRY + 1) if turned(n)), default=1), mirror


class MeshPart(PartGeometry):
    """A part whose shape is a watertight mesh."""

    def __init__(self, part: Part) -> None:
        """Raises UsageError when the mesh file is missing, not watertight, or another one than the description's."""
        super().__init__(part)
        if not part.mesh_file:
            raise UsageError(
                f"part {part.name!r} is a mesh, which its description does not contain; give its part file"
            )
        path = Path(part.mesh_file)
        if file_digest(path) != part.mesh:
            raise UsageError(f"the mesh {path} has changed since part {part.name!r} was described")
        mesh = load_part_mesh(path, part.mesh_scale)
        left, right = grasped_sides(mesh, part.grasp_height)
        self.mesh = TriangleMesh(mesh.vertices - np.array([(left + right) / 2, 0.0, 0.0]), mesh.faces)

    @cached_property
    def outline(self) -> Outline:
        """Outline of what is in the hole, seen from below: accurate to half a pixel of 0.05 mm."""
        from skimage import measure

        below = picture(self.mesh, along=2, pixel=_OUTLINE_PIXEL)
        with np.errstate(invalid="ignore"):
            solid = below.low < self.part.depth - self.half[2]
        find: Any = measure.find_contours
        simplify: Any = measure.approximate_polygon
        loops = [simplify(loop, 0.7)[:-1] * below.pixel + below.origin for loop in find(solid.astype(float), 0.5)]
        return Polygons(tuple(loop for loop in loops if len(loop) >= 3))

    @cached_property
    def _side(self) -> Picture:
        return picture(self.mesh, along=0, pixel=_SIDE_PIXEL)

    @property
    def volume(self) -> float:
        return self.mesh.volume()

    def body(self, body: BodyDef) -> BodyDef:
        """Mass properties of the solid: sums over the tetrahedra between the faces and the origin."""
        corners = self.mesh.vertices[self.mesh.faces]
        volumes = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        volume, sums = volumes.sum(), corners.sum(1)
        com = (volumes[:, None] * sums).sum(0) / (4 * volume)
        squares = np.einsum("nki,nkj->nij", corners, corners) + np.einsum("ni,nj->nij", sums, sums)
        moments = (volumes[:, None, None] * squares).sum(0) / 20 - volume * np.outer(com, com)
        inertia = self.part.density * (np.trace(moments) * np.eye(3) - moments)
        packed = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return replace(body, mass=self.mass, com=com, inertia=packed)

    def shape(self, shape: ShapeDef) -> ShapeDef:
        resolution = int(np.ceil(max(self.part.size) / _GRID_SPACING))
        grid = distance_grid(self.mesh, self.part.name, resolution=max(64, resolution))
        return replace(shape, kind="mesh", size=np.array([1.0, 0.0, 0.0]), grid=grid)

    def points(self, points: PointsDef) -> PointsDef:
        """Points on the faces and on the sharp edges of the lower end, to 5 mm above the depth of the hole."""
        total = float(self.mesh.areas_and_normals()[0].sum())
        surface, areas = mesh_surface(self.mesh, count=max(50, round(total / _FACE_SPACING**2)))
        edges = _edge_points(self.mesh)
        local = np.concatenate([edges, surface])
        weights = np.concatenate([np.zeros_like(edges), areas])
        lower = local[:, 2] <= self.part.depth - self.half[2] + 5e-3
        return with_points(points, local[lower], weights[lower])

    def side_gaps(self, points: Array, side: int) -> Array:
        column, row, within = self._side.pixels(points)
        face = (self._side.low if side < 0 else self._side.high)[column, row]
        gap = self.part.grasp_width / 2 - side * face
        return np.where(within & np.isfinite(gap), np.maximum(gap, 0), np.inf)


def _edge_points(mesh: TriangleMesh) -> Array:
    """Points along the sharp edges of a mesh, their ends included, each once [m], shape (n, 3)."""
    _, normals = mesh.areas_and_normals()
    faces = mesh.faces
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T[::-1])
    edges, owner = edges[order].reshape(-1, 2, 2)[:, 0], owner[order].reshape(-1, 2)  # two faces at each edge
    sharp = (normals[owner[:, 0]] * normals[owner[:, 1]]).sum(1) < _SHARP
    points = []
    for a, b in mesh.vertices[edges[sharp]]:
        count = max(1, round(float(np.linalg.norm(b - a)) / _EDGE_SPACING))
        points.append(a + np.linspace(0, 1, count + 1)[:, None] * (b - a))
    return np.unique(np.concatenate([*points, np.zeros((0, 3))]).round(9), axis=0)
