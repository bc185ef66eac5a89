"""The parts of a scene that its TOML file describes: sampled points, contacts, pads, joint limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.sampling import FACES, box_surface, disc
from gelflow.sim.scene_mjcf import GeomDef, Mechanics, Pose
from gelflow.sim.scene_toml import Table, nearest

Array = NDArray[np.float64]
T = TypeVar("T")

LAWS = ("viscous", "elastic")
_NUMBERS = ("kn", "kt", "mu", "kd", "ks")
_PER_UNIT = ("per point", "per area")
_SHAPES = ("plane", "sphere", "box")


@dataclass(frozen=True)
class ShapeDef:
    """A geometry that points are tested against."""

    name: str
    body: int
    kind: str  # "plane", "sphere" or "box"
    pose: Pose  # in the body's frame; a plane's normal is its z
    size: Array  # box: half sizes; sphere: radius first [m]


@dataclass(frozen=True)
class PointsDef:
    """Points sampled on a geometry, in the frame of the body that carries it."""

    name: str
    geom: str
    body: int
    points: Array  # [m], shape (n, 3)
    areas: Array  # [m²], shape (n,)
    weights: Array  # what multiplies the contact's numbers: ones, or the areas
    radius: float  # > 0: one point, the centre of a sphere of this radius [m]


@dataclass(frozen=True)
class ContactDef:
    """One point set against one shape."""

    name: str
    group: str  # its table in the TOML file; several shapes make several contacts of one group
    points: str
    shape: str
    law: str
    damping: str
    numbers: Mapping[str, float]  # kn, kt, mu, kd, ks


@dataclass(frozen=True)
class PadDef:
    """A tactile pad: a grid of markers on a body."""

    name: str
    body: int
    positions: Array  # of the markers, in the body's frame [m], shape (n, 3)
    axes: Array  # columns x, y, z of the pad in the body's frame
    weights: Array  # shape (n,)
    grid: Grid  # on the pad [mm]
    against: tuple[str, ...]
    law: str
    numbers: Mapping[str, float]


@dataclass(frozen=True)
class Limit:
    """How a joint resists beyond its range."""

    stiffness: float = 0.0  # [N/m] or [N m/rad]
    damping: float = 0.0  # [N s/m] or [N m s/rad]


def read_points(tables: Mapping[str, Table], mechanics: Mechanics) -> dict[str, PointsDef]:
    """Sample the geometries that the tables name. Raises UsageError on an unknown or unsuitable geometry."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    return {name: _sample(name, table, geoms) for name, table in tables.items()}


def _sample(name: str, table: Table, geoms: Mapping[str, GeomDef]) -> PointsDef:
    geom = _named(geoms, table.word("geom"), table, "geometry")
    radius, unit = 0.0, "per point"
    if geom.kind == "box":
        table.only(("geom", "resolution", "faces", "stiffness"))
        resolution = [int(n) for n in table.numbers("resolution", 3)]
        local, areas = box_surface(geom.size.tolist(), resolution, faces=table.words("faces", FACES))
    elif geom.kind == "cylinder":
        table.only(("geom", "angles", "radii", "faces", "stiffness"))
        angles, radii = table.integer("angles", 8), table.integer("radii", 4)
        local, areas = disc(*geom.size[:2], angles=angles, radii=radii, faces=table.words("faces", ("-z", "+z")))
    elif geom.kind == "sphere":
        table.only(("geom",))
        radius = float(geom.size[0])
        local, areas = np.zeros((1, 3)), np.ones(1)
    else:
        raise UsageError(f"{table.where}: {geom.kind} {geom.name!r} can't be sampled; box, cylinder (disc), sphere can")
    if geom.kind != "sphere":
        unit = table.word("stiffness", "per point", among=_PER_UNIT)
    weights = areas if unit == "per area" else np.ones(len(areas))
    return PointsDef(name, geom.name, geom.body, geom.pose.points(local), areas, weights, radius)


def read_contacts(
    tables: Mapping[str, Table], points: Mapping[str, PointsDef], mechanics: Mechanics, friction: str
) -> tuple[ContactDef, ...]:
    """The contacts, one for every shape that a table's points are against."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    contacts = []
    for group, table in tables.items():
        table.only(("points", "against", "damping", "law", *LAWS, *_NUMBERS))
        sampled = _named(points, table.word("points"), table, "points")
        law = table.word("law", friction, among=LAWS)
        damping = table.word("damping", "depth", among=("depth", "plain"))
        numbers = _law_numbers(table, law)
        against = table.words("against")
        for shape in against:
            geom = _shape(geoms, shape, table)
            if geom.body == sampled.body:
                raise UsageError(f"{table.where}: {sampled.geom!r} and {shape!r} are on one body and can't touch")
            if sampled.radius > 0 and geom.kind != "plane":
                raise UsageError(
                    f"{table.where}: the one exact point of a sphere touches planes; let {shape!r} be the sampled side"
                )
            if sampled.radius > 0 and law == "elastic":
                raise UsageError(
                    f"{table.where}: the exact point of {sampled.geom!r} moves over the sphere as it rolls and can't "
                    'keep an anchor; set law = "viscous" for this contact'
                )
            name = group if len(against) == 1 else f"{group}/{shape}"
            contacts.append(ContactDef(name, group, sampled.name, shape, law, damping, numbers))
    return tuple(contacts)


def read_pads(tables: Mapping[str, Table], mechanics: Mechanics, friction: str) -> tuple[PadDef, ...]:
    """The pads: a grid of markers at a site of the model; z is its outward normal, x points to the tip."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    keys = ("site", "rows", "cols", "pitch", "size", "center", "against", "stiffness", "law", *LAWS, *_NUMBERS)
    pads = []
    for name, table in tables.items():
        table.only(keys)
        body, frame = _named(mechanics.sites, table.word("site"), table, "site")
        grid = _grid(table)
        law = table.word("law", friction, among=LAWS)
        local = np.column_stack([grid.positions() * 1e-3, np.zeros(grid.rows * grid.cols)])
        per_area = table.word("stiffness", "per point", among=_PER_UNIT) == "per area"
        against = tuple(_shape(geoms, shape, table).name for shape in table.words("against"))
        pads.append(
            PadDef(
                name=name,
                body=body,
                positions=frame.points(local),
                axes=frame.matrix(),
                weights=np.full(len(local), (grid.pitch * 1e-3) ** 2 if per_area else 1.0),
                grid=grid,
                against=against,
                law=law,
                numbers=_law_numbers(table, law),
            )
        )
    return tuple(pads)


def _grid(table: Table) -> Grid:
    """Rows and columns with a pitch, or with the size of the area that they fill; TOML in m, the grid in mm."""
    rows, cols = table.integer("rows"), table.integer("cols")
    if ("pitch" in table.data) == ("size" in table.data):
        raise UsageError(f"{table.where}: give either pitch (distance of markers) or size (area that they fill)")
    if "pitch" in table.data:
        pitch = table.number("pitch", least=1e-9)
    else:
        size = table.numbers("size", 2)
        pitch = size[0] / rows
        if not np.isclose(pitch, size[1] / cols):
            raise UsageError(
                f"{table.where}: {rows} × {cols} markers on {size} m are not equally far apart; give pitch"
            )
    center = table.numbers("center", 2, (0.0, 0.0))
    return Grid(rows, cols, pitch * 1e3, (center[0] * 1e3, center[1] * 1e3))


def read_limits(tables: Mapping[str, Table], mechanics: Mechanics, where: str) -> tuple[Limit, ...]:
    """How each joint resists beyond its range: as its table says, or as the model file's reader chose."""
    names = [joint.name for joint in mechanics.joints]
    for name, table in tables.items():
        if name not in names:
            raise UsageError(f"{table.where}: the model has no joint {name!r}; {nearest(name, names)}")
        table.only(("limit_stiffness", "limit_damping"))
    limits = []
    for joint in mechanics.joints:
        table = tables.get(joint.name, Table({}, where))
        if table.data and joint.range is None:
            raise UsageError(f"{where}: joint {joint.name!r} has no range in the model; a limit needs one")
        stiffness, damping = joint.limit or (0.0, 0.0)
        if "limit_stiffness" in table.data:
            stiffness, damping = table.number("limit_stiffness", least=0), 0.0
        limits.append(Limit(stiffness, table.number("limit_damping", damping, least=0)))
    return tuple(limits)


def used_shapes(
    mechanics: Mechanics,
    points: Mapping[str, PointsDef],
    contacts: tuple[ContactDef, ...],
    pads: tuple[PadDef, ...],
) -> tuple[tuple[ShapeDef, ...], tuple[str, ...]]:
    """The shapes that something is tested against, and a line on every geometry that is in nothing at all."""
    wanted = {contact.shape for contact in contacts} | {name for pad in pads for name in pad.against}
    sampled = {points[contact.points].geom for contact in contacts}
    shapes = tuple(
        ShapeDef(geom.name, geom.body, geom.kind, geom.pose, geom.size)
        for geom in mechanics.geoms
        if geom.name in wanted
    )
    unused = tuple(
        f"{geom.kind} {geom.name}: in no contact and under no pad"
        for geom in mechanics.geoms
        if geom.name not in wanted | sampled
    )
    return shapes, unused


def _law_numbers(table: Table, law: str) -> dict[str, float]:
    """The force law's numbers: those of the law's own table before the common ones; no k_s under the viscous law."""
    for name in LAWS:
        table.table(name).only(_NUMBERS)
    own = Table({**table.data, **table.table(law).data}, table.where)
    numbers = {key: own.number(key, least=0) for key in _NUMBERS if key != "ks"}
    return {**numbers, "ks": own.number("ks", None if law == "elastic" else 0.0, least=0)}


def _shape(geoms: Mapping[str, GeomDef], name: str, table: Table) -> GeomDef:
    geom = _named(geoms, name, table, "geometry")
    if geom.kind not in _SHAPES:
        raise UsageError(f"{table.where}: {name!r} is a {geom.kind}; contact is computed against {', '.join(_SHAPES)}")
    return geom


def _named(things: Mapping[str, T], name: str, table: Table, what: str) -> T:
    if name not in things:
        raise UsageError(f"{table.where}: no {what} {name!r}; {nearest(name, list(things))}")
    return things[name]
