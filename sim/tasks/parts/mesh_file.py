"""Reads the mesh files of parts and holes and identifies them by their digest."""

import hashlib
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.mesh import TriangleMesh, closed_mesh, read_mesh


def load_mesh(path: Path, scale: float) -> TriangleMesh:
    """A closed mesh in metres.

    Raises UsageError when the file cannot be read, or the mesh is not watertight (the message has the number of open
    edges).
    """
    raw = read_mesh(path)
    return closed_mesh(TriangleMesh(raw.vertices * scale, raw.faces), path.name)


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
