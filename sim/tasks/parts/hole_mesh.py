"""Holes that are meshes: the solid around a hole, for example a fixture, as a watertight mesh.

x and y of the mesh are those of the part's file, as in an assembly; its highest point is the rim of the hole.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.part import Part
from gelflow.sim.scene.geometry.distance_grid import DistanceGrid, distance_grid
from gelflow.sim.scene.geometry.mesh import TriangleMesh
from gelflow.sim.tasks.parts.mesh_file import described_mesh
from gelflow.sim.tasks.parts.mesh_picture import OUTLINE_PIXEL, Picture, picture, region_outline
from gelflow.sim.tasks.parts.outline import Outline

Array = NDArray[np.float64]

_SAME_SHAPE = 0.15e-3  # distance [m] at which a mirrored outline is the same
_SAMPLES = 60  # along the longer side of a part, to find the hole under it


def mesh_hole(part: Part) -> TriangleMesh:
    """The mesh around the hole of `part` in the frame of the hole. Raises UsageError as `described_mesh`."""
    mesh = described_mesh(f"the hole of part {part.name!r}", part.hole_file, part.hole_mesh, part.hole_scale)
    shift = np.array([*part.hole_origin, float(mesh.vertices[:, 2].max()) - part.depth])
    return TriangleMesh(mesh.vertices - shift, mesh.faces)


def mesh_hole_grid(part: Part, spacing: float) -> DistanceGrid:
    """Signed distances of the mesh around the hole; the cells have at most `spacing` [m]."""
    mesh = mesh_hole(part)
    length = float(np.ptp(mesh.vertices, axis=0).max())
    return distance_grid(mesh, f"{part.name} hole", resolution=max(64, int(np.ceil(length / spacing))))


def mesh_hole_outline(part: Part, outline_of_part: Outline) -> Outline:
    """Outline of the hole in its lower half, above which it may be wider, for example by a chamfer.

    Raises UsageError when there is no hole under the part, or when it is open at a side.
    """
    above = picture(mesh_hole(part), along=2, pixel=OUTLINE_PIXEL)
    with np.errstate(invalid="ignore"):
        free = ~(above.high > part.depth / 2)
    return region_outline(_region_under(part, free, above, outline_of_part), above)


def _region_under(part: Part, free: NDArray[np.bool_], above: Picture, outline: Outline) -> NDArray[np.bool_]:
    """The connected free pixels under the part."""
    from skimage import measure

    components: Any = measure.label
    label: NDArray[np.int64] = components(free, connectivity=1)
    corners = outline.corners()
    axes = [np.linspace(low, high, _SAMPLES) for low, high in zip(corners.min(0), corners.max(0), strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    column, row, within = above.pixels(points[outline.distance(points) < 0])
    found = set(label[column[within], row[within]].tolist()) - {0}
    border = {*label[0].tolist(), *label[-1].tolist(), *label[:, 0].tolist(), *label[:, -1].tolist()}
    if not found:
        raise UsageError(f"part {part.name!r}: the mesh of the hole has no hole under the part; check x, y and scale")
    if found & border or not within.all():
        raise UsageError(f"part {part.name!r}: the mesh must surround the hole, which is open at a side")
    return np.isin(label, list(found))


def smallest_gap(part: Outline, hole: Outline) -> float:
    """The smallest distance between the outlines of a part and its hole [m]; negative when they overlap.

    Polygons are closest at a corner of one of them.
    """
    return float(min(-hole.distance(part.corners()).max(), part.distance(hole.corners()).min()))


def mirror_axes(hole: Outline) -> tuple[str, ...]:
    """The axes in which the outline of a hole is its own mirror image: "x", "y", both or none."""
    corners = hole.corners()
    signs = {"x": np.array([-1.0, 1.0]), "y": np.array([1.0, -1.0])}
    return tuple(axis for axis, sign in signs.items() if np.abs(hole.distance(corners * sign)).max() < _SAME_SHAPE)
