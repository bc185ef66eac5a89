"""The shapes of a scene that are touched: geometry of the model file, with what the TOML file says of it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim.scene.distance_grid import DEFAULT_RESOLUTION, LEAST_RESOLUTION, DistanceGrid, distance_grid
from gelflow.sim.scene.mjcf import GeomDef, Mechanics
from gelflow.toml_tables import TomlTable, suggestion

Array = NDArray[np.float64]

SHAPES = ("plane", "sphere", "box", "cylinder", "capsule", "ellipsoid", "mesh")
_KEYS: Mapping[str, tuple[str, ...]] = {
    "box": ("rounding",),
    "cylinder": ("rounding",),
    "mesh": ("rounding", "resolution"),
}
_SIZES = {"box": 3, "cylinder": 2}  # that a rounding must stay below


@dataclass(frozen=True)
class ShapeDef:
    """A geometry that points are tested against."""

    name: str
    body: int
    kind: str  # "plane", "sphere", "box", "cylinder", "capsule", "ellipsoid" or "mesh"
    pose: Pose  # in the body's frame; a plane's normal is its z
    size: Array  # MuJoCo's three: half sizes or half axes; radius; radius and half length [m]; a mesh's scale, 1 0 0
    rounding: float = 0.0  # radius of the edges [m]
    grid: DistanceGrid | None = None  # of a mesh

    @property
    def sharp(self) -> bool:
        """Whether it is as the model file has it."""
        return self.rounding == 0 and self.grid is None


@dataclass(frozen=True)
class _Choice:
    """What the TOML file says of one geometry."""

    rounding: float = 0.0
    resolution: int = DEFAULT_RESOLUTION


def used_shapes(
    mechanics: Mechanics, tables: Mapping[str, TomlTable], wanted: Collection[str], sampled: Collection[str]
) -> tuple[tuple[ShapeDef, ...], tuple[str, ...]]:
    """The shapes that something is tested against, and a line on every geometry that is in nothing at all.

    Parameters
    ----------
    tables: the tables `shapes.GEOM` of the scene file
    wanted: names of the geometries that something is tested against; the grids of meshes are made for these alone
    sampled: names of those with contact points

    Raises UsageError on a wrong table, and when the grid of a mesh can't be made.
    """
    choices = {name: _choice(table, name, mechanics) for name, table in tables.items()}
    shapes = tuple(
        _shape(geom, choices.get(geom.name, _Choice()), tables) for geom in mechanics.geoms if geom.name in wanted
    )
    unused = [
        f"{geom.kind} {geom.name}: in no contact and under no pad"
        for geom in mechanics.geoms
        if geom.name not in {*wanted, *sampled}
    ]
    unused += [f"shapes.{name}: nothing is tested against it" for name in tables if name not in wanted]
    return shapes, tuple(unused)


def _choice(table: TomlTable, name: str, mechanics: Mechanics) -> _Choice:
    geoms = {geom.name: geom for geom in mechanics.geoms}
    if name not in geoms:
        raise UsageError(f"{table.location}: no geometry {name!r}; {suggestion(name, list(geoms))}")
    geom = geoms[name]
    if geom.kind not in _KEYS:
        raise UsageError(f"{table.location}: a {geom.kind} takes no keys here; {', '.join(_KEYS)} do")
    table.check_keys(_KEYS[geom.kind])
    rounding = table.number("rounding", 0.0, minimum=0)
    if geom.kind in _SIZES and rounding >= (least := float(geom.size[: _SIZES[geom.kind]].min())):
        raise UsageError(
            f"{table.location}: rounding must be below the smallest half size, {least:g} m, got {rounding:g}"
        )
    return _Choice(rounding, table.integer("resolution", DEFAULT_RESOLUTION, minimum=LEAST_RESOLUTION))


def _shape(geom: GeomDef, choice: _Choice, tables: Mapping[str, TomlTable]) -> ShapeDef:
    if geom.mesh is None:
        return ShapeDef(geom.name, geom.body, geom.kind, geom.pose, geom.size, choice.rounding)
    try:
        grid = distance_grid(geom.mesh, geom.name, resolution=choice.resolution, rounding=choice.rounding)
    except UsageError as error:
        where = f"{tables[geom.name].location}: " if geom.name in tables else ""
        raise UsageError(f"{where}{error}") from None
    return ShapeDef(geom.name, geom.body, geom.kind, geom.pose, np.array([1.0, 0, 0]), choice.rounding, grid)
