"""Compliance of an isotropic elastic layer under loads on marker cells.

The layer has thickness h, is bonded to a rigid back at z = −h and has no edges. Under a surface load that is a plane
wave of wave number k, the surface displacement is a plane wave of the same wave number. In the plane of wave vector
and normal, the solutions of the equilibrium equations are exp(±kz) (A + Bz); perpendicular to it, sinh(k (z + h)).
With w = kh, the shear modulus G, κ = 3 − 4ν and D = κ cosh 2w + 2w² + (1 + κ²)/2, the surface compliances, times G k,
are

    S = tanh w                            shear perpendicular to the wave vector
    A = (1 − ν) (κ sinh 2w + 2w) / D      shear along the wave vector
    C = (1 − ν) (κ sinh 2w − 2w) / D      normal
    B = ((1 − 2ν) κ sinh² w − w²) / D     shear by a normal load, a quarter wave ahead, and the reverse

and for w → ∞ those of the half space: 1, 1 − ν, 1 − ν, (1 − 2ν)/2. As functions of distance they are Hankel transforms
with J0, J1, J2. The force of a marker is a uniform load on its cell, its displacement is the mean over that cell.
Because loads and means use the same cells, the compliance matrix is symmetric and positive definite.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

_MAX_DISTANCE = 30.0  # in thicknesses: beyond it the displacement of a layer is set to 0; unbounded for a half space
_MAX_W = 20.0  # above it the compliances of layer and half space are equal to rounding
_MAX_WAVE_NUMBER = 100.0  # times the radius of a round cell; the truncated part is 1e-4 of the diagonal


def square_cell_compliance(rows: int, cols: int, pitch: float, poisson_ratio: float, thickness: float) -> Array:
    """Compliance between square cells of a grid, times 2π G [1/m], shape (6, n, n): xx, xy, yy, xz, yz, zz.

    The mean over one cell under a uniform load on another is an integral over their offset, weighted by the overlap
    of the shifted cells: a product of hat functions, (1 − |ξ|) (1 − |η|) in units of the pitch.
    """
    by_offset = _hat_integrals(_point_load(poisson_ratio, thickness), rows, cols, pitch, thickness)
    row, col = np.divmod(np.arange(rows * cols), cols)
    row_offset, col_offset = row[:, None] - row, col[:, None] - col
    blocks = by_offset[:, np.abs(row_offset), np.abs(col_offset)]
    sign_x, sign_y = np.sign(row_offset), np.sign(col_offset)
    blocks[1] *= sign_x * sign_y
    blocks[3] *= sign_x
    blocks[4] *= sign_y
    return blocks


def round_cell_compliance(positions: Array, radius: float, poisson_ratio: float, thickness: float) -> Array:
    """Compliance between round cells at `positions` [m], (n, 2), times 2π G [1/m], shape (6, n, n) as above.

    The Fourier transform of a round cell is 2 J1(ka)/(ka); load and mean together give its square.
    """
    from scipy.interpolate import make_interp_spline

    # Wave numbers, times the radius, at which a thick layer starts to differ from the half space.
    breaks = [w * radius / thickness for w in (1, 2, 4, 8, 16) if w * radius / thickness < _MAX_WAVE_NUMBER]

    def mean(distance: float) -> Array:
        # Panels of 16 nodes, at most about one period of the fastest oscillation long.
        panels = int(_MAX_WAVE_NUMBER * (distance / radius + 2) / 8) + 1
        edges = np.linspace(0, _MAX_WAVE_NUMBER, panels + 1)
        x, weights = _gauss(np.unique([*edges, *breaks]), 16)
        weights = weights * (2 * j1(x) / x) ** 2 / radius
        if thickness == np.inf:
            response = np.repeat(half_space_response(poisson_ratio)[:, None], x.size, axis=1)
        else:
            response = layer_response(x * (thickness / radius), poisson_ratio)
        return _hankel(response, weights, x / radius, np.array([distance]))[:, 0]

    offset = positions[:, None] - positions
    r = np.linalg.norm(offset, axis=-1)
    nodes = [k * radius / 16 for k in range(6)]
    while nodes[-1] < r.max():
        nodes.append(nodes[-1] + max(radius / 16, nodes[-1] / 40))
    spline = make_interp_spline(np.array(nodes), np.array([mean(distance) for distance in nodes]), k=5)
    same_marker = r == 0  # avoids 0/0 on the diagonal, where all directional terms are 0
    return _blocks(np.moveaxis(spline(r), -1, 0), offset[..., 0], offset[..., 1], r + same_marker)


def layer_response(w: Array, poisson_ratio: float) -> Array:
    """S, A, B, C of the layer (module docstring) at w = k h ≥ 0, shape (4, …)."""
    kappa = 3 - 4 * poisson_ratio
    # Numerators and D are multiplied by 2 exp(−2w) to avoid overflow.
    e = np.exp(-2 * w)
    d = kappa * (1 + e * e) + e * (4 * w * w + 1 + kappa * kappa)
    sinh, linear = kappa * (1 - e * e), 4 * w * e
    along, normal = (1 - poisson_ratio) * (sinh + linear) / d, (1 - poisson_ratio) * (sinh - linear) / d
    coupling = ((1 - 2 * poisson_ratio) * kappa / 2 * (1 - e) ** 2 - 2 * w * w * e) / d
    return np.stack([np.tanh(w), along, coupling, normal])


def half_space_response(poisson_ratio: float) -> Array:
    """S, A, B, C of the half space, shape (4,)."""
    return np.array([1, 1 - poisson_ratio, (1 - 2 * poisson_ratio) / 2, 1 - poisson_ratio])


def _hankel(response: Array, weights: Array, waves: Array, distances: Array) -> Array:
    """Hankel transforms Σ weight · response · Bessel function at `distances`, shape (4, distances).

    The four components are those of `_blocks`: isotropic and deviatoric shear, shear by a normal load, normal.
    """
    s, a, b, c = response * weights
    x = np.maximum(np.multiply.outer(distances, waves), 1e-9)
    zero, one = j0(x), j1(x)
    two = 2 * one / x - zero
    return np.stack([zero @ (a + s) / 2, two @ (s - a) / 2, -one @ b, zero @ c])


def _blocks(components: Array, x: Array, y: Array, r: Array) -> Array:
    """Compliance xx, xy, yy, xz, yz, zz from a load at the origin to the surface at (x, y), at distance r."""
    mean, deviation, radial, normal = components
    cos, sin = x / r, y / r
    cos2, sin2 = cos * cos - sin * sin, 2 * cos * sin
    return np.stack(
        [mean + deviation * cos2, deviation * sin2, mean - deviation * cos2, radial * cos, radial * sin, normal]
    )


def _point_load(poisson_ratio: float, thickness: float) -> Callable[[Array], Array]:
    """Displacement under a point load times 2π G, as a function of distance; components of `_hankel`, (4, …).

    The closed form of the half space (Boussinesq, Cerruti) plus the difference of the layer from it. The difference
    is smooth, because both responses agree for short waves.
    """
    s, a, b, c = half_space_response(poisson_ratio)
    half_space = np.array([(a + s) / 2, (s - a) / 2, -b, c])
    if thickness == np.inf:
        return lambda r: np.multiply.outer(half_space, 1 / r)
    from scipy.interpolate import make_interp_spline

    waves, weights = _gauss(np.linspace(0, _MAX_W, 91), 16)
    difference = layer_response(waves, poisson_ratio) - half_space_response(poisson_ratio)[:, None]
    nodes = np.linspace(0, _MAX_DISTANCE, 601)
    spline = make_interp_spline(nodes, _hankel(difference, weights, waves, nodes).T, k=7)

    def load(r: Array) -> Array:
        scaled = r / thickness
        change = np.moveaxis(spline(np.minimum(scaled, _MAX_DISTANCE)), -1, 0) / thickness
        return np.where(scaled < _MAX_DISTANCE, np.multiply.outer(half_space, 1 / r) + change, 0.0)

    return load


def _hat_integrals(
    load: Callable[[Array], Array], rows: int, cols: int, pitch: float, thickness: float
) -> NDArray[np.float64]:
    """Integrals of a point load times hat functions, by row and column offset, shape (6, rows + 1, cols + 1).

    The integral is summed over squares of the grid; each square belongs to four hat functions. The last row and
    column are incomplete and not used.
    """
    integrals = np.zeros((6, rows + 1, cols + 1))

    def add_squares(m: IntArray, n: IntArray, xi: Array, eta: Array, weight: Array) -> None:
        """Add the squares at rows m and columns n, with quadrature points ξ, η in [0, 1]²."""
        x, y = (m[:, None] + xi) * pitch, (n[:, None] + eta) * pitch
        r = np.hypot(x, y)
        values = _blocks(load(r), x, y, r) * weight
        for right, hat_x in ((0, 1 - xi), (1, xi)):
            for up, hat_y in ((0, 1 - eta), (1, eta)):
                i, j = m + right, n + up
                inside = (i >= 0) & (j >= 0)
                part = (values * (hat_x * hat_y)).sum(-1)
                integrals[:, i[inside], j[inside]] += part[:, inside]  # no offset occurs twice in one call

    # The four squares around the load: Duffy's transformation to triangles removes the singularity 1/r.
    near = min(1.0, 12 * thickness / pitch)
    s, s_weight = _gauss(np.unique([0, near, 1]), 40)
    t, t_weight = _gauss(np.array([0.0, 1.0]), 24)
    along, across = np.repeat(s, t.size), np.multiply.outer(s, t).ravel()
    corner = np.multiply.outer(s_weight * s, t_weight).ravel()
    for i in (0, -1):
        for j in (0, -1):
            for a, b in ((along, across), (across, along)):
                add_squares(np.array([i]), np.array([j]), a if i == 0 else 1 - a, b if j == 0 else 1 - b, corner)
    g, g_weight = _gauss(np.array([0.0, 1.0]), 12)
    m, n = (k.ravel() for k in np.meshgrid(np.arange(-1, rows), np.arange(-1, cols), indexing="ij"))
    regular = (m > 0) | (n > 0)
    weight = np.multiply.outer(g_weight, g_weight).ravel()
    add_squares(m[regular], n[regular], np.repeat(g, g.size), np.tile(g, g.size), weight)
    return integrals


def _gauss(edges: Array, nodes: int) -> tuple[Array, Array]:
    """Nodes and weights of the Gauss-Legendre rule on each interval between `edges`."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    half = np.diff(edges) / 2
    middle = edges[:-1] + half
    return (middle[:, None] + half[:, None] * x).ravel(), np.multiply.outer(half, weight).ravel()
