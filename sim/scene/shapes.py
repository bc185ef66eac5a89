"""Collision shapes of a scene: geometries of the model file with the options of the tables `shapes.GEOM`."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim.scene.geometry.distance_grid import DEFAULT_RESOLUTION, MIN_RESOLUTION, DistanceGrid, distance_grid
from gelflow.sim.scene.mjcf.mechanics import GeomDef, Mechanics
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

SHAPE_KINDS = ("plane", "sphere", "box", "cylinder", "capsule", "ellipsoid", "mesh")
_KEYS: Mapping[str, tuple[str, ...]] = {
    "box": ("rounding",),
    "cylinder": ("rounding",),
    "mesh": ("rounding", "resolution"),
}
_NUM_SIZES = {"box": 3, "cylinder": 2}  # number of half sizes, all larger than the rounding


@dataclass(frozen=True)
class ShapeDef:
    """A geometry whose signed distance to contact points and markers is computed."""

    name: str
    body: int
    kind: str  # "plane", "sphere", "box", "cylinder", "capsule", "ellipsoid" or "mesh"
    pose: Pose  # in the body frame; the normal of a plane is its z axis
    size: Array  # MuJoCo's three sizes [m]: half sizes or half axes; radius; radius and half length; 1 0 0 for a mesh
    rounding: float = 0.0  # radius of the edges [m]
    grid: DistanceGrid | None = None  # signed distances of a mesh


@dataclass(frozen=True)
class _Options:
    """The content of a table `shapes.GEOM`."""

    rounding: float = 0.0
    resolution: int = DEFAULT_RESOLUTION


def used_shapes(
    mechanics: Mechanics, tables: Mapping[str, TomlTable], used: Collection[str], sampled: Collection[str]
) -> tuple[tuple[ShapeDef, ...], tuple[str, ...]]:
    """The shapes of contacts and pads, and one line for each geometry and table without effect.

    Parameters
    ----------
    mechanics: the model
    tables: the tables `shapes.GEOM`, by name
    used: names of the geometries of contacts and pads; distance grids are built for these meshes only
    sampled: names of the geometries with contact points

    Raises UsageError on an invalid table, and if the distance grid of a mesh cannot be built.
    """
    geoms = {geom.name: geom for geom in mechanics.geoms}
    options = {name: _options(table, table.lookup(geoms, name, "geometry")) for name, table in tables.items()}
    shapes = tuple(
        _shape(geom, options.get(geom.name, _Options()), tables) for geom in mechanics.geoms if geom.name in used
    )
    unused = [
        f"{geom.kind} {geom.name}: in no contact and under no pad"
        for geom in mechanics.geoms
        if geom.name not in {*used, *sampled}
    ]
    unused += [f"shapes.{name}: in no contact and under no pad" for name in tables if name not in used]
    return shapes, tuple(unused)


def shape_geom(geoms: Mapping[str, GeomDef], name: str, table: TomlTable) -> GeomDef:
    """The geometry `name` that a table refers to as a shape. Raises UsageError if it cannot be a shape."""
    geom = table.lookup(geoms, name, "geometry")
    if geom.kind not in SHAPE_KINDS:
        supported = ", ".join(SHAPE_KINDS)
        raise UsageError(f"{table.location}: {name!r} is a {geom.kind}; contact supports {supported}")
    return geom


def _options(table: TomlTable, geom: GeomDef) -> _Options:
    if geom.kind not in _KEYS:
        raise UsageError(f"{table.location}: a {geom.kind} has no options; {', '.join(_KEYS)} have")
    table.check_keys(_KEYS[geom.kind])
    rounding = table.number("rounding", 0.0, minimum=0)
    if geom.kind in _NUM_SIZES:
        smallest = float(geom.size[: _NUM_SIZES[geom.kind]].min())
        if rounding >= smallest:
            raise UsageError(
                f"{table.location}: rounding must be below the smallest half size, {smallest:g} m, got {rounding:g}"
            )
    return _Options(rounding, table.integer("resolution", DEFAULT_RESOLUTION, minimum=MIN_RESOLUTION))


def _shape(geom: GeomDef, options: _Options, tables: Mapping[str, TomlTable]) -> ShapeDef:
    if geom.mesh is None:
        return ShapeDef(geom.name, geom.body, geom.kind, geom.pose, geom.size, options.rounding)
    try:
        grid = distance_grid(geom.mesh, geom.name, resolution=options.resolution, rounding=options.rounding)
    except UsageError as error:
        prefix = f"{tables[geom.name].location}: " if geom.name in tables else ""
        raise UsageError(f"{prefix}{error}") from None
    return ShapeDef(geom.name, geom.body, geom.kind, geom.pose, np.array([1.0, 0, 0]), options.rounding, grid)
