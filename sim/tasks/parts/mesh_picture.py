"""Pictures of meshes: the lowest and the highest point of a mesh at each pixel, and outlines of regions in them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.tasks.parts.outline import Polygons

Array = NDArray[np.float64]

OUTLINE_PIXEL = 0.05e-3  # of pictures from which outlines are taken [m]


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


def region_outline(region: NDArray[np.bool_], seen: Picture) -> Polygons:
    """The outline of a region of pixels, accurate to half a pixel."""
    from skimage import measure

    find: Any = measure.find_contours
    simplify: Any = measure.approximate_polygon
    loops = [simplify(loop, 0.7)[:-1] * seen.pixel + seen.origin for loop in find(region.astype(float), 0.5)]
    return Polygons(tuple(loop for loop in loops if len(loop) >= 3))
