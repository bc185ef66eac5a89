"""Recognizes patterns of dots that are not rows and columns, in which a part can look like a grid."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gelflow.perception.grid_detection.detect import DetectedDots
from gelflow.perception.grid_detection.lattice import Lattice

_MAX_SHEAR = np.deg2rad(20)  # of rows and columns seen at a slant; those in a hexagonal pattern meet at 60°
_MAX_OUTSIDE = 0.3  # limit of (equal dots beside the grid) / (dots of the grid)
_MIN_PEAK = 0.6  # contrast of an equal dot / median of the grid
_AREAS = (0.5, 2.0)  # area of an equal dot / median of the grid
_DISTANCES = (0.6, 1.4)  # distance of an equal dot from the nearest one / spacing


def pattern_reason(lattice: Lattice, dots: DetectedDots) -> str:
    """The reason why the pattern of the dots, of which `lattice` is a part, is not a grid; empty if it may be one."""
    if abs(_angle(lattice, dots.centers) - np.pi / 2) > _MAX_SHEAR:
        return (
            "the dots form a hexagonal or concentric pattern; only rectangular grids of markers, "
            "with rows and columns, can be tracked"
        )
    outside = _equal_outside(lattice, dots)
    if outside > _MAX_OUTSIDE * lattice.dot_count:
        return (
            f"{outside} dots lie beside the {lattice.dot_count} that form rows and columns: the pattern is concentric "
            "or irregular; only rectangular grids of markers can be tracked"
        )
    return ""


def _angle(lattice: Lattice, centers: NDArray[np.float64]) -> float:
    """Median angle between the rightward and the downward step at a dot [rad]."""
    corner, right, down = lattice.dots[:-1, :-1], lattice.dots[:-1, 1:], lattice.dots[1:, :-1]
    known = (corner >= 0) & (right >= 0) & (down >= 0)
    along, across = (centers[other[known]] - centers[corner[known]] for other in (right, down))
    return float(
        np.median(np.arctan2(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0], (along * across).sum(1)))
    )


def _equal_outside(lattice: Lattice, dots: DetectedDots) -> int:
    """Number of dots outside `lattice` that have contrast, size and distances of its dots."""
    index = lattice.dots[lattice.dots >= 0]
    area = dots.areas / np.median(dots.areas[index])
    equal = (dots.peaks > _MIN_PEAK * np.median(dots.peaks[index])) & (area > _AREAS[0]) & (area < _AREAS[1])
    distance = cKDTree(dots.centers).query(dots.centers, k=2)[0][:, 1] / lattice.spacing
    equal &= (distance > _DISTANCES[0]) & (distance < _DISTANCES[1])
    equal[index] = False
    return int(equal.sum())
