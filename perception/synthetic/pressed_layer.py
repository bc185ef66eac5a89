"""Marker displacements of an elastic gel under objects of several shapes, with the true forces.

Loads act on cells of a third of the pitch, so that the edge of a contact does not follow the grid of markers.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.gel.elastic_layer import square_cell_compliance
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid

Shape = Literal["ball", "disc", "edge", "ring", "square"]
Friction = Literal["sliding", "sticking"]
SHAPES: tuple[Shape, ...] = get_args(Shape)

_CELLS = 3  # per pitch and axis
_EDGE_HALF_WIDTH, _RING_HALF_WIDTH = 1.2, 0.75  # [mm]
_FRICTION = 0.9  # upper limit of shear / normal load of a sticking cell

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Press:
    """An object pressed on the gel."""

    shape: Shape
    center: tuple[float, float]  # on the pad (x, y) [mm]
    size: float  # radius, or half the side; of an edge a third of half its length [mm]
    angle: float  # of edge and square [rad]
    normal: float  # [N]
    ratio: float  # shear / normal force
    direction: float  # of the shear [rad]
    twist: float = 0.0  # shear by rotation at `size` from the centre, relative to `ratio`
    friction: Friction = "sliding"


@dataclass(frozen=True)
class PressedGel:
    """Displacements and forces, in the axes of the grid."""

    displacement_mm: Array  # of the markers, shape (markers, 2)
    shear: Array  # [N], shape (2,)
    normal: float  # [N]
    moment: float  # about the normal through the centre of pressure [N m]
    centre_mm: Array  # centre of pressure [mm], shape (2,)


class PressedLayer:
    """An elastic layer with a grid of markers."""

    def __init__(self, gel: ElasticGel, grid: Grid) -> None:
        """Raises UsageError for a grid of more than 300 markers, whose fine cells need too much memory."""
        if grid.rows * grid.cols > 300:
            raise UsageError(f"a pressed layer supports at most 300 markers, got {grid.rows * grid.cols}")
        self.gel, self.grid = gel, grid
        rows, cols, pitch = _CELLS * grid.rows, _CELLS * grid.cols, grid.pitch / _CELLS * 1e-3
        blocks = square_cell_compliance(rows, cols, pitch, gel.poisson_ratio, gel.thickness)
        markers = np.arange(rows * cols).reshape(rows, cols)[_CELLS // 2 :: _CELLS, _CELLS // 2 :: _CELLS].ravel()
        xx, xy, yy, xz, yz, _ = blocks[:, markers] / (np.pi * gel.youngs_modulus / (1 + gel.poisson_ratio))
        self._compliance = np.block([[xx, xy, xz], [xy, yy, yz]])
        self._cells = Grid(rows, cols, grid.pitch / _CELLS, grid.center).positions()

    def press(self, press: Press) -> PressedGel:
        """The gel under one object. Raises UsageError if no cell is under it."""
        offset = self._cells - press.center
        normal = _pressure(press, offset)
        if not normal.any():
            raise UsageError(f"no cell is under the {press.shape} at {press.center} mm of size {press.size:g} mm")
        normal *= press.normal / normal.sum()
        shear = self._shear(press, offset, normal)
        moved = self._compliance @ np.concatenate([shear.ravel(), normal])
        centre = normal @ self._cells / normal.sum()
        arm = 1e-3 * (self._cells - centre)
        moment = float(arm[:, 0] @ shear[1] - arm[:, 1] @ shear[0])
        return PressedGel(1e3 * moved.reshape(2, -1).T, shear.sum(1), float(normal.sum()), moment, centre)

    def _shear(self, press: Press, offset: Array, normal: Array) -> Array:
        """Shear load of each cell [N], shape (2, cells): along the normal load, or even where the contact sticks."""
        along = np.array([np.cos(press.direction), np.sin(press.direction)])
        rotation = press.twist / press.size * np.stack([-offset[:, 1], offset[:, 0]])
        load = normal
        if press.friction == "sticking":
            load = np.where(normal > 0, normal.sum() / (normal > 0).sum(), 0.0)
        shear = press.ratio * (along[:, None] + rotation) * load
        length = np.hypot(*shear)
        return np.asarray(shear * np.minimum(1.0, _FRICTION * normal / np.maximum(length, 1e-12)))


def random_press(shape: Shape, grid: Grid, rng: np.random.Generator, *, normal: tuple[float, float]) -> Press:
    """A random object in the middle half of the grid; `normal` are the limits of the normal force [N]."""
    low, high = normal
    center = rng.uniform(-0.25, 0.25, 2) * grid.pitch * np.array([grid.rows, grid.cols]) + grid.center
    return Press(
        shape=shape,
        center=(float(center[0]), float(center[1])),
        size=float(rng.uniform(1.4, 2.7) * grid.pitch),
        angle=float(rng.uniform(0, np.pi)),
        normal=float(np.exp(rng.uniform(np.log(low), np.log(high)))),
        ratio=float(rng.uniform(0, 0.6)),
        direction=float(rng.uniform(0, 2 * np.pi)),
        twist=float(rng.uniform(-0.5, 0.5)),
        friction="sticking" if rng.uniform() < 0.5 else "sliding",
    )


def _pressure(press: Press, offset: Array) -> Array:
    """Relative normal load of each cell at `offset` from the centre [mm], shape (cells,)."""
    x, y = offset.T
    cos, sin = np.cos(press.angle), np.sin(press.angle)
    along, across, distance = x * cos + y * sin, -x * sin + y * cos, np.hypot(x, y)
    if press.shape == "ball":
        return np.asarray(np.sqrt(np.maximum(0, 1 - (distance / press.size) ** 2)))
    if press.shape == "disc":
        inside = distance < press.size
    elif press.shape == "edge":
        inside = (np.abs(across) < _EDGE_HALF_WIDTH) & (np.abs(along) < 2 * press.size)
    elif press.shape == "ring":
        inside = np.abs(distance - press.size) < _RING_HALF_WIDTH
    elif press.shape == "square":
        inside = np.maximum(np.abs(along), np.abs(across)) < press.size
    else:
        raise UsageError(f"shape must be one of {', '.join(SHAPES)}, got {press.shape!r}")
    return np.asarray(inside, dtype=np.float64)
