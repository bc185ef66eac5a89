"""An elastic layer with Coulomb friction under a rigid object that is pressed, moved along the gel, and slips.

The contact problem is solved in quasi-static steps on cells of a third of the pitch, in material coordinates. With the
compliance of the layer C, the pressure p ≥ 0 and the gap g ≥ 0 are complementary in each cell, and the shear q follows
from the motion of the object d and of the surface u in one step:

    |q| ≤ μ p;    Δd − Δu = 0 where |q| < μ p;    Δd − Δu parallel to q where |q| = μ p.

Both problems are convex for given q or p; they are solved in turn until neither changes (Panagiotopoulos). A cell
sticks where |q| < μ p. The gap is that of the moved object over the moved surface, so that the contact travels over the
material when the object slips.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.gel.elastic_layer import square_cell_compliance
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid

Indenter = Literal["ball", "rounded disc", "cylinder", "ellipsoid", "ring", "edge", "rounded square"]
INDENTERS: tuple[Indenter, ...] = get_args(Indenter)

_CELLS = 3  # per pitch and axis
_REACH = 3.4  # distance of the cells that are considered from the path of the object [pitches]
_ALTERNATIONS = 12
_CHANGE = 1e-3  # of shear forces, relative to the largest one, at which the alternation ends
_ITERATIONS = 400  # of the projected gradient
_SLIPPING = 1 - 1e-3  # |q| / (μ p) from which on a cell slips

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RigidObject:
    """The lower side of an object."""

    indenter: Indenter
    size: float  # radius of the flat part or of the ring, half length of cylinder and edge [mm]
    radius: float  # of curvature [mm]
    angle: float = 0.0  # of cylinder, edge, ellipsoid and square [rad]

    def height(self, offset: Array) -> Array:
        """Height over the lowest point at `offset` from the centre [mm], shape (n, 2)."""
        x, y = offset.T
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        along, across, distance = x * cos + y * sin, -x * sin + y * cos, np.hypot(x, y)
        beyond = np.maximum(np.abs(along) - self.size, 0.0)  # of the ends
        if self.indenter == "ball":
            rise = distance**2
        elif self.indenter == "rounded disc":
            rise = np.maximum(distance - self.size, 0.0) ** 2
        elif self.indenter == "cylinder":
            rise = across**2 + beyond**2
        elif self.indenter == "ellipsoid":
            rise = across**2 + 0.4 * along**2
        elif self.indenter == "ring":
            rise = (distance - self.size) ** 2
        elif self.indenter == "edge":  # a blunt wedge of 45°
            width = np.abs(across)
            rise = np.where(width < self.radius, width**2, 2 * self.radius * width - self.radius**2) + beyond**2
        elif self.indenter == "rounded square":
            rise = beyond**2 + np.maximum(np.abs(across) - self.size, 0.0) ** 2
        else:
            raise UsageError(f"indenter must be one of {', '.join(INDENTERS)}, got {self.indenter!r}")
        return np.asarray(rise / (2 * self.radius))


@dataclass(frozen=True)
class ObjectMotion:
    """Position of the object and force at one time."""

    position_mm: tuple[float, float]  # on the pad
    rotation: float  # [rad]
    normal: float  # force [N]


@dataclass(frozen=True)
class SlippingGel:
    """The gel after one step."""

    displacement_mm: Array  # of the markers, shape (markers, 2)
    normal: float  # [N]
    shear: Array  # [N], shape (2,)
    stick_share: float  # of the contact area; 0 without a contact
    gross: bool  # no cell sticks


class SlippingLayer:
    """An elastic layer with a grid of markers under one object with friction; a new one begins at rest."""

    def __init__(self, gel: ElasticGel, grid: Grid, friction: float, shape: RigidObject, start: ObjectMotion) -> None:
        """The object is over the gel at `start`. Raises UsageError for a grid of more than 300 markers."""
        if grid.rows * grid.cols > 300:
            raise UsageError(f"a slipping layer supports at most 300 markers, got {grid.rows * grid.cols}")
        self.friction, self.shape = friction, shape
        pitch = grid.pitch / _CELLS
        cells = Grid(_CELLS * grid.rows, _CELLS * grid.cols, pitch, grid.center)
        position = cells.positions()
        used = np.flatnonzero(np.hypot(*(position - start.position_mm).T) < _REACH * grid.pitch + shape.size)
        blocks = square_cell_compliance(cells.rows, cells.cols, pitch * 1e-3, gel.poisson_ratio, gel.thickness)
        blocks *= 1e3 / (np.pi * gel.youngs_modulus / (1 + gel.poisson_ratio))  # [mm/N]
        indices = np.arange(cells.rows * cells.cols).reshape(cells.rows, cells.cols)
        markers = indices[_CELLS // 2 :: _CELLS, _CELLS // 2 :: _CELLS].ravel()
        xx, xy, yy, xz, yz, _ = blocks[:, markers][:, :, used]
        self._to_markers = np.block([[xx, xy, xz], [xy, yy, yz]])
        xx, xy, yy, xz, yz, zz = blocks[:, used][:, :, used]
        self._tangential = np.block([[xx, xy], [xy, yy]])
        self._coupling = np.vstack([xz, yz])  # displacement along the surface by pressure
        self._normal = zz
        self._position = position[used]
        self._step_length = 1.0 / float(np.linalg.eigvalsh(self._tangential)[-1])
        self._pressure = np.zeros(used.size)
        self._shear = np.zeros(2 * used.size)
        self._moved = np.zeros(2 * used.size)  # surface displacement along x, then y [mm]
        self._motion = start

    def step(self, motion: ObjectMotion) -> SlippingGel:
        """Move the object and press it with a new force."""
        advance = self._object_at(motion) - self._object_at(self._motion)
        target = (self._moved + advance.T.ravel()).copy()
        shear, pressure = self._shear, self._pressure
        for _ in range(_ALTERNATIONS):
            pressure = self._solve_pressure(motion, shear, pressure)
            changed = self._solve_shear(target, pressure, shear)
            change = float(np.abs(changed - shear).max(initial=0.0))
            shear = changed
            if change <= _CHANGE * max(float(np.abs(shear).max(initial=0.0)), 1e-9):
                break
        self._shear, self._pressure, self._motion = shear, pressure, motion
        self._moved = self._tangential @ shear + self._coupling @ pressure
        return self._state()

    def _object_at(self, motion: ObjectMotion) -> Array:
        """Position of the object's points that are at the cells [mm], shape (n, 2), up to a constant of each point."""
        arm = self._position - self._motion.position_mm
        turned = motion.rotation * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        return np.asarray(turned + motion.position_mm)

    def _solve_pressure(self, motion: ObjectMotion, shear: Array, start: Array) -> Array:
        """Pressure of each cell [N] for given shear: ≥ 0, and without a gap where it is above 0."""
        n = len(self._position)
        if motion.normal <= 0:
            return np.zeros(n)
        moved = (self._tangential @ shear + self._coupling @ start).reshape(2, n).T
        arm = self._position + moved - motion.position_mm
        cos, sin = np.cos(motion.rotation), np.sin(motion.rotation)
        height = self.shape.height(arm @ np.array([[cos, -sin], [sin, cos]]))
        level = height + self._coupling.T @ shear  # depth that the object reaches, below its lowest point
        active = start > 0 if start.any() else level <= np.sort(level)[max(4, n // 8) - 1]
        for _ in range(60):
            chosen = np.flatnonzero(active)
            ones = np.ones(chosen.size)
            solved = np.linalg.solve(self._normal[np.ix_(chosen, chosen)], np.stack([ones, -level[chosen]], axis=1))
            depth = (motion.normal - solved[:, 1].sum()) / solved[:, 0].sum()
            pressure = np.zeros(n)
            pressure[chosen] = depth * solved[:, 0] + solved[:, 1]
            if (pressure[chosen] < 0).any():
                active = pressure > 0
                continue
            inside = depth - level - self._normal @ pressure > 1e-9  # the object would penetrate
            inside[chosen] = False
            if not inside.any():
                break
            active = active | inside
        return np.maximum(pressure, 0.0)

    def _solve_shear(self, target: Array, pressure: Array, start: Array) -> Array:
        """Shear of each cell [N] for given pressure, by an accelerated projected gradient with restarts."""
        limit = self.friction * pressure
        free = np.flatnonzero(limit > 0)
        both = np.concatenate([free, len(pressure) + free])
        matrix = self._tangential[np.ix_(both, both)]
        wanted = (target - self._coupling @ pressure)[both]
        limit = limit[free]
        shear = _in_discs(start[both], limit)
        extrapolated, momentum = shear, 1.0
        for _ in range(_ITERATIONS):
            following = _in_discs(extrapolated - self._step_length * (matrix @ extrapolated - wanted), limit)
            change = following - shear
            if float((extrapolated - following) @ change) > 0:
                momentum = 1.0
            grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            extrapolated = following + (momentum - 1) / grown * change
            shear, momentum = following, grown
            if float(np.abs(change).max(initial=0.0)) < 1e-6 * float(limit.max(initial=0.0)):
                break
        found = np.zeros_like(start)
        found[both] = shear
        return found

    def _state(self) -> SlippingGel:
        pressed = self._pressure > 0
        shear = self._shear.reshape(2, -1)
        sticks = pressed & (np.hypot(*shear) < _SLIPPING * self.friction * self._pressure)
        moved = (self._to_markers @ np.concatenate([self._shear, self._pressure])).reshape(2, -1).T
        count = int(pressed.sum())
        return SlippingGel(
            displacement_mm=moved,
            normal=float(self._pressure.sum()),
            shear=shear.sum(1),
            stick_share=int(sticks.sum()) / count if count else 0.0,
            gross=bool(count and not sticks.any()),
        )


def _in_discs(shear: Array, limit: Array) -> Array:
    """The nearest shear with |q| ≤ limit in each cell."""
    pairs = shear.reshape(2, -1)
    length = np.maximum(np.hypot(*pairs), 1e-30)
    return np.asarray((pairs * np.minimum(1.0, limit / length)).ravel())
