"""Explicit lists of markers, from the TOML table of a pad or from a CSV or NPZ file."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.sampling import check_count, check_memory, shortest_rotations
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

_BYTES = 24  # of a position
_ARRAYS = ("positions", "normals", "x_axes")


def read_marker_list(table: TomlTable, folder: Path) -> tuple[Array, Array]:
    """Positions [m], shape (n, 3), and axes (columns x, y, z), shape (n, 3, 3), of listed markers.

    Without normals the axes are those of the site. With normals they are the axes of the site, rotated by the
    smallest angle such that z is the normal; a given x axis is orthogonalized against the normal. Raises UsageError
    on a missing or unreadable file and on invalid arrays.
    """
    arrays, location = _arrays(table, folder)
    positions = _vectors(arrays, "positions", location)
    count = len(positions)
    check_count(location, count)
    normals = _unit_vectors(arrays, "normals", location, count)
    axes = np.tile(np.eye(3), (count, 1, 1)) if normals is None else shortest_rotations(normals)
    x_axes = _unit_vectors(arrays, "x_axes", location, count)
    if x_axes is not None:
        x = x_axes - (x_axes * axes[..., 2]).sum(1, keepdims=True) * axes[..., 2]
        length = np.linalg.norm(x, axis=1, keepdims=True)
        if (length < 1e-6).any():
            raise UsageError(f"{location}: x_axes[{int(length.argmin())}] is parallel to the normal")
        x /= length
        axes = np.stack([x, np.cross(axes[..., 2], x), axes[..., 2]], axis=-1)
    return positions, axes


def _arrays(table: TomlTable, folder: Path) -> tuple[Mapping[str, Any], str]:
    """The arrays of a table or of its file, and their location for error messages."""
    if ("positions" in table.data) == ("file" in table.data):
        raise UsageError(f"{table.location}: a pad of points needs either positions or a file")
    if "file" not in table.data:
        return {key: table.data[key] for key in _ARRAYS if key in table.data}, table.location
    if extra := [key for key in _ARRAYS if key in table.data]:
        raise UsageError(f"{table.location}: {extra[0]} must be in the file, together with the positions")
    path = folder / table.string("file")
    location = f"{table.location}: {path.name}"
    return _read_file(path, location), location


def _read_file(path: Path, location: str) -> Mapping[str, Any]:
    """The arrays of an NPZ file, or the columns of a CSV file: position, normal, x axis."""
    if path.suffix not in (".csv", ".npz"):
        raise UsageError(f"{location}: a file of markers must be .csv or .npz")
    try:
        if path.suffix == ".npz":
            with path.open("rb") as file:
                if not zipfile.is_zipfile(file):
                    raise UsageError(f"{location} cannot be read: it is not an NPZ file")
            with np.load(path, allow_pickle=False) as content:
                check_memory(location, max((info.file_size for info in content.zip.infolist()), default=0) // _BYTES)
                arrays = {name: content[name] for name in content.files}
        else:
            with path.open("rb") as lines:
                check_memory(location, sum(1 for _ in lines))
            columns = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except UsageError:
        raise
    except FileNotFoundError:
        raise UsageError(f"{location}: no such file in the folder of the scene") from None
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UsageError(f"{location} cannot be read: {str(error).splitlines()[0]}") from None
    if path.suffix == ".npz":
        if unknown := [name for name in arrays if name not in _ARRAYS]:
            raise UsageError(f"{location}: unknown array {unknown[0]!r}; valid names: {', '.join(_ARRAYS)}")
        return arrays
    if columns.shape[1] not in (3, 6, 9):
        raise UsageError(f"{location}: expected 3, 6 or 9 columns (position, normal, x axis), got {columns.shape[1]}")
    return dict(zip(_ARRAYS, np.split(columns, columns.shape[1] // 3, axis=1), strict=False))


def _vectors(arrays: Mapping[str, Any], key: str, location: str) -> Array:
    try:
        vectors = np.array(arrays.get(key, ()), dtype=float)
    except (TypeError, ValueError):
        vectors = np.zeros(0)
    if vectors.ndim != 2 or vectors.shape[1] != 3 or not len(vectors) or not np.isfinite(vectors).all():
        raise UsageError(f"{location}: {key} must be a list of [x, y, z], all finite")
    return vectors


def _unit_vectors(arrays: Mapping[str, Any], key: str, location: str, count: int) -> Array | None:
    """The vectors `key`, normalized, shape (count, 3); None if absent."""
    if key not in arrays:
        return None
    vectors = _vectors(arrays, key, location)
    if len(vectors) != count:
        raise UsageError(f"{location}: {key} must have one entry per position, {count}, got {len(vectors)}")
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if (length < 1e-9).any():
        raise UsageError(f"{location}: {key}[{int(length.argmin())}] has length 0")
    units: Array = vectors / length
    return units
