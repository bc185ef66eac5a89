"""Reads the mesh files of parts and holes and identifies them by their digest."""

import hashlib
from pathlib import Path

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, read_mesh

_LONGEST = 0.256  # [m]; the largest grid of distances, 512 cells of 0.5 mm


def load_mesh(path: Path, scale: float) -> TriangleMesh:
    """A closed mesh in metres.

    Raises UsageError when the file cannot be read, or the mesh is too long or not watertight (the message has the
    number of open edges).
    """
    raw = read_mesh(path)
    mesh = TriangleMesh(raw.vertices * scale, raw.faces)
    if len(mesh.vertices) and (size := np.ptp(mesh.vertices, axis=0)).max() > _LONGEST:
        x, y, z = size
        raise UsageError(
            f"mesh {path.name!r} is {x:.4g} x {y:.4g} x {z:.4g} m, but may be at most {_LONGEST:g} m long; scale is "
            "metres per unit of the file, such as 0.001 for millimetres; of a hole, cut off what the part cannot reach"
        )
    return closed_mesh(mesh, path.name)


def file_digest(path: Path) -> str:
    """SHA-256 of a file. Raises UsageError when it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise UsageError(f"cannot read the mesh {path}: {error.strerror}") from None


def described_mesh(what: str, file: str, digest: str, scale: float) -> TriangleMesh:
    """The mesh of a description: of `what` (for messages), in `file`, with the digest of the description.

    Raises UsageError when the file is unknown, missing, not watertight, or has changed.
    """
    if not file:
        raise UsageError(f"{what} is a mesh, which its description does not contain; give its part file")
    if file_digest(Path(file)) != digest:
        raise UsageError(f"the mesh {file} has changed since {what} was described")
    return load_mesh(Path(file), scale)
