"""Horizontal outlines of parts and holes: signed distances in the plane, and the distance grid of a hole."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, spline_grid

Array = NDArray[np.float64]

_BLOCK_MARGIN = 25e-3  # of the block around a hole [m]: a part that is gripped cannot leave it
_BELOW_FLOOR = 5e-3  # to which the block reaches [m]
_BORDER_CELLS = 3  # around the block
_CORNERS_OF_CIRCLE = 48


class Outline(ABC):
    """A closed curve in the plane."""

    @abstractmethod
    def distance(self, points: Array) -> Array:
        """Signed distances of points (…, 2) to the outline [m], shape (…); negative inside."""

    @abstractmethod
    def corners(self) -> Array:
        """Points on the outline [m], shape (n, 2): all corners, or so many that no other point is farther out."""

    @abstractmethod
    def enlarged(self, gap: tuple[float, float]) -> "Outline":
        """The outline at a distance `gap` along x and y [m] outside."""


@dataclass(frozen=True)
class Rectangle(Outline):
    """A rectangle about the origin."""

    half: tuple[float, float]  # half sizes along x and y [m]

    def distance(self, points: Array) -> Array:
        """Outside beyond a corner: the larger of the distances along x and y."""
        return np.asarray((np.abs(points) - np.array(self.half)).max(-1))

    def corners(self) -> Array:
        x, y = self.half
        return np.array([[i * x, j * y] for i in (-1, 1) for j in (-1, 1)])

    def enlarged(self, gap: tuple[float, float]) -> "Rectangle":
        return Rectangle((self.half[0] + gap[0], self.half[1] + gap[1]))


@dataclass(frozen=True)
class Circle(Outline):
    """A circle about the origin."""

    radius: float  # [m]

    def distance(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(points, axis=-1) - self.radius)

    def corners(self) -> Array:
        angle = 2 * np.pi * np.arange(_CORNERS_OF_CIRCLE) / _CORNERS_OF_CIRCLE
        return self.radius * np.column_stack([np.cos(angle), np.sin(angle)])

    def enlarged(self, gap: tuple[float, float]) -> "Circle":
        return Circle(self.radius + gap[0])


@dataclass(frozen=True)
class Polygons(Outline):
    """Closed polygons, for example an outer one and the holes in it; `offset` moves the curve outwards.

    The moved curve has the exact distance `offset` from the polygons: its convex corners are round.
    """

    loops: tuple[Array, ...]  # [m], shape (n, 2) each
    offset: float = 0.0  # [m]

    def distance(self, points: Array) -> Array:
        flat = np.reshape(points, (-1, 2))
        squared, inside = np.full(len(flat), np.inf), np.zeros(len(flat), dtype=bool)
        for loop in self.loops:
            for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
                edge, to_point = b - a, flat - a
                share = np.clip(to_point @ edge / max(float(edge @ edge), 1e-30), 0, 1)
                squared = np.minimum(squared, ((to_point - share[:, None] * edge) ** 2).sum(1))
                crosses = (a[1] > flat[:, 1]) != (b[1] > flat[:, 1])  # a ray along +x, even-odd rule
                rise = np.where(crosses, b[1] - a[1], 1.0)
                inside ^= crosses & (flat[:, 0] < a[0] + (flat[:, 1] - a[1]) * edge[0] / rise)
        distance = np.where(inside, -1.0, 1.0) * np.sqrt(squared)
        return np.asarray(distance.reshape(np.shape(points)[:-1]) - self.offset)

    def corners(self) -> Array:
        return np.concatenate(self.loops)

    def enlarged(self, gap: tuple[float, float]) -> "Polygons":
        return Polygons(self.loops, self.offset + gap[0])


def hole_grid(hole: Outline, depth: float, spacing: float) -> DistanceGrid:
    """Signed distances of a block with a vertical hole, whose floor is at z = 0 and rim at z = `depth` [m].

    `spacing` [m] is that of the grid. The hole goes through the block, because the floor is another shape. Edges are
    rounded by about one cell.
    """
    corners = hole.corners()
    low, high = corners.min(0) - _BLOCK_MARGIN, corners.max(0) + _BLOCK_MARGIN
    border = _BORDER_CELLS * spacing
    start = np.append(low, -_BELOW_FLOOR) - border
    cells = np.ceil((np.append(high, depth) + border - start) / spacing).astype(int)
    x, y, z = (first + spacing * np.arange(n + 1) for first, n in zip(start, cells, strict=True))
    at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    beyond = np.abs(at - (low + high) / 2) - (high - low) / 2
    block = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)
    planar = np.maximum(block, -hole.distance(at))[..., None]  # of the block with its hole, in the plane
    vertical = np.broadcast_to(np.maximum(z - depth, -_BELOW_FLOOR - z), (len(x), len(y), len(z)))
    outside = np.hypot(np.maximum(planar, 0), np.maximum(vertical, 0))
    distances = np.where((planar > 0) | (vertical > 0), outside, np.maximum(planar, vertical))
    return spline_grid(distances, start, spacing)
