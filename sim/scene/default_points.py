"""Default density of contact points, and the widths and gaps that decide whether sampled points can miss a shape.

The default spacing is at most a third of the smallest width of a partner. A face of the partner then contains points in
both directions, even where it coincides with a face of the sampled geometry: the outermost points are then on edges of
the partner, at distance 0, where they have no force.
"""

import math
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.geometry.sampling import (
    ENDS,
    FACES,
    box_grid,
    box_surface,
    capsule,
    cylinder,
    ellipsoid,
    mesh_samples,
)
from gelflow.sim.scene.mjcf.mechanics import GeomDef

Array = NDArray[np.float64]

MAX_DEFAULT_POINTS = 4000  # of one point set
WIDEST_GAP = 0.6  # largest gap between points, relative to the smallest width of a shape, that is not warned about
_PER_WIDTH = 3  # spacings per smallest width of a partner
_INSET = 0.25  # distance of the second row of points from an edge, in spacings
_MIN_ANGLES = 24  # of a cylinder: its polygon is within 1 % of the circle
_REFERENCE_POINTS = 6000  # on a surface, to find the largest gap between its points


def smallest_width(geom: GeomDef) -> float:
    """The smallest width of a geometry [m]; infinite for a plane."""
    if geom.kind == "plane":
        return math.inf
    if geom.mesh is not None:
        return float(np.ptp(geom.mesh.vertices, axis=0).min())
    numbers = {"box": 3, "ellipsoid": 3, "cylinder": 2}
    return 2 * float(geom.size[: numbers.get(geom.kind, 1)].min())


def choose_spacings(sampled: Mapping[str, GeomDef], partners: Mapping[str, Collection[GeomDef]]) -> dict[str, float]:
    """The spacing of each point set with a default density [m]; infinite for a box against planes: its corners.

    If two sets are in contact with each other's geometry, only the set with fewer points adapts its spacing to the
    other geometry. Only boxes have a default against planes alone, and only boxes and cylinders against other shapes;
    other sets get no spacing.

    Parameters
    ----------
    sampled: the geometry of each point set
    partners: the shapes in contact with each point set
    """

    def cost(name: str, shape: GeomDef) -> tuple[int, str]:
        return _number_of_points(sampled[name], _spacing(sampled[name], [shape])), name

    def leads(name: str, shape: GeomDef) -> bool:
        opposite = [
            other
            for other, geom in sampled.items()
            if geom.name == shape.name and any(p.name == sampled[name].name for p in partners[other])
        ]
        return all(cost(name, shape) <= cost(other, sampled[name]) for other in opposite)

    spacings = {}
    for name, geom in sampled.items():
        flat = all(shape.kind == "plane" for shape in partners[name])
        if geom.kind != "box" and (geom.kind != "cylinder" or flat):
            continue
        corners = flat and geom.kind == "box"
        spacings[name] = math.inf if corners else _spacing(geom, [p for p in partners[name] if leads(name, p)])
    return spacings


def _spacing(geom: GeomDef, partners: Collection[GeomDef]) -> float:
    """Spacing [m]: at most a third of the smallest width of each partner, or more to keep to `MAX_DEFAULT_POINTS`."""
    spacing = min((smallest_width(partner) for partner in partners), default=math.inf) / _PER_WIDTH
    spacing = min(spacing, 2 * float(geom.size.max()))  # the number of spacings per side has a lower bound
    while _number_of_points(geom, spacing) > MAX_DEFAULT_POINTS:
        spacing *= 1.05
    return spacing


def _number_of_points(geom: GeomDef, spacing: float) -> int:
    """Number of points of `default_surface` of a box or cylinder."""
    if geom.kind == "box":
        counts = [len(axis) for axis in _box_axes(geom, spacing)]
        return math.prod(counts) - math.prod(n - 2 for n in counts)
    angles, radii, heights = _cylinder_counts(geom, spacing)
    return 2 + angles * (2 * radii + heights - 2)


def default_surface(geom: GeomDef, spacing: float) -> tuple[Array, Array]:
    """Points of a box or cylinder at about this spacing [m], shape (n, 3), and their areas along its axes [m²]."""
    if geom.kind == "box":
        return box_grid(_box_axes(geom, spacing), faces=FACES)
    angles, radii, heights = _cylinder_counts(geom, spacing)
    radius, half = geom.size[:2].tolist()
    return cylinder(radius, half, angles=angles, radii=radii, heights=heights, faces=(*ENDS, "wall"))


def largest_gap(geom: GeomDef, points: Array, faces: Collection[str]) -> float:
    """Diameter of the largest ball that contains no point and is centred on the sampled faces of a geometry [m].

    The wall of a cylinder with points on both ends counts as sampled.
    """
    from scipy.spatial import cKDTree  # deferred: slow to import

    distances, _ = cKDTree(points).query(_reference_points(geom, faces))
    return 2 * float(distances.max())


def _reference_points(geom: GeomDef, faces: Collection[str]) -> Array:
    if geom.mesh is not None:
        return mesh_samples(geom.mesh, _REFERENCE_POINTS)
    if geom.kind == "box":
        half = geom.size.tolist()
        areas = [half[0] * half[1], half[1] * half[2], half[2] * half[0]]
        step = math.sqrt(8 * sum(areas) / _REFERENCE_POINTS)
        return box_surface(half, [math.ceil(2 * h / step) + 2 for h in half], faces=tuple(faces))[0]
    if geom.kind == "cylinder":
        ends = [face for face in faces if face != "wall"]
        wall = ["wall"] if "wall" in faces or len(ends) == 2 else []
        radius, half_length = geom.size[:2].tolist()
        return cylinder(radius, half_length, angles=72, radii=20, heights=40, faces=(*ends, *wall))[0]
    size = geom.size.tolist()
    if geom.kind == "ellipsoid":
        return ellipsoid(size, count=_REFERENCE_POINTS, faces=tuple(faces))[0]
    half_length = size[1] if geom.kind == "capsule" else 0.0
    return capsule(size[0], half_length, count=_REFERENCE_POINTS, faces=tuple(faces))[0]


def _box_axes(geom: GeomDef, spacing: float) -> list[Array]:
    """Coordinates of the points along each axis: uniform, with a second row close to each edge.

    The second row keeps the support of two coinciding faces nearly as wide as the faces. An infinite spacing gives the
    corners alone.
    """
    axes = []
    for half in geom.size.tolist():
        if math.isinf(spacing):
            axes.append(np.array([-half, half]))
            continue
        uniform = np.linspace(-half, half, max(_PER_WIDTH, math.ceil(2 * half / spacing)) + 1)
        inset = _INSET * (uniform[1] - uniform[0])
        axes.append(np.concatenate([uniform[:1], [inset - half], uniform[1:-1], [half - inset], uniform[-1:]]))
    return axes


def _cylinder_counts(geom: GeomDef, spacing: float) -> tuple[int, int, int]:
    """Angles, radii and heights of the points of a cylinder."""
    radius, half = geom.size[:2].tolist()
    angles = max(_MIN_ANGLES, math.ceil(2 * np.pi * radius / spacing))
    radii = max(_PER_WIDTH, math.ceil(radius / spacing))
    return angles, radii, max(_PER_WIDTH, math.ceil(2 * half / spacing)) + 1
