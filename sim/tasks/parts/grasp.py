"""The grasp of a part: how far the pads indent before they carry the grasp force."""

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene import Scene
from gelflow.sim.tasks.parts.geometry import PartGeometry

Array = NDArray[np.float64]


def pad_gaps(scene: Scene, geometry: PartGeometry, pad: str, height: Array) -> Array:
    """Distances from the contact points of a pad that just meets the part to the part, sorted [m], shape (N, n).

    `pad` is "pad_left" or "pad_right", `height` (N,) that of the pad's centre above the part's centre [m]. A pad is a
    disc with contact points on both faces; the face in contact is at x = 0 of its finger.
    """
    points = next(p for p in scene.points if p.name == pad).points
    face = points[np.abs(points[:, 0]) < 1e-9, 1:]
    at = np.broadcast_to(face, (len(height), *face.shape)) + np.array([0.0, 1.0]) * height[:, None, None]
    return np.sort(geometry.side_gaps(at, -1 if pad == "pad_left" else 1), axis=1)


def indentation(gaps: Array, force: Array, stiffness: Array) -> Array:
    """Indentation [m], shape (N,), at which springs of `stiffness` (N,) [N/m] behind `gaps` (N, n) carry `force` (N,).

    `gaps` are sorted. With k springs in contact the force is stiffness · (k δ − the sum of their gaps); any other k
    gives a larger δ, because the force of all springs is convex.
    """
    count = np.arange(1, gaps.shape[1] + 1)
    closed = stiffness[:, None] * np.cumsum(gaps, axis=1)
    return np.asarray(((force[:, None] + closed) / (stiffness[:, None] * count)).min(1))
