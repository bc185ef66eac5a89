"""The insertion scene with a part of one's own and its hole."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gelflow.geometry import Pose
from gelflow.part import CUBOID, Part
from gelflow.sim.scene import Scene
from gelflow.sim.scene.contacts import ContactDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.sim.tasks.parts.geometry import PartGeometry
from gelflow.sim.tasks.parts.hole_mesh import mesh_hole_grid
from gelflow.sim.tasks.parts.outline import hole_grid
from gelflow.sim.tasks.parts.registry import part_geometry

T = TypeVar("T")

HOLE_SPACING = 0.5e-3  # of the distance grid of a hole [m]
HOLE = "hole"  # shape of a hole that has no walls
HOLE_CONTACT = "part_hole"  # group of the contacts between the part and its hole
WALLS = ("wall_left", "wall_right", "wall_front", "wall_back")
_START_GAP = 0.5e-3  # of the part above the rim in the initial state [m]
_WALL_HALF_THICKNESS = 20e-3


def with_part(scene: Scene, part: Part) -> Scene:
    """`scene`, which is the insertion scene with the cuboid, with `part` and its hole.

    The walls of the hole of a box are four boxes; every other hole is one signed distance grid, also a mesh around the
    hole of a box. Raises UsageError when a mesh cannot be read.
    """
    if part == CUBOID:
        return scene
    geometry = part_geometry(part)
    bodies = tuple(geometry.body(body) if body.name == "part" else body for body in scene.bodies)
    shapes = tuple(geometry.shape(shape) if shape.name == "part" else shape for shape in scene.shapes)
    points = tuple(geometry.points(p) if p.name == "part" else p for p in scene.points)
    scene = replace(scene, bodies=bodies, shapes=shapes, points=points, q0=_start(scene, part))
    if part.shape == "box" and not part.hole_mesh:
        return _with_walls(scene, part)
    return _with_grid(scene, geometry)


def _start(scene: Scene, part: Part) -> NDArray[np.float64]:
    """The part at rest in the grasp above the hole."""
    q = scene.q0.copy()
    height = part.depth + _START_GAP + part.size[2] / 2
    q[scene.q("arm_z")] = q[scene.q("part").start + 2] = height
    for finger in ("finger_left", "finger_right"):
        q[scene.q(finger)] = -part.grasp_width / 2
    return q


def _with_walls(scene: Scene, part: Part) -> Scene:
    """Four walls; they overlap outside the corners of the hole, see `insertion.xml`."""
    half_x, half_y = ((size + gap) / 2 for size, gap in zip(part.size[:2], part.clearance, strict=True))
    t, z = _WALL_HALF_THICKNESS, part.depth / 2
    placed = {
        "wall_left": ((-half_x - t, 0.0, z), (t, half_y + 2 * t, z)),
        "wall_right": ((half_x + t, 0.0, z), (t, half_y + 2 * t, z)),
        "wall_front": ((0.0, -half_y - t, z), (half_x + 2 * t, t, z)),
        "wall_back": ((0.0, half_y + t, z), (half_x + 2 * t, t, z)),
    }

    def wall(shape: ShapeDef) -> ShapeDef:
        position, size = (np.round(values, 9) for values in placed[shape.name])
        return replace(shape, pose=Pose(position), size=size)

    return replace(scene, shapes=tuple(wall(s) if s.name in placed else s for s in scene.shapes))


def _with_grid(scene: Scene, geometry: PartGeometry) -> Scene:
    """One distance grid in place of the walls."""
    part = geometry.part
    grid = mesh_hole_grid(part, HOLE_SPACING) if part.hole_mesh else hole_grid(geometry.hole, part.depth, HOLE_SPACING)
    first = next(shape for shape in scene.shapes if shape.name in WALLS)
    hole = replace(first, name=HOLE, kind="mesh", pose=Pose(), size=np.array([1.0, 0.0, 0.0]), grid=grid)
    shapes = tuple(shape for shape in scene.shapes if shape.name not in WALLS)
    geoms = tuple(geom for geom in scene.geoms if geom.name not in WALLS)
    return replace(scene, geoms=geoms, shapes=(*shapes, hole), contacts=_one_contact(scene.contacts))


def _one_contact(contacts: tuple[ContactDef, ...]) -> tuple[ContactDef, ...]:
    """The contacts with those of the walls replaced by one with the hole."""
    of_hole = [contact for contact in contacts if contact.group == HOLE_CONTACT]
    others = tuple(contact for contact in contacts if contact.group != HOLE_CONTACT)
    return (*others, replace(of_hole[0], name=HOLE_CONTACT, shape=HOLE))


def hole_parameters(scene: Scene, params: Mapping[str, T]) -> dict[str, T]:
    """Contact parameters by name; those of the walls become those of the hole where a scene has no walls."""
    if any(shape.name in WALLS for shape in scene.shapes):
        return dict(params)
    wall = f"{HOLE_CONTACT}/{WALLS[0]}."
    others = {name: values for name, values in params.items() if not name.startswith(f"{HOLE_CONTACT}/")}
    of_wall = {name: values for name, values in params.items() if name.startswith(wall)}
    return {**others, **{f"{HOLE_CONTACT}.{name.removeprefix(wall)}": values for name, values in of_wall.items()}}
