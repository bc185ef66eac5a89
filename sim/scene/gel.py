"""Gels: linear maps from what markers feel [N] to how far they go [m].

Forces and displacements are read alike: along the pad's x, along its y, and into the pad. In these numbers a gel's
matrix is symmetric (reciprocity: what i does to j, j does to i) and positive definite, so it is its own transpose, and
a gradient by displacements becomes one by forces by the same product.

The layer: isotropic, of thickness h, bonded to a rigid back, without edges. A load on its surface that is a plane wave
of wave number k moves the surface by the same wave. In the plane of wave and normal the equilibrium of the layer is
solved by exp(±kz) (A + Bz), with nothing moving at z = −h; across it by sinh(k (z + h)). With w = kh, G the shear
modulus, κ = 3 − 4ν and D = κ cosh 2w + 2w² + (1 + κ²)/2, the surface yields by 1/(G k) times

    S = tanh w                            across the wave
    A = (1 − ν) (κ sinh 2w + 2w) / D      along it
    C = (1 − ν) (κ sinh 2w − 2w) / D      into the layer
    B = ((1 − 2ν) κ sinh² w − w²) / D     along it by a load into the layer a quarter wave on, and the reverse

and for w → ∞ by those of the half space: 1, 1 − ν, 1 − ν, (1 − 2ν)/2. Back in space these are functions of distance,
Hankel transforms with J0, J1, J2. Every marker's force is spread evenly over its cell, and its displacement is the mean
over that cell; with loads and means over the same cells the matrix stays symmetric and positive definite.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

MAX_MARKERS = 1000  # of a layer: its matrix has 9 n² numbers
_SPRING_KEYS = ("compliance", "normal_compliance")
_LAYER_KEYS = ("youngs_modulus", "poisson_ratio", "thickness")
_RENAMED_KEYS = {"normal": "normal_compliance", "modulus": "youngs_modulus", "poisson": "poisson_ratio"}
_REACH = 30.0  # thicknesses: further away a layer does not move [1]; the half space has no such end
_DEEP = 20.0  # w from which a layer is a half space to rounding
_FINEST = 100.0  # largest wave number times a round cell's radius: the rest is 1e-4 of what a marker does to itself


@dataclass(frozen=True)
class SpringGel:
    """Every marker yields for itself."""

    shear_compliance: float  # [m/N]
    normal_compliance: float  # [m/N]

    def __str__(self) -> str:
        shear, normal = self.shear_compliance * 1e3, self.normal_compliance * 1e3
        return f"compliance {shear:g} mm/N in shear, {normal:g} mm/N into the pad"

    def displacement(self, forces: Any) -> Any:
        """Displacements [m] of markers under forces [N], (…, markers, 3); arrays or tensors."""
        yields = np.array([self.shear_compliance, self.shear_compliance, self.normal_compliance])
        return forces * _like(yields, forces)


@dataclass(frozen=True)
class LayerGel:
    """An elastic layer on a rigid back; the markers' cells are squares on a grid, round elsewhere."""

    youngs_modulus: float  # [Pa]
    poisson_ratio: float
    thickness: float  # [m], may be infinite
    positions: Array  # of the markers on the surface [m], shape (n, 2)
    cell_area: float  # of a marker's cell [m²]
    grid_shape: tuple[int, int] | None  # rows, columns of square cells

    def __str__(self) -> str:
        return (
            f"layer of {self.thickness * 1e3:g} mm, {self.youngs_modulus:g} Pa, Poisson's ratio {self.poisson_ratio:g}"
        )

    @cached_property
    def matrix(self) -> Array:
        """The map [m/N], shape (3 n, 3 n): marker by marker x, y, into the pad. Computed on first use."""
        if self.grid_shape is None:
            blocks = _round_cells(self.positions, np.sqrt(self.cell_area / np.pi), self.poisson_ratio, self.thickness)
        else:
            blocks = _square_cells(*self.grid_shape, np.sqrt(self.cell_area), self.poisson_ratio, self.thickness)
        xx, xy, yy, xz, yz, zz = blocks / (
            np.pi * self.youngs_modulus / (1 + self.poisson_ratio)
        )  # 2π times the shear modulus
        n = len(self.positions)
        matrix = np.array([[xx, xy, xz], [xy, yy, yz], [-xz, -yz, zz]])
        return np.ascontiguousarray(matrix.transpose(2, 0, 3, 1)).reshape(3 * n, 3 * n)

    @cached_property
    def _single(self) -> NDArray[np.float32]:
        return self.matrix.astype(np.float32)

    def displacement(self, forces: Any) -> Any:
        """Displacements [m] of markers under forces [N], (…, markers, 3); arrays or tensors."""
        shape = tuple(forces.shape)
        matrix = self._single if forces.dtype.itemsize == 4 else self.matrix
        return (forces.reshape(*shape[:-2], 3 * shape[-2]) @ _like(matrix, forces)).reshape(shape)


Gel = SpringGel | LayerGel


def _like(numbers: NDArray[Any], forces: Any) -> Any:
    """`numbers` as an array or a tensor of the precision of `forces`; no copy where it has it already."""
    if isinstance(forces, np.ndarray):
        return numbers.astype(forces.dtype, copy=False)
    import torch  # here: who has no tensors needs no torch

    return torch.from_numpy(numbers).to(forces)


def read_gel(table: TomlTable, positions: Array, axes: Array, grid: Grid | None, area: float | None) -> Gel:
    """The gel of a pad's table.

    Markers as in `PadDef`: `positions` [m], (n, 3), `axes` (n, 3, 3), in one frame; `area` that each stands for [m²],
    where it is known. Raises UsageError on wrong values, and for a layer where the markers are not on one plane.
    """
    if "compliance" in table.data:
        table.check_keys(_SPRING_KEYS, renamed=_RENAMED_KEYS)
        shear = table.number("compliance", minimum=0)
        return SpringGel(shear, table.number("normal_compliance", shear, minimum=0))
    table.check_keys((*_SPRING_KEYS, *_LAYER_KEYS), renamed=_RENAMED_KEYS)
    if "youngs_modulus" not in table.data:
        raise UsageError(f"{table.location}: give either compliance, or youngs_modulus, poisson_ratio and thickness")
    table.check_keys(_LAYER_KEYS)
    youngs_modulus, poisson_ratio = table.number("youngs_modulus", minimum=1e-9), table.number("poisson_ratio")
    half_space = table.data.get("thickness") == np.inf
    thickness = np.inf if half_space else table.number("thickness", minimum=1e-9)
    if not -1 < poisson_ratio <= 0.5:
        raise UsageError(f"{table.location}: poisson_ratio must be above -1 and at most 0.5, got {poisson_ratio:g}")
    local = (positions - positions[0]) @ axes[0]
    wide = max(float(np.ptp(local[:, :2], axis=0).max()), 1e-9)
    if np.abs(local[:, 2]).max() > 1e-6 * wide or np.abs(axes - axes[0]).max() > 1e-6:
        raise UsageError(
            f"{table.location}: a layer needs coplanar markers with the same axes; use compliance for this pad"
        )
    if len(local) > MAX_MARKERS:
        raise UsageError(f"{table.location}: a layer takes at most {MAX_MARKERS} markers, got {len(local)}")
    flat = np.ascontiguousarray(local[:, :2])
    cells = _cell_area(flat, table.location) if area is None else area
    return LayerGel(
        youngs_modulus, poisson_ratio, thickness, flat, cells, None if grid is None else (grid.rows, grid.cols)
    )


def _cell_area(flat: Array, where: str) -> float:
    """Of given markers: the square of the distance to the nearest one, in the middle (median)."""
    from scipy.spatial import cKDTree

    if len(flat) < 2:
        raise UsageError(f"{where}: a layer spreads a marker's load as far as to its neighbours; there is only one")
    nearest = cKDTree(flat).query(flat, k=2)[0][:, 1]
    if nearest.min() <= 1e-3 * np.median(nearest):
        raise UsageError(f"{where}: markers {int(nearest.argmin())} and another one are at the same place")
    return float(np.median(nearest)) ** 2


def layer_response(w: Array, poisson: float) -> Array:
    """S, A, B, C of the module's head at wave number times thickness w ≥ 0, shape (4, …)."""
    kappa = 3 - 4 * poisson
    # Everything times 2 exp(−2w), so that nothing overflows.
    e = np.exp(-2 * w)
    d = kappa * (1 + e * e) + e * (4 * w * w + 1 + kappa * kappa)
    sinh, straight = kappa * (1 - e * e), 4 * w * e
    along, into = (1 - poisson) * (sinh + straight) / d, (1 - poisson) * (sinh - straight) / d
    coupling = ((1 - 2 * poisson) * kappa / 2 * (1 - e) ** 2 - 2 * w * w * e) / d
    return np.stack([np.tanh(w), along, coupling, into])


def half_space_response(poisson: float) -> Array:
    """S, A, B, C of the half space, shape (4,)."""
    return np.array([1, 1 - poisson, (1 - 2 * poisson) / 2, 1 - poisson])


def _to_distance(response: Array, weights: Array, waves: Array, distances: Array) -> Array:
    """Σ over waves of weight · response · Bessel function, at distances; shape (4, distances).

    The four are what `_blocks` takes: mean and deviation of the shear, what a load into the pad does to shear, and
    what it does to depth.
    """
    s, a, b, c = response * weights
    x = np.maximum(np.multiply.outer(distances, waves), 1e-9)
    zero, one = j0(x), j1(x)
    two = 2 * one / x - zero
    return np.stack([zero @ (a + s) / 2, two @ (s - a) / 2, -one @ b, zero @ c])


def _blocks(parts: Array, x: Array, y: Array, r: Array) -> Array:
    """xx, xy, yy, xz, yz, zz of the map from a load at the origin to the surface at (x, y), r away."""
    mean, deviation, outwards, depth = parts
    cos, sin = x / r, y / r
    cos2, sin2 = cos * cos - sin * sin, 2 * cos * sin
    return np.stack(
        [mean + deviation * cos2, deviation * sin2, mean - deviation * cos2, outwards * cos, outwards * sin, depth]
    )


def _point_load(poisson: float, thickness: float) -> Callable[[Array], Array]:
    """2π G times the displacement by a point load, as a function of distance; (4, …), as `_to_distance` has them.

    It is that of the half space (Boussinesq, Cerruti), in closed form, and what a layer differs from that by: a smooth
    function, since the two are alike for short waves.
    """
    s, a, b, c = half_space_response(poisson)
    half = np.array([(a + s) / 2, (s - a) / 2, -b, c])
    if thickness == np.inf:
        return lambda r: np.multiply.outer(half, 1 / r)
    from scipy.interpolate import make_interp_spline

    waves, weights = _gauss(np.linspace(0, _DEEP, 91), 16)
    difference = layer_response(waves, poisson) - half_space_response(poisson)[:, None]
    table = np.linspace(0, _REACH, 601)
    smooth = make_interp_spline(table, _to_distance(difference, weights, waves, table).T, k=7)

    def load(r: Array) -> Array:
        scaled = r / thickness
        change = np.moveaxis(smooth(np.minimum(scaled, _REACH)), -1, 0) / thickness
        return np.where(scaled < _REACH, np.multiply.outer(half, 1 / r) + change, 0.0)

    return load


def _square_cells(rows: int, cols: int, pitch: float, poisson: float, thickness: float) -> Array:
    """2π G times the map's blocks for markers of a grid and their square cells, shape (6, n, n).

    The mean over one cell of the load on another is an integral over their distance, weighted by how much of the
    cells lies that far apart: a product of hat functions, (1 − |ξ|) (1 − |η|) in pitches. It is summed over squares of
    the grid, each of which belongs to four such products.
    """
    load = _point_load(poisson, thickness)
    sums = np.zeros((6, rows + 1, cols + 1))  # by how many rows and columns apart; one more that is not needed

    def add(m: NDArray[np.intp], n: NDArray[np.intp], xi: Array, eta: Array, weight: Array) -> None:
        x, y = (m[:, None] + xi) * pitch, (n[:, None] + eta) * pitch
        r = np.hypot(x, y)
        values = _blocks(load(r), x, y, r) * weight
        for right, hat_x in ((0, 1 - xi), (1, xi)):
            for up, hat_y in ((0, 1 - eta), (1, eta)):
                i, j = m + right, n + up
                inside = (i >= 0) & (j >= 0)
                part = (values * (hat_x * hat_y)).sum(-1)
                sums[:, i[inside], j[inside]] += part[:, inside]  # each place is there once

    # The four squares at the origin, where the load is: in triangles about it, so that 1/r goes away.
    near = min(1.0, 12 * thickness / pitch)
    s, s_weight = _gauss(np.unique([0, near, 1]), 40)
    t, t_weight = _gauss(np.array([0.0, 1.0]), 24)
    along, across = np.repeat(s, t.size), np.multiply.outer(s, t).ravel()
    corner = np.multiply.outer(s_weight * s, t_weight).ravel()
    for i in (0, -1):
        for j in (0, -1):
            for a, b in ((along, across), (across, along)):
                add(np.array([i]), np.array([j]), a if i == 0 else 1 - a, b if j == 0 else 1 - b, corner)
    # The others.
    g, g_weight = _gauss(np.array([0.0, 1.0]), 12)
    m, n = (k.ravel() for k in np.meshgrid(np.arange(-1, rows), np.arange(-1, cols), indexing="ij"))
    others = (m > 0) | (n > 0)
    add(m[others], n[others], np.repeat(g, g.size), np.tile(g, g.size), np.multiply.outer(g_weight, g_weight).ravel())

    row, col = np.divmod(np.arange(rows * cols), cols)
    apart_x, apart_y = row[:, None] - row, col[:, None] - col
    blocks = sums[:, np.abs(apart_x), np.abs(apart_y)]
    odd_x, odd_y = np.sign(apart_x), np.sign(apart_y)
    blocks[1] *= odd_x * odd_y
    blocks[3] *= odd_x
    blocks[4] *= odd_y
    return blocks


def _round_cells(positions: Array, radius: float, poisson: float, thickness: float) -> Array:
    """2π G times the map's blocks for markers anywhere on the plane and round cells, shape (6, n, n).

    A round cell's Fourier transform is 2 J1(ka)/(ka): of load and mean together its square.
    """
    from scipy.interpolate import make_interp_spline

    bends = [w * radius / thickness for w in (1, 2, 4, 8, 16) if w * radius / thickness < _FINEST]

    def mean(distance: float) -> Array:
        # Panels of 16 nodes, none much longer than a turn of the fastest factor; shorter where a thick layer begins to
        # differ from the half space.
        edges = np.linspace(0, _FINEST, int(_FINEST * (distance / radius + 2) / 8) + 2)
        x, weights = _gauss(np.unique([*edges, *bends]), 16)
        weights = weights * (2 * j1(x) / x) ** 2 / radius
        if thickness == np.inf:
            response = np.repeat(half_space_response(poisson)[:, None], x.size, axis=1)
        else:
            response = layer_response(x * (thickness / radius), poisson)
        return _to_distance(response, weights, x / radius, np.array([distance]))[:, 0]

    apart = positions[:, None] - positions
    r = np.linalg.norm(apart, axis=-1)
    table = [k * radius / 16 for k in range(6)]
    while table[-1] < r.max():
        table.append(table[-1] + max(radius / 16, table[-1] / 40))
    smooth = make_interp_spline(np.array(table), np.array([mean(distance) for distance in table]), k=5)
    no_direction = r == 0  # a marker and itself
    return _blocks(np.moveaxis(smooth(r), -1, 0), apart[..., 0], apart[..., 1], r + no_direction)


def _gauss(edges: Array, nodes: int) -> tuple[Array, Array]:
    """Nodes and weights of Gauss's rule on each of the intervals between edges."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    half = np.diff(edges) / 2
    middle = edges[:-1] + half
    return (middle[:, None] + half[:, None] * x).ravel(), np.multiply.outer(half, weight).ravel()
