"""Triangles of geometries for the page."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.mjcf.mechanics import GeomDef

Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]


def triangles(geom: GeomDef) -> Triangles:
    """Vertices [m] (n, 3) and faces (m, 3) of a geometry in its own frame; planes have none."""
    import trimesh  # deferred: comes with viser

    creation: Any = trimesh.creation
    radius, half, third = (float(x) for x in geom.size)
    if geom.mesh is not None:
        return geom.mesh.vertices, geom.mesh.faces
    if geom.kind == "box":
        made = creation.box(extents=2 * geom.size)
    elif geom.kind == "cylinder":
        made = creation.cylinder(radius=radius, height=2 * half, sections=48)
    elif geom.kind == "capsule":
        made = creation.capsule(radius=radius, height=2 * half, count=(24, 32))
    else:
        made = creation.icosphere(subdivisions=3, radius=1.0)
        made.apply_scale((radius, half, third) if geom.kind == "ellipsoid" else radius)
    return np.asarray(made.vertices, dtype=float), np.asarray(made.faces, dtype=np.int64)


def has_edges(geom: GeomDef) -> bool:
    """Whether neighbouring faces are shaded apart."""
    return geom.kind == "box" or geom.mesh is not None
