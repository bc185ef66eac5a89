"""Geometry of a part and its hole, derived from the description: outlines, mass, contact points, grasped sides."""

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gelflow.part import Part
from gelflow.sim.scene.contacts import PointsDef
from gelflow.sim.scene.geometry.sampling import box_surface, cylinder
from gelflow.sim.scene.mjcf.mechanics import BodyDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.tasks.parts.hole_mesh import mesh_hole_outline
from gelflow.sim.tasks.parts.outline import Circle, Outline, Rectangle

Array = NDArray[np.float64]

_FACE_SPACING = 5e-3  # of contact points on the lower face and along edges [m]
_HEIGHT_SPACING = 10e-3  # of contact points along the height [m]
_RING_SPACING = 2.7e-3  # of contact points around a cylinder [m]: a misaligned one touches the rim with a short arc


class PartGeometry(ABC):
    """Geometry of one part. Lengths in metres, in the frame of the part."""

    def __init__(self, part: Part) -> None:
        self.part = part
        self.half = np.array(part.size) / 2

    @property
    @abstractmethod
    def outline(self) -> Outline:
        """Outline of what enters the hole."""

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume [m³]."""

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.volume * self.part.density)

    @abstractmethod
    def body(self, body: BodyDef) -> BodyDef:
        """`body` with the mass and inertia of the part."""

    @abstractmethod
    def shape(self, shape: ShapeDef) -> ShapeDef:
        """`shape` with the size of the part."""

    @abstractmethod
    def points(self, points: PointsDef) -> PointsDef:
        """`points` replaced by contact points of the part against the hole: lower face and sides."""

    @abstractmethod
    def side_gaps(self, points: Array, side: int) -> Array:
        """Distances along x from a pad to the part at (y, z) in the frame of the part, (…, 2) → (…).

        The pads are `grasp_width` apart; `side` is −1 for the left one, 1 for the right one. Infinite where the pad
        does not meet the part.
        """

    @cached_property
    def hole(self) -> Outline:
        """Outline of the hole. Raises UsageError when its mesh cannot be read or has no hole under the part."""
        if self.part.hole_mesh:
            return mesh_hole_outline(self.part, self.outline)
        return self._widened()

    def _widened(self) -> Outline:
        """The outline of the part, widened by its clearance."""
        x, y = self.part.clearance
        return self.outline.enlarged((x / 2, y / 2))

    @property
    def lower_face(self) -> Array:
        """Corners of the lower face, shape (n, 3)."""
        corners = self.outline.corners()
        return np.column_stack([corners, np.full(len(corners), -self.half[2])])


class Box(PartGeometry):
    """A box."""

    @property
    def outline(self) -> Outline:
        return Rectangle((float(self.half[0]), float(self.half[1])))

    def _widened(self) -> Rectangle:
        x, y = ((size + gap) / 2 for size, gap in zip(self.part.size, self.part.clearance, strict=False))
        return Rectangle((x, y))

    @property
    def volume(self) -> float:
        x, y, z = self.part.size
        return x * y * z

    def body(self, body: BodyDef) -> BodyDef:
        x, y, z = self.part.size
        return _with_inertia(body, self.mass, self.mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]))

    def shape(self, shape: ShapeDef) -> ShapeDef:
        return replace(shape, kind="box", size=self.half)

    def points(self, points: PointsDef) -> PointsDef:
        spacing = (_FACE_SPACING, _FACE_SPACING, _HEIGHT_SPACING)
        counts = [max(2, round(size / step) + 1) for size, step in zip(self.part.size, spacing, strict=True)]
        return with_points(points, *box_surface(self.half.tolist(), counts, faces=("-z", "-x", "+x", "-y", "+y")))

    def side_gaps(self, points: Array, side: int) -> Array:
        on_side = (np.abs(points) <= self.half[1:]).all(-1)
        return np.where(on_side, 0.0, np.inf)


class Cylinder(PartGeometry):
    """A cylinder with a vertical axis."""

    @property
    def outline(self) -> Outline:
        return Circle(float(self.half[0]))

    @property
    def volume(self) -> float:
        return float(np.pi * self.half[0] ** 2 * self.part.size[2])

    def body(self, body: BodyDef) -> BodyDef:
        radius, height = self.half[0], self.part.size[2]
        across = self.mass * (3 * radius**2 + height**2) / 12
        return _with_inertia(body, self.mass, np.array([across, across, self.mass * radius**2 / 2]))

    def shape(self, shape: ShapeDef) -> ShapeDef:
        return replace(shape, kind="cylinder", size=np.array([self.half[0], self.half[2], 0.0]))

    def points(self, points: PointsDef) -> PointsDef:
        radius, height = float(self.half[0]), self.part.size[2]
        angles = max(12, 4 * round(np.pi * radius / _RING_SPACING / 2))
        radii, heights = max(1, round(radius / _FACE_SPACING)), max(2, round(height / _HEIGHT_SPACING) + 1)
        surface = cylinder(radius, height / 2, angles=angles, radii=radii, heights=heights, faces=("-z", "wall"))
        return with_points(points, *surface)

    def side_gaps(self, points: Array, side: int) -> Array:
        y, z = np.abs(points[..., 0]), np.abs(points[..., 1])
        radius = self.half[0]
        depth = radius - np.sqrt(np.maximum(radius**2 - y**2, 0))
        return np.where((y < radius) & (z <= self.half[2]), depth, np.inf)


def _with_inertia(body: BodyDef, mass: float, diagonal: Array) -> BodyDef:
    return replace(body, mass=float(mass), com=np.zeros(3), inertia=np.append(diagonal, [0.0, 0.0, 0.0]))


def with_points(points: PointsDef, local: Array, areas: Array) -> PointsDef:
    """`points` at other positions `local` (n, 3) [m], with area components `areas` (n, 3) [m²]."""
    return replace(points, points=local, areas=areas, weights=np.ones(len(local)))
