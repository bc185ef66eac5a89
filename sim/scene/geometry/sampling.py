"""Points sampled on surfaces, with the area that each stands for.

A contact is felt at points. Where stiffness is given per area, a point's weight is the part of the surface nearest to
it, clipped to the face, so that the weights add up to the area exactly and results converge as points get denser.
A point's area comes in three parts, whose sum it is: those across x, y and z. An area with normal n has the shares n²;
where faces meet, each gives its own. When points are scaled the parts grow with it (docs/reference/physics.md).

Round surfaces carry a Fibonacci lattice: points at equal steps of height, each turned by the golden angle from the one
below. On spheres and cylinders alike equal steps of height are equal areas (Archimedes).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import elliprg

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
ENDS = ("-z", "+z")
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])  # powers of 1/1.3247…: they fill a square evenly
_PIECES = 24  # per point of a mesh, at least
_LEAST_PIECES = 20_000
_MOVES = 8

Array = NDArray[np.float64]


def box_surface(
    half: Sequence[float], resolution: Sequence[int], *, faces: Sequence[str] = FACES
) -> tuple[Array, Array]:
    """Points of a regular grid that lie on the surface of a box; edges and corners are among them, once each.

    Parameters
    ----------
    half: half sizes [m]
    resolution: points along x, y, z, at least 2 each, edges included
    faces: which faces to sample, of -x +x -y +y -z +z

    Returns
    -------
    points [m], shape (n, 3), in the box's frame; areas across x, y, z [m²], shape (n, 3), in all those of the faces.
    Raises UsageError on a resolution below 2 or an unknown face.
    """
    counts = [int(n) for n in resolution]
    if len(counts) != 3 or min(counts) < 2:
        raise UsageError(f"a box needs a resolution of at least 2 points along each of x, y, z, got {list(resolution)}")
    if unknown := [face for face in faces if face not in FACES]:
        raise UsageError(f"unknown face {unknown[0]!r} of a box; faces are {' '.join(FACES)}")
    if len(set(faces)) != len(faces) or not faces:
        raise UsageError(f"faces of a box must be named once each, at least one, got {list(faces)}")
    axes = [np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)]
    # The length nearest to each point: half a spacing at the two ends.
    lengths = [_trapezoid(2 * h, n) for h, n in zip(half, counts, strict=True)]
    areas = np.zeros((*counts, 3))
    chosen = np.zeros(counts, dtype=bool)
    for face in faces:
        axis = "xyz".index(face[1])
        where: list[slice | int] = [slice(None)] * 3
        where[axis] = 0 if face[0] == "-" else -1
        first, second = (lengths[i] for i in range(3) if i != axis)
        areas[(*where, axis)] += first[:, None] * second
        chosen[tuple(where)] = True
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return grid[chosen], areas[chosen]


def disc(
    radius: float, half_thickness: float, *, angles: int = 8, radii: int = 4, faces: Sequence[str] = ENDS
) -> tuple[Array, Array]:
    """Points on the flat faces of a disc about z: the centre, and `radii` rings of `angles` points on each face.

    The rim is sampled by the outermost ring; 8 angles and 4 radii give the 66 points of the published pads.

    Returns
    -------
    points [m], shape (n, 3); areas across x, y, z [m²], shape (n, 3), in all those of the faces.
    Raises UsageError when there are fewer than 3 angles or 1 ring, or on an unknown face.
    """
    if angles < 3 or radii < 1:
        raise UsageError(f"a disc needs at least 3 angles and 1 ring, got angles {angles}, radii {radii}")
    _check_faces("a disc", faces, ENDS)
    ring = radius * np.arange(1, radii + 1) / radii
    # Cells end half way between rings; the outermost ends at the rim.
    borders = np.append((ring - radius / radii / 2), radius)
    cell = np.pi * np.diff(borders**2) / angles
    phi = 2 * np.pi * np.arange(angles) / angles
    around = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    flat = np.concatenate([np.zeros((1, 2)), (ring[:, None, None] * around).reshape(-1, 2)])
    areas = np.concatenate([[np.pi * borders[0] ** 2], np.repeat(cell, angles)])
    heights = [-half_thickness if face == "-z" else half_thickness for face in faces]
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), z)]) for z in heights])
    return points, np.tile(areas, len(heights))[:, None] * [0.0, 0.0, 1.0]


def cylinder(
    radius: float,
    half_length: float,
    *,
    angles: int = 16,
    radii: int = 2,
    heights: int = 5,
    faces: Sequence[str] = (*ENDS, "wall"),
) -> tuple[Array, Array]:
    """Points on a cylinder about z: its ends as in `disc`, and `heights` rows of `angles` points on its wall.

    The wall's rows reach from end to end; where an end is sampled too, its rim is among the points once.

    Returns
    -------
    points [m], shape (n, 3); areas across x, y, z [m²], shape (n, 3), in all those of the faces.
    Raises UsageError when there are fewer than 3 angles, 1 ring or 2 heights, or on an unknown face.
    """
    _check_faces("a cylinder", faces, (*ENDS, "wall"))
    ends = [face for face in faces if face != "wall"]
    points, areas = np.zeros((0, 3)), np.zeros((0, 3))
    if ends:
        points, areas = disc(radius, half_length, angles=angles, radii=radii, faces=ends)
    if "wall" not in faces:
        return points, areas
    if angles < 3 or heights < 2:
        raise UsageError(f"a cylinder's wall needs at least 3 angles and 2 heights, got {angles} and {heights}")
    strip = _trapezoid(2 * half_length, heights) * (2 * np.pi * radius / angles)
    rows = np.linspace(-half_length, half_length, heights)
    per_end = len(points) // max(len(ends), 1)
    phi = 2 * np.pi * np.arange(angles) / angles
    outwards = np.column_stack([np.cos(phi), np.sin(phi), np.zeros(angles)])
    for row, end in ((0, "-z"), (-1, "+z")):
        if end in ends:  # the outermost ring is the last of an end's points
            last = (ends.index(end) + 1) * per_end
            areas[last - angles : last] += strip[row] * outwards**2
    kept = slice(1 if "-z" in ends else 0, heights - 1 if "+z" in ends else heights)
    wall = [radius * outwards + [0, 0, z] for z in rows[kept]]
    return np.concatenate([points, *wall]), np.concatenate([areas, *(cell * outwards**2 for cell in strip[kept])])


def capsule(radius: float, half_length: float, *, count: int, faces: Sequence[str] = ENDS) -> tuple[Array, Array]:
    """`count` points on a capsule about z, near-uniform and of equal area; of a sphere where `half_length` is 0.

    `faces` chooses the halves below and above the middle, "-z" and "+z".

    Returns
    -------
    points [m], shape (count, 3); areas across x, y, z [m²], shape (count, 3), in all that of the chosen halves.
    Raises UsageError on a count below 1 or an unknown face.
    """
    height = _heights("a capsule", count, faces) * (radius + half_length)
    along = np.clip(height, -half_length, half_length)
    around = np.sqrt(np.maximum(radius**2 - (height - along) ** 2, 0))
    area = 2 * np.pi * radius * (radius + half_length) * len(faces)
    points = np.column_stack([around[:, None] * _spiral(count), height])
    outwards = np.column_stack([points[:, :2], height - along]) / radius
    return points, outwards**2 * (area / count)


def ellipsoid(axes: Sequence[float], *, count: int, faces: Sequence[str] = ENDS) -> tuple[Array, Array]:
    """`count` points on an ellipsoid with these half axes [m]: those of a sphere, stretched.

    Each weight is proportional to how much the stretch enlarges the surface there; `faces` as in `capsule`.

    Returns
    -------
    points [m], shape (count, 3); areas across x, y, z [m²], shape (count, 3), in all that of the chosen halves.
    Raises UsageError on a count below 1 or an unknown face.
    """
    height = _heights("an ellipsoid", count, faces)
    sphere = np.column_stack([np.sqrt(1 - height**2)[:, None] * _spiral(count), height])
    a, b, c = axes
    enlarged = np.linalg.norm(sphere / axes, axis=1)
    whole = 4 * np.pi * elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2)  # Carlson's symmetric integral
    outwards = sphere / axes / enlarged[:, None]
    return sphere * axes, outwards**2 * (enlarged * (whole * len(faces) / 2 / enlarged.sum()))[:, None]


def mesh_surface(mesh: TriangleMesh, *, count: int) -> tuple[Array, Array]:
    """`count` points on a mesh, spread near-uniformly; the same ones each time.

    The surface is cut into many pieces of equal area, each standing at one place. Points start at every so many pieces
    and move to the middle of the pieces nearest to them, some times over. Sides that face different ways count as
    further apart, so that a point does not stand for both sides of a sheet or of an edge.

    Returns
    -------
    points [m], shape (count, 3), on the surface but not on purpose on its edges; areas across x, y, z [m²], shape
    (count, 3): the pieces nearest to each, in all the mesh's area.
    Raises UsageError on a count below 1 or above 20 000.
    """
    if not 1 <= count <= _LEAST_PIECES:
        raise UsageError(f"a mesh needs a count of 1 to {_LEAST_PIECES}, got {count}")
    areas, normals = mesh.areas_and_normals()
    number = max(_PIECES * count, _LEAST_PIECES)
    whole = float(areas.sum())
    face = np.searchsorted(np.cumsum(areas), (np.arange(number) + 0.5) / number * whole).clip(max=len(areas) - 1)
    u, v = (np.outer(_PLASTIC, np.arange(number)) + 0.5) % 1
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    pieces = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    space = np.column_stack([pieces / np.sqrt(whole / count), normals[face]])
    tree = cKDTree(space)  # in its order neighbours are near
    chosen = tree.indices[((np.arange(count) + 0.5) * number / count).astype(int)]
    for _ in range(_MOVES):
        _, owner = cKDTree(space[chosen]).query(space)
        middle = np.stack([np.bincount(owner, along, count) for along in space.T], axis=-1)
        _, chosen = tree.query(middle / np.bincount(owner, minlength=count).clip(min=1)[:, None])
        chosen = _distinct(chosen, number)
    _, owner = cKDTree(space[chosen]).query(space)
    shares: Array = np.stack([np.bincount(owner, share, count) for share in (normals[face] ** 2).T], axis=-1)
    points: Array = pieces[chosen]
    areas_across: Array = (shares * (whole / number)).astype(float)
    return points, areas_across


def _distinct(chosen: NDArray[np.int64], number: int) -> NDArray[np.int64]:
    """The same numbers below `number`, but what is there twice replaced by ones that are not there."""
    _, first = np.unique(chosen, return_index=True)
    again = np.setdiff1d(np.arange(len(chosen)), first)
    free = np.setdiff1d(np.arange(number), chosen)
    chosen = chosen.copy()
    chosen[again] = free[np.linspace(0, len(free) - 1, len(again)).astype(int)]
    return chosen


def disc_lattice(radius: float, count: int) -> Array:
    """`count` points spread near-uniformly over a disc, as a sunflower's seeds [m], shape (count, 2)."""
    return radius * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * _spiral(count)


def shortest_rotations(normals: Array) -> Array:
    """Axes x y z turned the shortest way until z is each of these unit normals: columns, shape (n, 3, 3).

    Where a normal is −z, they are turned about y.
    """
    x, y, z = normals.T
    # 1 + z, without cancellation near z = −1.
    above = np.where(z < 0, (x * x + y * y) / (1 - np.minimum(z, 0)), 1 + z)
    opposite = above < 1e-24
    share = 1 / np.where(opposite, 1, above)
    first = np.stack([1 - x * x * share, -x * y * share, -x], axis=-1)
    second = np.stack([-x * y * share, 1 - y * y * share, -y], axis=-1)
    first[opposite], second[opposite] = (-1, 0, 0), (0, 1, 0)
    return np.stack([first, second, normals], axis=-1)


def _spiral(count: int) -> Array:
    """Directions in the plane, each turned by the golden angle from the one before, shape (count, 2)."""
    angle = _GOLDEN_ANGLE * np.arange(count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _heights(what: str, count: int, faces: Sequence[str]) -> Array:
    """Equal steps of height between −1 and 1, or over the chosen half, each point in the middle of its step."""
    _check_faces(what, faces, ENDS)
    if count < 1:
        raise UsageError(f"{what} needs a count of at least 1, got {count}")
    low, high = -1.0 if "-z" in faces else 0.0, 1.0 if "+z" in faces else 0.0
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _check_faces(what: str, faces: Sequence[str], known: Sequence[str]) -> None:
    if not faces or any(face not in known for face in faces) or len(set(faces)) != len(faces):
        *most, last = known
        raise UsageError(f"faces of {what} are {', '.join(most)} and {last}, once each, got {list(faces)}")


def _trapezoid(length: float, count: int) -> Array:
    weights = np.full(count, length / (count - 1))
    weights[[0, -1]] /= 2
    return weights
