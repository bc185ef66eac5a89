"""Gels: linear maps from tactile forces [N] to marker displacements [m].

Components are along x and y of the marker and into the pad. In these components the compliance matrix is symmetric
(reciprocity) and positive definite. It is its own transpose, so the same product maps gradients with respect to
displacements to gradients with respect to forces.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.arguments import floating
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

MAX_LAYER_MARKERS = 1000  # the compliance matrix of a layer has 9 n² entries

_SPRING_KEYS = ("compliance", "normal_compliance")
_LAYER_KEYS = ("youngs_modulus", "poisson_ratio", "thickness")
_RENAMED_KEYS = {"normal": "normal_compliance", "modulus": "youngs_modulus", "poisson": "poisson_ratio"}


@dataclass(frozen=True)
class SpringGel:
    """Independent springs: the displacement of a marker depends on its own force only."""

    shear_compliance: float  # [m/N]
    normal_compliance: float  # [m/N]

    def __str__(self) -> str:
        shear, normal = self.shear_compliance * 1e3, self.normal_compliance * 1e3
        return f"compliance {shear:g} mm/N in shear, {normal:g} mm/N into the pad"

    def displacement(self, forces: Any) -> Any:
        """Displacements [m] under forces [N], arrays or tensors of shape (…, markers, 3)."""
        forces = floating(forces)
        compliance = np.array([self.shear_compliance, self.shear_compliance, self.normal_compliance])
        return forces * _like(compliance, forces)


@dataclass(frozen=True)
class LayerGel:
    """An elastic layer on a rigid back (`elastic_layer`): each force displaces all markers.

    The load of a marker is uniform on its cell: a square for markers on a grid, a disc otherwise.
    """

    youngs_modulus: float  # [Pa]
    poisson_ratio: float
    thickness: float  # [m]; infinite: a half space
    positions: Array  # of the markers on the surface [m], shape (n, 2)
    cell_area: float  # [m²]
    grid_shape: tuple[int, int] | None  # rows, columns; None: markers are not on a grid

    def __str__(self) -> str:
        thickness = self.thickness * 1e3
        return f"layer of {thickness:g} mm, {self.youngs_modulus:g} Pa, Poisson's ratio {self.poisson_ratio:g}"

    @cached_property
    def compliance_matrix(self) -> Array:
        """The compliance [m/N], shape (3 n, 3 n): x, y, normal of each marker. Computed on first use."""
        from gelflow.gel.elastic_layer import round_cell_compliance, square_cell_compliance  # deferred: slow to import

        if self.grid_shape is None:
            radius = np.sqrt(self.cell_area / np.pi)
            blocks = round_cell_compliance(self.positions, radius, self.poisson_ratio, self.thickness)
        else:
            pitch = np.sqrt(self.cell_area)
            blocks = square_cell_compliance(*self.grid_shape, pitch, self.poisson_ratio, self.thickness)
        two_pi_shear_modulus = np.pi * self.youngs_modulus / (1 + self.poisson_ratio)
        xx, xy, yy, xz, yz, zz = blocks / two_pi_shear_modulus
        n = len(self.positions)
        matrix = np.array([[xx, xy, xz], [xy, yy, yz], [-xz, -yz, zz]])
        return np.ascontiguousarray(matrix.transpose(2, 0, 3, 1)).reshape(3 * n, 3 * n)

    @cached_property
    def _single_precision_matrix(self) -> NDArray[np.float32]:
        return self.compliance_matrix.astype(np.float32)

    def displacement(self, forces: Any) -> Any:
        """Displacements [m] under forces [N], arrays or tensors of shape (…, markers, 3)."""
        forces = floating(forces)
        shape = tuple(forces.shape)
        matrix = self._single_precision_matrix if forces.dtype.itemsize == 4 else self.compliance_matrix
        return (forces.reshape(*shape[:-2], 3 * shape[-2]) @ _like(matrix, forces)).reshape(shape)


Gel = SpringGel | LayerGel


def read_gel(table: TomlTable, positions: Array, axes: Array, grid: Grid | None, area: float | None) -> Gel:
    """The gel of the table `gel` of a pad.

    Parameters
    ----------
    table: the table
    positions, axes: of the markers, as in `PadDef`, in any common frame
    grid: of the markers; None if they are not on a grid
    area: per marker [m²]; None if unknown

    Raises UsageError on invalid values, and for a layer whose markers are not coplanar.
    """
    if "compliance" in table.data:
        table.check_keys(_SPRING_KEYS, renamed=_RENAMED_KEYS)
        shear = table.number("compliance", minimum=0)
        return SpringGel(shear, table.number("normal_compliance", shear, minimum=0))
    table.check_keys((*_SPRING_KEYS, *_LAYER_KEYS), renamed=_RENAMED_KEYS)
    if "youngs_modulus" not in table.data:
        raise UsageError(f"{table.location}: give either compliance, or youngs_modulus, poisson_ratio and thickness")
    return _read_layer(table, _planar_positions(table, positions, axes), grid, area)


def _read_layer(table: TomlTable, planar: Array, grid: Grid | None, area: float | None) -> LayerGel:
    table.check_keys(_LAYER_KEYS)
    youngs_modulus, poisson_ratio = table.number("youngs_modulus", minimum=1e-9), table.number("poisson_ratio")
    half_space = table.data.get("thickness") == np.inf
    thickness = np.inf if half_space else table.number("thickness", minimum=1e-9)
    if not -1 < poisson_ratio <= 0.5:
        raise UsageError(f"{table.location}: poisson_ratio must be above -1 and at most 0.5, got {poisson_ratio:g}")
    if len(planar) > MAX_LAYER_MARKERS:
        raise UsageError(f"{table.location}: a layer supports at most {MAX_LAYER_MARKERS} markers, got {len(planar)}")
    cell_area = _cell_area(planar, table.location) if area is None else area
    grid_shape = None if grid is None else (grid.rows, grid.cols)
    return LayerGel(youngs_modulus, poisson_ratio, thickness, planar, cell_area, grid_shape)


def _planar_positions(table: TomlTable, positions: Array, axes: Array) -> Array:
    """Positions in the plane of the markers [m], shape (n, 2). Raises UsageError if they are not coplanar."""
    local = (positions - positions[0]) @ axes[0]
    extent = max(float(np.ptp(local[:, :2], axis=0).max()), 1e-9)
    if np.abs(local[:, 2]).max() > 1e-6 * extent or np.abs(axes - axes[0]).max() > 1e-6:
        raise UsageError(
            f"{table.location}: a layer needs coplanar markers with the same axes; use compliance for this pad"
        )
    return np.ascontiguousarray(local[:, :2])


def _cell_area(planar: Array, location: str) -> float:
    """Cell area of listed markers [m²]: the square of the median distance to the nearest neighbour."""
    from scipy.spatial import cKDTree

    if len(planar) < 2:
        raise UsageError(f"{location}: the cell area of a layer needs at least two markers")
    nearest = cKDTree(planar).query(planar, k=2)[0][:, 1]
    if nearest.min() <= 1e-3 * np.median(nearest):
        raise UsageError(f"{location}: marker {int(nearest.argmin())} and another marker have the same position")
    return float(np.median(nearest)) ** 2


def _like(values: NDArray[Any], forces: Any) -> Any:
    """`values` as an array or tensor of the dtype of `forces`, without a copy if the dtype agrees."""
    if isinstance(forces, np.ndarray):
        return values.astype(forces.dtype, copy=False)
    import torch  # lazy: numpy users do not need torch

    return torch.from_numpy(values).to(forces)
