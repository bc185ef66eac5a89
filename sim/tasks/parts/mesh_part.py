"""Parts whose shape is a watertight mesh: outline, grasped sides, mass, contact points and symmetry."""

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.part import Part
from gelflow.sim.scene.contacts import PointsDef
from gelflow.sim.scene.geometry.distance_grid import distance_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh, nearest_points
from gelflow.sim.scene.geometry.sampling import mesh_surface
from gelflow.sim.scene.mjcf.mechanics import BodyDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.tasks.parts.geometry import PartGeometry, with_points
from gelflow.sim.tasks.parts.mesh_file import described_mesh
from gelflow.sim.tasks.parts.mesh_picture import OUTLINE_PIXEL, Picture, picture, region_outline
from gelflow.sim.tasks.parts.outline import Outline

Array = NDArray[np.float64]

PAD_RADIUS = 18e-3  # of the pads of the insertion scene [m]
_SIDE_PIXEL = 0.25e-3  # of the picture of a mesh from the side [m]
_GRID_SPACING = 0.5e-3  # of the distance grid, at most [m]
_FACE_SPACING, _EDGE_SPACING = 5e-3, 2.7e-3  # of contact points on faces and on sharp edges [m]
_SHARP = np.cos(np.radians(30.0))  # cosine of the angle between the faces of a sharp edge
_SAME_SHAPE = 0.15e-3  # distance [m] at which a rotated or mirrored mesh is the same
_LARGEST_SYMMETRY = 12
_ROUND = (2, 3, 5, 7, 11)  # a shape with all of these rotations is round


def centred(mesh: TriangleMesh) -> tuple[TriangleMesh, Array]:
    """The mesh with its bounding box centred at the origin, and the former position of the centre [m]."""
    centre = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return TriangleMesh(mesh.vertices - centre, mesh.faces), centre


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
    points = _samples(mesh)

    def unchanged(moved: Array) -> bool:
        return _largest_distance(mesh, moved, name) < _SAME_SHAPE

    mirror = tuple(axis for axis, signs in (("x", (-1, 1, 1)), ("y", (1, -1, 1))) if unchanged(points * signs))
    if all(unchanged(_turned(points, parts)) for parts in _ROUND):
        return 0, mirror
    numbers = range(2, _LARGEST_SYMMETRY + 1)
    return max((parts for parts in numbers if unchanged(_turned(points, parts))), default=1), mirror


def rotation_error(mesh: TriangleMesh, name: str, rotations: int) -> float:
    """Largest distance [m] of a mesh from itself after any of the rotations of `Part.symmetry`."""
    points = _samples(mesh)
    turns = [rotations / k for k in range(1, rotations)] if rotations else _ROUND
    return max((_largest_distance(mesh, _turned(points, parts), name) for parts in turns), default=0.0)


def _samples(mesh: TriangleMesh) -> Array:
    return np.concatenate([mesh.vertices, mesh_surface(mesh, count=400)[0]])


def _turned(points: Array, parts: float) -> Array:
    """Points after 1/parts of a turn about z."""
    cos, sin = np.cos(2 * np.pi / parts), np.sin(2 * np.pi / parts)
    return np.asarray(points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]))


def _largest_distance(mesh: TriangleMesh, points: Array, name: str) -> float:
    return float(np.linalg.norm(points - nearest_points(mesh, points, name), axis=1).max())


class MeshPart(PartGeometry):
    """A part whose shape is a watertight mesh."""

    def __init__(self, part: Part) -> None:
        """Raises UsageError when the mesh file is missing, not watertight, or another one than the description's."""
        super().__init__(part)
        described = described_mesh(f"part {part.name!r}", part.mesh_file, part.mesh, part.mesh_scale)
        mesh, _ = centred(described)
        left, right = grasped_sides(mesh, part.grasp_height)
        self.mesh = TriangleMesh(mesh.vertices - np.array([(left + right) / 2, 0.0, 0.0]), mesh.faces)

    @cached_property
    def outline(self) -> Outline:
        """Outline of what is in the hole, seen from below: accurate to half a pixel of 0.05 mm."""
        below = picture(self.mesh, along=2, pixel=OUTLINE_PIXEL)
        with np.errstate(invalid="ignore"):
            solid = below.low < self.part.depth - self.half[2]
        return region_outline(solid, below)

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
