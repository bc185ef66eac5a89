"""Triangles of COLLADA files (.dae), the mesh format of many URDF files, read by pycollada."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh


def read_collada(path: Path) -> TriangleMesh:
    """The triangles of all geometries in the scene of a .dae file [m], placed by its nodes.

    The unit of the file is converted to metres. Its up axis is ignored, as ROS and its viewers do: the link frame of
    the URDF is that of the file. Raises UsageError, in one line, if the file cannot be read or has no triangles, and if
    pycollada is not installed.
    """
    try:
        collada, common = (importlib.import_module(name) for name in ("collada", "collada.common"))
    except ImportError:
        raise UsageError(
            f"the mesh {path} requires pycollada: pip install 'gelflow[collada]', or convert it to .stl or .obj"
        ) from None
    try:
        # Materials, images and lights may refer to what is missing; the triangles are complete without them.
        file = collada.Collada(str(path), ignore=[common.DaeUnsupportedError, common.DaeBrokenRefError])
        parts = [part for geometry in _geometries(file) if (part := _triangles(geometry)) is not None]
    except (common.DaeError, OSError, ValueError, KeyError, IndexError) as error:
        raise UsageError(f"cannot read the mesh {path}: {' '.join(str(error).split())}") from None
    if not parts:
        raise UsageError(f"the mesh {path} has no triangles")
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, first, strict=False)])
    return TriangleMesh(
        float(file.assetInfo.unitmeter or 1.0) * np.concatenate([part.vertices for part in parts]), faces
    )


def _geometries(file: Any) -> list[Any]:
    """The geometries as the nodes of the scene place them, or all geometries of a file without a scene."""
    return list(file.scene.objects("geometry")) if file.scene is not None else list(file.geometries)


def _triangles(geometry: Any) -> TriangleMesh | None:
    """Triangles of a geometry in the unit of its file; None if it has none, such as lines."""
    vertices, faces, count = [], [], 0
    for primitive in _primitives(geometry):
        triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
        index = getattr(triangles, "vertex_index", None)
        if index is None or index.ndim != 2 or index.shape[1] != 3 or not len(index):
            continue
        vertices.append(np.asarray(triangles.vertex, dtype=float))
        faces.append(np.asarray(index, dtype=np.int64) + count)
        count += len(vertices[-1])
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces)) if vertices else None


def _primitives(geometry: Any) -> list[Any]:
    """The primitives of a geometry; those that a scene places are computed by a function."""
    return list(geometry.primitives() if callable(geometry.primitives) else geometry.primitives)
