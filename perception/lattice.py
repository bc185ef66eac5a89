"""From loose dots to a grid: which dot is in which line and column.

The grid is grown from a regular spot outwards, each step guided by the local distances, so that it follows a lens's
or the gel's distortion and goes around dots that are missing. It may be turned by up to about 30° in the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Points = NDArray[np.float64]

_ANGLE = np.deg2rad(35)  # a neighbour to the right, or below, is looked for within this angle of the image's axes
_NEAR = 0.3  # of the spacing: how far from the expected place a neighbour may be
_SEEDS = 3  # regular spots from which growth is tried


@dataclass(frozen=True)
class Lattice:
    """Dots arranged in lines (downwards) and columns (to the right)."""

    dots: NDArray[np.intp]  # number of the dot at each node, −1 where there is none, shape (lines, columns)
    spacing: float  # typical distance between neighbours [px]
    unevenness: float  # median distance of a node from the middle of its neighbours, as a share of the spacing

    @property
    def shape(self) -> tuple[int, int]:
        return self.dots.shape[0], self.dots.shape[1]

    @property
    def found(self) -> int:
        """How many nodes have a dot."""
        return int((self.dots >= 0).sum())


def grow(centers: Points) -> Lattice | None:
    """The largest grid in `centers` [px], shape (n, 2); None when there is no 3 × 3 of them in order."""
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
        nodes = _flood(centers, tree, axes, seed)
        if len(nodes) > len(best):
            best = nodes
        if 2 * len(best) > len(centers):
            break  # no other grid can be larger
    if len(best) < 9:
        return None
    index = np.array(list(best.keys()))
    index -= index.min(axis=0)
    dots = np.full(index.max(axis=0) + 1, -1, dtype=np.intp)
    dots[index[:, 0], index[:, 1]] = list(best.values())
    if min(dots.shape) < 3:
        return None
    spacing = float(np.linalg.norm(axes, axis=1).mean())
    return Lattice(dots, spacing, _unevenness(centers, dots) / spacing)


def neighbours(values: Points, known: NDArray[np.bool_]) -> tuple[Points, NDArray[np.bool_]]:
    """Mean of the known ones among each node's eight neighbours, and where there are any.

    `values` shape (lines, columns, 2), `known` (lines, columns); those next to it count twice those across.
    """
    weight = np.zeros((known.shape[0] + 2, known.shape[1] + 2))
    weight[1:-1, 1:-1] = known
    padded = np.zeros((*weight.shape, 2))
    padded[1:-1, 1:-1] = np.where(known[..., None], values, 0.0)
    # Sums along one axis, then along the other, with weights 1 2 1 but without the node itself.
    total = _smooth(padded) - 4 * padded[1:-1, 1:-1]
    share = _smooth(weight[..., None])[..., 0] - 4 * weight[1:-1, 1:-1]
    return total / np.maximum(share, 1.0)[..., None], share > 0


def _smooth(a: Points) -> Points:
    lines = a[:-2] + 2 * a[1:-1] + a[2:]
    return np.asarray(lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:])


def fill(values: Points, known: NDArray[np.bool_]) -> Points:
    """`values`, shape (lines, columns, 2), with unknown nodes filled from their neighbours, outwards."""
    filled, have = np.where(known[..., None], values, 0.0), known.copy()
    while not have.all() and have.any():
        mean, some = neighbours(filled, have)
        new = some & ~have
        filled[new] = mean[new]
        have |= new
    return filled


def _axes(centers: Points, tree: cKDTree) -> Points | None:
    """Typical step to the right and typical step down [px], shape (2, 2)."""
    _, near = tree.query(centers, k=min(9, len(centers)))
    steps = centers[near[:, 1:]] - centers[:, None]
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
    """The dots whose four neighbours are closest to where they belong; central ones first among equals."""
    around = np.concatenate([axes, -axes])
    distance, _ = tree.query(centers[:, None] + around)
    error = distance.mean(axis=1) / np.linalg.norm(axes, axis=1).min()
    off = np.linalg.norm(centers - np.median(centers, axis=0), axis=1) / (np.ptp(centers, axis=0).max() + 1.0)
    order = np.argsort(error + 0.1 * off, kind="stable")
    # Spread them: one in the first, one in the second, ... part of the ranking would miss separated grids.
    return [int(i) for i in order[: _SEEDS * 8 : 8]]


def _flood(centers: Points, tree: cKDTree, axes: Points, seed: int) -> dict[tuple[int, int], int]:
    """Grows from `seed`, one wave at a time; (line, column) → dot. Every node keeps its own local axes."""
    nodes = {(0, 0): seed}
    taken = {seed}
    local = {(0, 0): axes}
    wave = [(0, 0)]
    tolerance = _NEAR * float(np.linalg.norm(axes, axis=1).min())
    ways = [(axis, sign) for axis in (0, 1) for sign in (1, -1)]
    along = np.array([[sign * (axis == 0), sign * (axis == 1)] for axis, sign in ways], dtype=float)
    while wave:
        here = centers[[nodes[node] for node in wave]]
        steps = np.einsum("ka,waj->wkj", along, np.array([local[node] for node in wave]))
        distance, found = (a.reshape(-1) for a in tree.query(here[:, None] + steps))
        tries = [(node, axis, sign) for node in wave for axis, sign in ways]
        wave = []
        for k in np.argsort(distance, kind="stable"):
            if distance[k] > tolerance:
                break
            (line, column), axis, sign = tries[k]
            target = (line, column + sign) if axis == 0 else (line + sign, column)
            dot = int(found[k])
            if target in nodes or dot in taken:
                continue
            parent = local[(line, column)]
            step = sign * (centers[dot] - centers[nodes[(line, column)]])
            own = parent.copy()
            own[axis] = 0.5 * (parent[axis] + step)
            nodes[target], local[target] = dot, own
            taken.add(dot)
            wave.append(target)
    return nodes


def _unevenness(centers: Points, dots: NDArray[np.intp]) -> float:
    """Median distance of nodes from the middle of their two neighbours in a line or column [px]."""
    off = []
    for grid in (dots, dots.T):
        left, middle, right = grid[:-2], grid[1:-1], grid[2:]
        full = (left >= 0) & (middle >= 0) & (right >= 0)
        off.append(np.linalg.norm(centers[middle[full]] - (centers[left[full]] + centers[right[full]]) / 2, axis=1))
    all_off = np.concatenate(off)
    return float(np.median(all_off)) if len(all_off) else np.inf
