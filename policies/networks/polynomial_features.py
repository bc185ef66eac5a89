"""Features of flow maps: coefficients of a least-squares fit by low-order polynomials in row and column.

A flat face in a grasp gives smooth flow maps. The fit averages the noise of the markers and keeps the mean force and
its changes over the pad.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import Grid
from gelflow.policies.networks.mirror_symmetry import exponents

Array = NDArray[np.float64]


def polynomial_basis(grid: Grid, degree: int) -> Array:
    """Orthogonal polynomials in row and column up to `degree`, sampled on `grid`, shape (rows * cols, terms).

    The scale is such that `map @ basis` is 1 for a map equal to the polynomial of unit mean square.
    """
    positions = grid.positions()
    half = np.maximum(np.abs(positions - positions.mean(0)).max(0), grid.pitch / 2)
    x, y = ((positions - positions.mean(0)) / half).T
    q, r = np.linalg.qr(np.stack([x**i * y**j for i, j in exponents(degree)], axis=1))
    return np.asarray(q * np.sign(np.diag(r)) / np.sqrt(len(positions)))


def num_features(channels: int, degree: int) -> int:
    """Number of polynomial features of a flow map with `channels` channels."""
    return channels * (degree + 1) * (degree + 2) // 2


def reduce_maps(images: NDArray[Any], basis: Array) -> Array:
    """Polynomial features (n, channels * terms) of flow maps (n, channels, rows, cols)."""
    n, channels = images.shape[:2]
    flat = images.reshape(n, channels, -1).astype(float)
    return np.asarray(np.einsum("ncp,pk->nck", flat, basis).reshape(n, -1))
