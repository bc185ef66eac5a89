"""Arranges detected dots in a grid of rows and columns.

The grid grows outwards from a regular region. Each step uses the local grid vectors, so that it follows the distortion
of lens and gel and passes around missing dots. The grid may be rotated by up to about 30° in the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Points = NDArray[np.float64]

_ANGLE = np.deg2rad(35)  # largest angle between a step of the grid and the image axis
_TOLERANCE = 0.3  # largest distance of a neighbour from its predicted position / spacing
_SEEDS = 3  # start dots


@dataclass(frozen=True)
class Lattice:
    """Dots arranged in rows (downwards) and columns (rightwards)."""

    dots: NDArray[np.intp]  # index of the dot at each node, −1 without a dot, shape (rows, columns)
    spacing: float  # typical distance between neighbours [px]
    irregularity: float  # median distance of a node from the midpoint of its neighbours / spacing

    @property
    def shape(self) -> tuple[int, int]:
        return self.dots.shape[0], self.dots.shape[1]

    @property
    def dot_count(self) -> int:
        """Number of nodes with a dot."""
        return int((self.dots >= 0).sum())


def grow_lattice(centers: Points) -> Lattice | None:
    """The largest grid in `centers` [px], shape (n, 2), or None without a regular group of 3 × 3 dots."""
    if len(centers) < 9:
        return None
    tree = cKDTree(centers)
    axes = _axes(centers, tree)
    if axes is None:
        return None
    best: dict[tuple[int, int], int] = {}
    for seed in _seeds(centers, tree, axes):
        if seed in best.values():
            continue
        nodes = _grow_from(centers, tree, axes, seed)
        if len(nodes) > len(best):
            best = nodes
        if 2 * len(best) > len(centers):
            break  # no other grid is larger
    if len(best) < 9:
        return None
    index = np.array(list(best.keys()))
    index -= index.min(axis=0)
    dots = np.full(index.max(axis=0) + 1, -1, dtype=np.intp)
    dots[index[:, 0], index[:, 1]] = list(best.values())
    if min(dots.shape) < 3:
        return None
    spacing = float(np.linalg.norm(axes, axis=1).mean())
    return Lattice(dots, spacing, _irregularity(centers, dots) / spacing)


def neighbour_mean(values: Points, known: NDArray[np.bool_]) -> tuple[Points, NDArray[np.bool_]]:
    """Weighted mean of the known ones of the eight neighbours of each node, and whether there are any.

    `values` has shape (rows, columns, 2), `known` (rows, columns). Axis neighbours weigh twice as much as diagonals.
    """
    weight = np.zeros((known.shape[0] + 2, known.shape[1] + 2))
    weight[1:-1, 1:-1] = known
    padded = np.zeros((*weight.shape, 2))
    padded[1:-1, 1:-1] = np.where(known[..., None], values, 0.0)
    # Separable sums with weights 1 2 1, without the node itself.
    total = _smooth(padded) - 4 * padded[1:-1, 1:-1]
    share = _smooth(weight[..., None])[..., 0] - 4 * weight[1:-1, 1:-1]
    return total / np.maximum(share, 1.0)[..., None], share > 0


def _smooth(a: Points) -> Points:
    rows = a[:-2] + 2 * a[1:-1] + a[2:]
    return np.asarray(rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:])


def fill_from_neighbours(values: Points, known: NDArray[np.bool_]) -> Points:
    """`values`, shape (rows, columns, 2), with unknown nodes filled outwards from their neighbours."""
    filled, have = np.where(known[..., None], values, 0.0), known.copy()
    while not have.all() and have.any():
        mean, some = neighbour_mean(filled, have)
        new = some & ~have
        filled[new] = mean[new]
        have |= new
    return filled


def interpolate_nodes(positions: Points, known: NDArray[np.bool_]) -> Points:
    """`positions`, shape (rows, columns, 2), with the unknown nodes interpolated.

    They are a bilinear fit to the known nodes plus the deviation of the neighbours from it.
    """
    row, column = np.meshgrid(*(np.arange(n, dtype=float) for n in known.shape), indexing="ij")
    terms = np.stack([np.ones_like(row), row, column, row * column], axis=-1)
    fit = terms @ np.linalg.lstsq(terms[known], positions[known], rcond=None)[0]
    deviation = fill_from_neighbours(positions - fit, known)
    return np.where(known[..., None], positions, fit + deviation)


def _axes(centers: Points, tree: cKDTree) -> Points | None:
    """Typical rightward step and typical downward step [px], shape (2, 2); None when too few dots have neighbours."""
    _, nearest = tree.query(centers, k=min(9, len(centers)))
    steps = centers[nearest[:, 1:]] - centers[:, None]
    length = np.linalg.norm(steps, axis=-1)
    axes = []
    for axis in (0, 1):
        toward = steps[..., axis] > np.cos(_ANGLE) * length
        nearest = np.where(toward, length, np.inf).argmin(axis=1)
        has = toward.any(axis=1)
        if has.sum() < 4:
            return None
        chosen = steps[np.arange(len(steps)), nearest][has]
        middle = np.median(chosen, axis=0)
        close = np.linalg.norm(chosen - middle, axis=1) < 0.3 * np.linalg.norm(middle)
        axes.append(chosen[close].mean(axis=0) if close.any() else middle)
    return np.array(axes)


def _seeds(centers: Points, tree: cKDTree, axes: Points) -> list[int]:
    """Dots whose four neighbours are closest to their predicted positions, preferring central dots."""
    around = np.concatenate([axes, -axes])
    distance, _ = tree.query(centers[:, None] + around)
    error = distance.mean(axis=1) / np.linalg.norm(axes, axis=1).min()
    off = np.linalg.norm(centers - np.median(centers, axis=0), axis=1) / (np.ptp(centers, axis=0).max() + 1.0)
    order = np.argsort(error + 0.1 * off, kind="stable")
    # Every eighth dot of the ranking: consecutive ones are often neighbours.
    return [int(i) for i in order[: _SEEDS * 8 : 8]]


def _grow_from(centers: Points, tree: cKDTree, axes: Points, seed: int) -> dict[tuple[int, int], int]:
    """Grows a grid from `seed` in waves; returns (row, column) → dot. Each node has its own local axes."""
    nodes = {(0, 0): seed}
    used = {seed}
    local = {(0, 0): axes}
    wave = [(0, 0)]
    tolerance = _TOLERANCE * float(np.linalg.norm(axes, axis=1).min())
    directions = [(axis, sign) for axis in (0, 1) for sign in (1, -1)]
    along = np.array([[sign * (axis == 0), sign * (axis == 1)] for axis, sign in directions], dtype=float)
    while wave:
        here = centers[[nodes[node] for node in wave]]
        steps = np.einsum("ka,waj->wkj", along, np.array([local[node] for node in wave]))
        distance, nearest = (a.reshape(-1) for a in tree.query(here[:, None] + steps))
        candidates = [(node, axis, sign) for node in wave for axis, sign in directions]
        wave = []
        for k in np.argsort(distance, kind="stable"):
            if distance[k] > tolerance:
                break
            (row, column), axis, sign = candidates[k]
            target = (row, column + sign) if axis == 0 else (row + sign, column)
            dot = int(nearest[k])
            if target in nodes or dot in used:
                continue
            parent = local[(row, column)]
            step = sign * (centers[dot] - centers[nodes[(row, column)]])
            updated = parent.copy()
            updated[axis] = 0.5 * (parent[axis] + step)
            nodes[target], local[target] = dot, updated
            used.add(dot)
            wave.append(target)
    return nodes


def _irregularity(centers: Points, dots: NDArray[np.intp]) -> float:
    """Median distance of nodes from the midpoint of their two neighbours in a row or column [px]."""
    off = []
    for grid in (dots, dots.T):
        left, middle, right = grid[:-2], grid[1:-1], grid[2:]
        full = (left >= 0) & (middle >= 0) & (right >= 0)
        off.append(np.linalg.norm(centers[middle[full]] - (centers[left[full]] + centers[right[full]]) / 2, axis=1))
    all_off = np.concatenate(off)
    return float(np.median(all_off)) if len(all_off) else np.inf
