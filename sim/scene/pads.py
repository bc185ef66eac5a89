"""Tactile pads: marker layouts on a body."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.gel.gel_file import load_gel
from gelflow.geometry import Pose
from gelflow.observation import Grid
from gelflow.sim.scene.contacts import CONTACT_PARAMS, FRICTION_LAWS, is_per_area, read_contact_params
from gelflow.sim.scene.gel import Gel, read_gel
from gelflow.sim.scene.geometry.sampling import capsule, check_count, disc_lattice, shortest_rotations
from gelflow.sim.scene.marker_files import read_marker_list
from gelflow.sim.scene.mjcf.mechanics import GeomDef, Mechanics
from gelflow.sim.scene.shapes import shape_geom
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

_COMMON_KEYS = ("site", "shape", "against", "stiffness", "law", "collides", "gel", *FRICTION_LAWS, *CONTACT_PARAMS)
_SHAPE_KEYS: Mapping[str, tuple[str, ...]] = {
    "rectangle": ("rows", "cols", "pitch", "size", "center"),
    "disc": ("radius", "count", "center"),
    "hemisphere": ("radius", "count"),
    "points": ("positions", "normals", "x_axes", "file"),
}
_LARGEST = 1e6  # size, radius or pitch of a pad [m]
_RENAMED_KEYS = {"pushes": "collides"}


@dataclass(frozen=True)
class PadDef:
    """A tactile pad: markers on a body."""

    name: str
    body: int
    shape: str  # "rectangle", "disc", "hemisphere" or "points"
    pose: Pose  # of the site in the body frame
    positions: Array  # of the markers in the body frame [m], shape (n, 3)
    axes: Array  # of the markers in the body frame: columns x, y, z; shape (n, 3, 3)
    weights: Array  # factors on the contact parameters: ones, or the areas of the markers [m²]; shape (n,)
    grid: Grid | None  # rows and columns [mm]; rectangles only
    against: tuple[str, ...]  # names of shapes
    law: str  # friction law: "viscous" or "elastic"
    params: Mapping[str, float]  # kn, kt, mu, kd, ks
    collides: bool = False  # the markers are contact points: the tactile forces act on the body
    gel: Gel | None = None  # None: no displacements, tactile forces only


@dataclass(frozen=True)
class _Markers:
    """The markers of a pad in the frame of its site."""

    positions: Array  # [m], shape (n, 3)
    axes: Array  # columns x, y, z of each marker, shape (n, 3, 3)
    area: float | None  # per marker [m²]; None if unknown
    grid: Grid | None  # [mm]; rectangles only


def read_pads(tables: Mapping[str, TomlTable], mechanics: Mechanics, friction: str, folder: Path) -> tuple[PadDef, ...]:
    """The pads of the tables `pads.NAME`.

    Parameters
    ----------
    tables: the tables, by name
    mechanics: the model; z of the site of a pad is the outward normal, x points to the tip of the finger
    friction: default friction law
    folder: of the TOML file; files of markers are relative to it

    Raises UsageError, in one line, on an unknown name and on an invalid value.
    """
    geoms = {geom.name: geom for geom in mechanics.geoms}
    return tuple(_read_pad(name, table, mechanics, geoms, friction, folder) for name, table in tables.items())


def _read_pad(
    name: str,
    table: TomlTable,
    mechanics: Mechanics,
    geoms: Mapping[str, GeomDef],
    friction: str,
    folder: Path,
) -> PadDef:
    shape = table.string("shape", "rectangle", choices=tuple(_SHAPE_KEYS))
    table.check_keys((*_COMMON_KEYS, *_SHAPE_KEYS[shape]), renamed=_RENAMED_KEYS)
    body, site = table.lookup(mechanics.sites, table.string("site"), "site")
    markers = _markers(table, shape, folder)
    law = table.string("law", friction, choices=FRICTION_LAWS)
    weight = 1.0
    if is_per_area(table):
        if markers.area is None:
            raise UsageError(f'{table.location}: listed markers have no area; set stiffness = "per point"')
        weight = markers.area
    return PadDef(
        name=name,
        body=body,
        shape=shape,
        pose=site,
        positions=site.apply(markers.positions),
        axes=site.matrix() @ markers.axes,
        weights=np.full(len(markers.positions), weight),
        grid=markers.grid,
        against=_against(table, geoms, body),
        law=law,
        params=read_contact_params(table, law),
        collides=table.boolean("collides", default=False),
        gel=_gel(table, markers, folder),
    )


def _against(table: TomlTable, geoms: Mapping[str, GeomDef], body: int) -> tuple[str, ...]:
    """Names of the shapes that the markers of a pad on `body` touch."""
    names = table.strings("against")
    for i, name in enumerate(names):
        if shape_geom(geoms, name, table).body == body:
            raise UsageError(f"{table.location}: {name!r} is on the body of the pad and cannot touch it")
        if name in names[:i]:
            raise UsageError(f"{table.location}: against names {name!r} twice")
    return names


def _gel(table: TomlTable, markers: _Markers, folder: Path) -> Gel | None:
    if "gel" not in table.data:
        return None
    if isinstance(table.data["gel"], str):
        gel = load_gel(folder / table.string("gel"))
        layer = {name: getattr(gel, name) for name in ("youngs_modulus", "poisson_ratio", "thickness")}
        table = TomlTable({"gel": layer}, table.location)
    return read_gel(table.table("gel"), markers.positions, markers.axes, markers.grid, markers.area)


def _markers(table: TomlTable, shape: str, folder: Path) -> _Markers:
    if shape == "rectangle":
        grid = _grid(table)
        return _planar_markers(grid.positions() * 1e-3, (grid.pitch * 1e-3) ** 2, grid)
    if shape == "points":
        return _Markers(*read_marker_list(table, folder), area=None, grid=None)
    radius, count = table.number("radius", minimum=1e-9, maximum=_LARGEST), table.integer("count")
    check_count(table.location, count)
    if shape == "disc":
        positions = disc_lattice(radius, count) + table.numbers("center", 2, (0.0, 0.0))
        return _planar_markers(positions, np.pi * radius**2 / count, None)
    # A hemisphere, from its pole (+z) downwards.
    positions = capsule(radius, 0.0, count=count, faces=("+z",))[0][::-1]
    return _Markers(positions, shortest_rotations(positions / radius), 2 * np.pi * radius**2 / count, None)


def _planar_markers(positions: Array, area: float, grid: Grid | None) -> _Markers:
    count = len(positions)
    return _Markers(np.column_stack([positions, np.zeros(count)]), np.tile(np.eye(3), (count, 1, 1)), area, grid)


def _grid(table: TomlTable) -> Grid:
    """The grid of a rectangle [mm], from rows, columns and either the pitch or the size of the area [m]."""
    rows, cols = table.integer("rows"), table.integer("cols")
    check_count(table.location, rows * cols)
    if ("pitch" in table.data) == ("size" in table.data):
        raise UsageError(f"{table.location}: give either pitch (distance of markers) or size (area of the markers)")
    if "pitch" in table.data:
        pitch = table.number("pitch", minimum=1e-9, maximum=_LARGEST)
    else:
        size = table.numbers("size", 2)
        if min(size) <= 0:
            raise UsageError(f"{table.location}: size must be two positive numbers, got {list(size)}")
        if max(size) > _LARGEST:
            raise UsageError(f"{table.location}: size must be at most {_LARGEST:g} m, got {list(size)}")
        pitch = size[0] / rows
        if not np.isclose(pitch, size[1] / cols):
            raise UsageError(
                f"{table.location}: {rows} × {cols} markers on {size} m have different pitches along rows and columns; "
                "give pitch"
            )
    center = table.numbers("center", 2, (0.0, 0.0))
    return Grid(rows, cols, pitch * 1e3, (center[0] * 1e3, center[1] * 1e3))
