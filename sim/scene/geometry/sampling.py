"""Points sampled on surfaces, with the area that each point represents.

With stiffness per area, the weight of a point is the area of its cell: the part of the surface that is nearest to it,
clipped to the face. The weights sum to the area exactly, so forces converge as the sampling is refined. The area of a
point has three components, one for each axis, which sum to the area: an area with normal n has the fractions n². A
point on an edge has a contribution from each of its faces. The components give the area after scaling along the axes
(docs/reference/physics.md).

Round surfaces have a Fibonacci lattice: points at equal steps of height, each rotated by the golden angle from the one
below. Equal steps of height are equal areas on spheres and on cylinders (Archimedes).
"""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
ENDS = ("-z", "+z")
MANY_POINTS, MOST_POINTS = 1_000_000, 20_000_000  # a point takes up to 0.5 kB
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_PLASTIC = np.array(
    [0.7548776662466927, 0.5698402909980532]
)  # powers of 1/1.3247…: low-discrepancy sequence in a square
_SAMPLES_PER_POINT = 24  # of a mesh, at least
_MIN_SAMPLES = 20_000
_LLOYD_ITERATIONS = 8

Array = NDArray[np.float64]


def check_memory(owner: str, count: int) -> None:
    """Raise UsageError for a number of points that does not fit into memory."""
    if count > MOST_POINTS:
        raise UsageError(f"{owner}: {count} points do not fit into memory; at most {MOST_POINTS}")


def check_count(owner: str, count: int) -> None:
    """Warn about a number of points that takes long; raise UsageError for one that does not fit into memory."""
    check_memory(owner, count)
    if count > MANY_POINTS:
        warnings.warn(f"{owner}: {count} points; each step evaluates all that are near a shape", stacklevel=2)


def box_surface(
    half: Sequence[float], resolution: Sequence[int], *, faces: Sequence[str] = FACES
) -> tuple[Array, Array]:
    """Points of a regular grid on the surface of a box, including edges and corners once.

    Parameters
    ----------
    half: half sizes [m]
    resolution: number of points along x, y, z, at least 2 each, including the edges
    faces: faces to sample, some of -x +x -y +y -z +z

    Returns
    -------
    points in the frame of the box [m], shape (n, 3); area components along x, y, z [m²], shape (n, 3), which sum to
    the area of the faces. Raises UsageError on a resolution below 2 or an unknown face.
    """
    counts = [int(n) for n in resolution]
    if len(counts) != 3 or min(counts) < 2:
        raise UsageError(f"a box needs a resolution of at least 2 points along each of x, y, z, got {list(resolution)}")
    if unknown := [face for face in faces if face not in FACES]:
        raise UsageError(f"unknown face {unknown[0]!r} of a box; faces are {' '.join(FACES)}")
    if len(set(faces)) != len(faces) or not faces:
        raise UsageError(f"a box needs at least one face, each named once, got {list(faces)}")
    check_count("box", counts[0] * counts[1] * counts[2])
    axes = [np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)]
    lengths = [_trapezoid(2 * h, n) for h, n in zip(half, counts, strict=True)]
    return _surface_of_grid(axes, lengths, faces)


def box_grid(axes: Sequence[Array], *, faces: Sequence[str] = FACES) -> tuple[Array, Array]:
    """Points on the surface of a box, of a grid with any increasing coordinates [m] along x, y, z.

    The first and last coordinates are those of the faces. Returns points and areas as `box_surface`.
    """
    return _surface_of_grid(
        axes, [(np.diff(axis, prepend=axis[0]) + np.diff(axis, append=axis[-1])) / 2 for axis in axes], faces
    )


def _surface_of_grid(axes: Sequence[Array], lengths: Sequence[Array], faces: Sequence[str]) -> tuple[Array, Array]:
    """The points of a grid that are on faces of its box; `lengths` are the cell lengths of the trapezoidal rule."""
    counts = [len(axis) for axis in axes]
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

    The outermost ring is on the rim. 8 angles and 4 radii give the 66 points of the published pads.

    Returns
    -------
    points [m], shape (n, 3); area components along x, y, z [m²], shape (n, 3), which sum to the area of the faces.
    Raises UsageError on fewer than 3 angles or 1 ring, or on an unknown face.
    """
    if angles < 3 or radii < 1:
        raise UsageError(f"a disc needs at least 3 angles and 1 ring, got angles {angles}, radii {radii}")
    _check_faces("a disc", faces, ENDS)
    ring = radius * np.arange(1, radii + 1) / radii
    # Cells end halfway between rings; the outermost cell ends at the rim.
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

    The rows of the wall include both rims. The points of a rim that is also on a sampled end occur once.

    Returns
    -------
    points [m], shape (n, 3); area components along x, y, z [m²], shape (n, 3), which sum to the area of the faces.
    Raises UsageError on fewer than 3 angles, 1 ring or 2 heights, or on an unknown face.
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
        if end in ends:  # the outermost ring is stored last
            last = (ends.index(end) + 1) * per_end
            areas[last - angles : last] += strip[row] * outwards**2
    kept = slice(1 if "-z" in ends else 0, heights - 1 if "+z" in ends else heights)
    wall = [radius * outwards + [0, 0, z] for z in rows[kept]]
    return np.concatenate([points, *wall]), np.concatenate([areas, *(cell * outwards**2 for cell in strip[kept])])


def capsule(radius: float, half_length: float, *, count: int, faces: Sequence[str] = ENDS) -> tuple[Array, Array]:
    """`count` nearly uniform points of equal area on a capsule about z, or on a sphere if `half_length` is 0.

    `faces` selects the lower and the upper half, "-z" and "+z".

    Returns
    -------
    points [m], shape (count, 3); area components along x, y, z [m²], shape (count, 3), which sum to the area of the
    selected halves.
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
    """`count` points on an ellipsoid with half axes `axes` [m]: the points of a sphere, scaled along the axes.

    The area of a point is proportional to the local area ratio of the scaling. `faces` is as in `capsule`.

    Returns
    -------
    points [m], shape (count, 3); area components along x, y, z [m²], shape (count, 3), which sum to the area of the
    selected halves.
    Raises UsageError on a count below 1 or an unknown face.
    """
    from scipy.special import elliprg  # deferred: only ellipsoids need it

    height = _heights("an ellipsoid", count, faces)
    sphere = np.column_stack([np.sqrt(1 - height**2)[:, None] * _spiral(count), height])
    a, b, c = axes
    area_ratio = np.linalg.norm(sphere / axes, axis=1)
    total = 4 * np.pi * elliprg((a * b) ** 2, (a * c) ** 2, (b * c) ** 2)  # Carlson's symmetric integral
    outwards = sphere / axes / area_ratio[:, None]
    return sphere * axes, outwards**2 * (area_ratio * (total * len(faces) / 2 / area_ratio.sum()))[:, None]


def mesh_surface(mesh: TriangleMesh, *, count: int) -> tuple[Array, Array]:
    """`count` nearly uniform points on a mesh; deterministic.

    The surface is divided into samples of equal area, and Lloyd's algorithm clusters them: each point moves to the
    sample nearest to the mean of its cell. The metric includes the normals, so that a point does not represent both
    sides of a sheet or of an edge.

    Returns
    -------
    points on the surface [m], shape (count, 3); area components of their cells along x, y, z [m²], shape (count, 3),
    which sum to the area of the mesh. Raises UsageError on a count below 1 or above 20 000.
    """
    from scipy.spatial import cKDTree  # deferred: only meshes need it

    if not 1 <= count <= _MIN_SAMPLES:
        raise UsageError(f"a mesh needs a count of 1 to {_MIN_SAMPLES}, got {count}")
    samples, normals, total = _equal_area_samples(mesh, max(_SAMPLES_PER_POINT * count, _MIN_SAMPLES))
    number = len(samples)
    features = np.column_stack([samples / np.sqrt(total / count), normals])
    tree = cKDTree(features)  # tree.indices is spatially ordered: strided indices are spread over the mesh
    chosen = tree.indices[((np.arange(count) + 0.5) * number / count).astype(int)]
    for _ in range(_LLOYD_ITERATIONS):
        _, owner = cKDTree(features[chosen]).query(features)
        sums = np.stack([np.bincount(owner, feature, count) for feature in features.T], axis=-1)
        _, chosen = tree.query(sums / np.bincount(owner, minlength=count).clip(min=1)[:, None])
        chosen = _distinct(chosen, number)
    _, owner = cKDTree(features[chosen]).query(features)
    fractions: Array = np.stack([np.bincount(owner, fraction, count) for fraction in (normals**2).T], axis=-1)
    points: Array = samples[chosen]
    areas: Array = (fractions * (total / number)).astype(float)
    return points, areas


def mesh_samples(mesh: TriangleMesh, number: int) -> Array:
    """`number` points of a low-discrepancy sequence on a mesh [m], shape (number, 3); deterministic."""
    return _equal_area_samples(mesh, number)[0]


def _equal_area_samples(mesh: TriangleMesh, number: int) -> tuple[Array, Array, float]:
    """Samples of equal area [m], their normals, both of shape (number, 3), and the area of the mesh [m²]."""
    areas, normals = mesh.areas_and_normals()
    total = float(areas.sum())
    face = np.searchsorted(np.cumsum(areas), (np.arange(number) + 0.5) / number * total).clip(max=len(areas) - 1)
    u, v = (np.outer(_PLASTIC, np.arange(number)) + 0.5) % 1
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, i]] for i in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), normals[face], total


def _distinct(chosen: NDArray[np.int64], number: int) -> NDArray[np.int64]:
    """Indices below `number`; repeated ones are replaced by unused ones."""
    _, first = np.unique(chosen, return_index=True)
    repeated = np.setdiff1d(np.arange(len(chosen)), first)
    unused = np.setdiff1d(np.arange(number), chosen)
    chosen = chosen.copy()
    chosen[repeated] = unused[np.linspace(0, len(unused) - 1, len(repeated)).astype(int)]
    return chosen


def disc_lattice(radius: float, count: int) -> Array:
    """`count` nearly uniform points on a disc (Fibonacci lattice) [m], shape (count, 2)."""
    return radius * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * _spiral(count)


def shortest_rotations(normals: Array) -> Array:
    """Rotation matrices of the smallest angle that map z to unit normals (n, 3), shape (n, 3, 3).

    For a normal equal to −z, the rotation is about y.
    """
    x, y, z = normals.T
    # 1 + z without cancellation near z = −1.
    above = np.where(z < 0, (x * x + y * y) / (1 - np.minimum(z, 0)), 1 + z)
    opposite = above < 1e-24
    share = 1 / np.where(opposite, 1, above)
    first = np.stack([1 - x * x * share, -x * y * share, -x], axis=-1)
    second = np.stack([-x * y * share, 1 - y * y * share, -y], axis=-1)
    first[opposite], second[opposite] = (-1, 0, 0), (0, 1, 0)
    return np.stack([first, second, normals], axis=-1)


def _spiral(count: int) -> Array:
    """Unit vectors in the plane, each rotated by the golden angle from the one before, shape (count, 2)."""
    angle = _GOLDEN_ANGLE * np.arange(count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _heights(solid: str, count: int, faces: Sequence[str]) -> Array:
    """Midpoints of equal steps of height over [−1, 1] or over the selected half."""
    _check_faces(solid, faces, ENDS)
    if count < 1:
        raise UsageError(f"{solid} needs a count of at least 1, got {count}")
    low, high = -1.0 if "-z" in faces else 0.0, 1.0 if "+z" in faces else 0.0
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _check_faces(solid: str, faces: Sequence[str], valid: Sequence[str]) -> None:
    if not faces or any(face not in valid for face in faces) or len(set(faces)) != len(faces):
        raise UsageError(f"faces of {solid} must be some of {', '.join(valid)}, each named once, got {list(faces)}")


def _trapezoid(length: float, count: int) -> Array:
    """Weights of the trapezoidal rule."""
    weights = np.full(count, length / (count - 1))
    weights[[0, -1]] /= 2
    return weights
