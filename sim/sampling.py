"""Points sampled on surfaces, with the area that each stands for.

A contact is felt at points. Where stiffness is given per area, a point's weight is the part of the surface nearest to
it, clipped to the face, so that the weights add up to the area exactly and results converge as points get denser.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")

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
    points [m], shape (n, 3), in the box's frame; weights [m²], shape (n,), whose sum is the area of the faces.
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
    weights = np.zeros(counts)
    chosen = np.zeros(counts, dtype=bool)
    for face in faces:
        axis = "xyz".index(face[1])
        where: list[slice | int] = [slice(None)] * 3
        where[axis] = 0 if face[0] == "-" else -1
        first, second = (lengths[i] for i in range(3) if i != axis)
        weights[tuple(where)] += first[:, None] * second
        chosen[tuple(where)] = True
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return grid[chosen], weights[chosen]


def disc(
    radius: float, half_thickness: float, *, angles: int = 8, radii: int = 4, faces: Sequence[str] = ("-z", "+z")
) -> tuple[Array, Array]:
    """Points on the flat faces of a disc about z: the centre, and `radii` rings of `angles` points on each face.

    The rim is sampled by the outermost ring; 8 angles and 4 radii give the 66 points of the published pads.

    Returns
    -------
    points [m], shape (n, 3); weights [m²], shape (n,), whose sum is the area of the faces.
    Raises UsageError when there are fewer than 3 angles or 1 ring, or on an unknown face.
    """
    if angles < 3 or radii < 1:
        raise UsageError(f"a disc needs at least 3 angles and 1 ring, got angles {angles}, radii {radii}")
    if not faces or any(face not in ("-z", "+z") for face in faces) or len(set(faces)) != len(faces):
        raise UsageError(f"faces of a disc are -z and +z, once each, got {list(faces)}")
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
    return points, np.tile(areas, len(heights))


def _trapezoid(length: float, count: int) -> Array:
    weights = np.full(count, length / (count - 1))
    weights[[0, -1]] /= 2
    return weights
