"""The parts of a scene that its TOML file describes: sampled points, contacts, pads, joint limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.observation import Grid
from gelflow.sim.scene.gel import Gel, read_gel
from gelflow.sim.scene.mjcf import GeomDef, Mechanics
from gelflow.sim.scene.sampling import (
    ENDS,
    FACES,
    box_surface,
    capsule,
    cylinder,
    disc_lattice,
    ellipsoid,
    mesh_surface,
    turned_frames,
)
from gelflow.sim.scene.shapes import SHAPES
from gelflow.toml_tables import TomlTable, suggestion

Array = NDArray[np.float64]
T = TypeVar("T")

LAWS = ("viscous", "elastic")
NUMBERS = ("kn", "kt", "mu", "kd", "ks")
_PER_UNIT = ("per point", "per area")
_GIVEN = ("positions", "normals", "x_axes")
# Keys of a pad's table that only its shape has.
_PAD_KEYS: Mapping[str, tuple[str, ...]] = {
    "rectangle": ("rows", "cols", "pitch", "size", "center"),
    "disc": ("radius", "count", "center"),
    "hemisphere": ("radius", "count"),
    "points": (*_GIVEN, "file"),
}


@dataclass(frozen=True)
class PointsDef:
    """Points sampled on a geometry, in the frame of the body that carries it."""

    name: str
    geom: str
    body: int
    points: Array  # [m], shape (n, 3)
    areas: Array  # across x, y, z of the geometry's frame [m²], shape (n, 3); their sum is a point's area
    weights: Array  # what multiplies the contact's numbers: ones, or the areas; shape (n,)
    radius: float  # > 0: one point, the centre of a sphere of this radius [m]
    pose: Pose  # of the geometry, in the body's frame
    per_area: bool


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
    """A tactile pad: markers on a body."""

    name: str
    body: int
    shape: str  # "rectangle", "disc", "hemisphere" or "points"
    pose: Pose  # of the site, in the body's frame
    positions: Array  # of the markers, in the body's frame [m], shape (n, 3)
    axes: Array  # columns x, y, z of each marker in the body's frame, shape (n, 3, 3)
    weights: Array  # shape (n,)
    grid: Grid | None  # on the pad [mm]; only a rectangle has one
    against: tuple[str, ...]
    law: str
    numbers: Mapping[str, float]
    pushes: bool  # its markers are contact points too
    gel: Gel | None = None  # None: forces only


@dataclass(frozen=True)
class _Markers:
    """The markers of a pad, in its site's frame."""

    positions: Array  # [m], shape (n, 3)
    axes: Array  # columns x, y, z of each marker, shape (n, 3, 3)
    area: float | None  # that one marker stands for [m²]; None where it is not known
    grid: Grid | None  # a rectangle's [mm]


@dataclass(frozen=True)
class Limit:
    """How a joint resists beyond its range."""

    stiffness: float = 0.0  # [N/m] or [N m/rad]
    damping: float = 0.0  # [N s/m] or [N m s/rad]


def read_points(tables: Mapping[str, TomlTable], mechanics: Mechanics) -> dict[str, PointsDef]:
    """Sample the geometries that the tables name. Raises UsageError on an unknown or unsuitable geometry."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    return {name: _sample(name, table, geoms) for name, table in tables.items()}


def _sample(name: str, table: TomlTable, geoms: Mapping[str, GeomDef]) -> PointsDef:
    geom = _named(geoms, table.string("geom"), table, "geometry")
    if geom.kind == "sphere" and "count" not in table.data:
        if len(table.data) > 1:
            raise UsageError(
                f"{table.location}: without a count {geom.name!r} is one exact point, which takes geom alone"
            )
        radius, center = float(geom.size[0]), geom.pose.position[None]
        return PointsDef(name, geom.name, geom.body, center, np.ones((1, 3)), np.ones(1), radius, geom.pose, False)
    try:
        local, areas = _surface(table, geom)
    except UsageError as error:
        raise UsageError(
            str(error) if str(error).startswith(table.location) else f"{table.location}: {error}"
        ) from None
    per_area = table.string("stiffness", "per point", choices=_PER_UNIT) == "per area"
    weights = areas.sum(1) if per_area else np.ones(len(areas))
    return PointsDef(name, geom.name, geom.body, geom.pose.apply(local), areas, weights, 0.0, geom.pose, per_area)


def _surface(table: TomlTable, geom: GeomDef) -> tuple[Array, Array]:
    """Points on a geometry's surface, in its frame [m], and the area of each across x, y, z [m²]."""
    size = geom.size.tolist()
    if geom.kind == "box":
        table.check_keys(("geom", "resolution", "faces", "stiffness"))
        resolution = [int(n) for n in table.numbers("resolution", 3)]
        return box_surface(size, resolution, faces=table.strings("faces", FACES))
    if geom.kind == "cylinder":
        table.check_keys(("geom", "angles", "radii", "heights", "faces", "stiffness"))
        angles, radii = table.integer("angles", 8), table.integer("radii", 4)
        faces, heights = table.strings("faces", ENDS), table.integer("heights", 5)
        if "heights" in table.data and "wall" not in faces:
            raise UsageError('heights are those of the wall; add faces = ["-z", "+z", "wall"]')
        return cylinder(*size[:2], angles=angles, radii=radii, heights=heights, faces=faces)
    if geom.mesh is not None:
        table.check_keys(("geom", "count", "stiffness"))
        return mesh_surface(geom.mesh, count=table.integer("count"))
    if geom.kind not in ("sphere", "capsule", "ellipsoid"):
        known = "box, cylinder, sphere, capsule, ellipsoid, mesh"
        raise UsageError(f"{geom.kind} {geom.name!r} can't be sampled; {known} can")
    table.check_keys(("geom", "count", "faces", "stiffness"))
    count, faces = table.integer("count"), table.strings("faces", ENDS)
    if geom.kind == "ellipsoid":
        return ellipsoid(size, count=count, faces=faces)
    return capsule(size[0], size[1] if geom.kind == "capsule" else 0.0, count=count, faces=faces)


def read_contacts(
    tables: Mapping[str, TomlTable], points: Mapping[str, PointsDef], mechanics: Mechanics, friction: str
) -> tuple[ContactDef, ...]:
    """The contacts, one for every shape that a table's points are against."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    contacts = []
    for group, table in tables.items():
        table.check_keys(("points", "against", "damping", "law", *LAWS, *NUMBERS))
        sampled = _named(points, table.string("points"), table, "points")
        law = table.string("law", friction, choices=LAWS)
        damping = table.string("damping", "depth", choices=("depth", "plain"))
        numbers = _law_numbers(table, law)
        against = table.strings("against")
        for shape in against:
            geom = _shape(geoms, shape, table)
            if geom.body == sampled.body:
                raise UsageError(f"{table.location}: {sampled.geom!r} and {shape!r} are on one body and can't touch")
            if sampled.radius > 0 and geom.kind != "plane":
                raise UsageError(
                    f"{table.location}: the exact contact point of a sphere supports planes only; sample {shape!r} "
                    f"instead, or give points {sampled.name!r} a count"
                )
            if sampled.radius > 0 and law == "elastic":
                raise UsageError(
                    f"{table.location}: the exact point of {sampled.geom!r} moves over the sphere as it rolls and "
                    'cannot keep an anchor; set law = "viscous" for this contact'
                )
            name = group if len(against) == 1 else f"{group}/{shape}"
            contacts.append(ContactDef(name, group, sampled.name, shape, law, damping, numbers))
    return tuple(contacts)


def read_pads(tables: Mapping[str, TomlTable], mechanics: Mechanics, friction: str, folder: Path) -> tuple[PadDef, ...]:
    """The pads: markers about a site of the model, whose z is the outward normal and x points to the tip.

    `folder` is where the files of markers are looked for.
    """
    geoms = {geom.name: geom for geom in mechanics.geoms}
    common = ("site", "shape", "against", "stiffness", "law", "pushes", "gel", *LAWS, *NUMBERS)
    pads = []
    for name, table in tables.items():
        shape = table.string("shape", "rectangle", choices=tuple(_PAD_KEYS))
        table.check_keys((*common, *_PAD_KEYS[shape]))
        body, frame = _named(mechanics.sites, table.string("site"), table, "site")
        markers = _markers(table, shape, folder)
        law = table.string("law", friction, choices=LAWS)
        per_area = table.string("stiffness", "per point", choices=_PER_UNIT) == "per area"
        if per_area and markers.area is None:
            raise UsageError(f"{table.location}: the area of given markers is not known; set stiffness per point")
        against = tuple(_shape(geoms, other, table).name for other in table.strings("against"))
        pads.append(
            PadDef(
                name=name,
                body=body,
                shape=shape,
                pose=frame,
                positions=frame.apply(markers.positions),
                axes=frame.matrix() @ markers.axes,
                weights=np.full(len(markers.positions), markers.area if per_area and markers.area else 1.0),
                grid=markers.grid,
                against=against,
                law=law,
                numbers=_law_numbers(table, law),
                pushes=table.boolean("pushes", default=False),
                gel=_gel(table, markers),
            )
        )
    return tuple(pads)


def _gel(table: TomlTable, markers: _Markers) -> Gel | None:
    if "gel" not in table.data:
        return None
    return read_gel(table.table("gel"), markers.positions, markers.axes, markers.grid, markers.area)


def _markers(table: TomlTable, shape: str, folder: Path) -> _Markers:
    """The markers of a pad of this shape; files are looked for in `folder`.

    Raises UsageError, in one line, on missing or wrong values.
    """
    if shape == "rectangle":
        grid = _grid(table)
        return _flat(grid.positions() * 1e-3, (grid.pitch * 1e-3) ** 2, grid)
    if shape == "points":
        return _given(table, folder)
    radius, count = table.number("radius", minimum=1e-9), table.integer("count")
    if shape == "disc":
        flat = disc_lattice(radius, count) + table.numbers("center", 2, (0.0, 0.0))
        return _flat(flat, np.pi * radius**2 / count, None)
    # From the top down, about the middle of the sphere.
    positions = capsule(radius, 0.0, count=count, faces=("+z",))[0][::-1]
    return _Markers(positions, turned_frames(positions / radius), 2 * np.pi * radius**2 / count, None)


def _flat(points: Array, area: float, grid: Grid | None) -> _Markers:
    positions = np.column_stack([points, np.zeros(len(points))])
    return _Markers(positions, np.tile(np.eye(3), (len(points), 1, 1)), area, grid)


def _grid(table: TomlTable) -> Grid:
    """Rows and columns with a pitch, or with the size of the area that they fill; TOML in m, the grid in mm."""
    rows, cols = table.integer("rows"), table.integer("cols")
    if ("pitch" in table.data) == ("size" in table.data):
        raise UsageError(f"{table.location}: give either pitch (distance of markers) or size (area that they fill)")
    if "pitch" in table.data:
        pitch = table.number("pitch", minimum=1e-9)
    else:
        size = table.numbers("size", 2)
        pitch = size[0] / rows
        if not np.isclose(pitch, size[1] / cols):
            raise UsageError(
                f"{table.location}: {rows} × {cols} markers on {size} m are not equally far apart; give pitch"
            )
    center = table.numbers("center", 2, (0.0, 0.0))
    return Grid(rows, cols, pitch * 1e3, (center[0] * 1e3, center[1] * 1e3))


def _given(table: TomlTable, folder: Path) -> _Markers:
    """Markers at points of the table or of a file: positions, and optionally normals and x axes."""
    if ("positions" in table.data) == ("file" in table.data):
        raise UsageError(f"{table.location}: a pad of points needs either positions or a file")
    if "file" in table.data:
        if extra := [key for key in _GIVEN if key in table.data]:
            raise UsageError(f"{table.location}: {extra[0]} must stand in the file, beside its positions")
        found, where = _from_file(folder / table.string("file"), table.location)
    else:
        found, where = {key: table.data[key] for key in _GIVEN if key in table.data}, table.location
    positions = _vectors(found, "positions", where)
    count = len(positions)
    normals = _units(found, "normals", where, count)
    axes = np.tile(np.eye(3), (count, 1, 1)) if normals is None else turned_frames(normals)
    tips = _units(found, "x_axes", where, count)
    if tips is not None:
        x = tips - (tips * axes[..., 2]).sum(1, keepdims=True) * axes[..., 2]
        length = np.linalg.norm(x, axis=1, keepdims=True)
        if (length < 1e-6).any():
            raise UsageError(f"{where}: x_axes[{int(length.argmin())}] is along the normal; it must lie across")
        x /= length
        axes = np.stack([x, np.cross(axes[..., 2], x), axes[..., 2]], axis=-1)
    return _Markers(positions, axes, None, None)


def _from_file(path: Path, where: str) -> tuple[dict[str, Any], str]:
    """The arrays of an NPZ file, or the columns of a CSV file: position, then normal, then x axis."""
    place = f"{where}: {path.name}"
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in arrays.files}
            if unknown := [name for name in found if name not in _GIVEN]:
                raise UsageError(f"{place}: unknown array {unknown[0]!r}; valid names: {', '.join(_GIVEN)}")
            return found, place
        if path.suffix != ".csv":
            raise UsageError(f"{place}: a file of markers must be .csv or .npz")
        columns = np.loadtxt(path, delimiter=",", ndmin=2)
    except FileNotFoundError:
        raise UsageError(f"{place}: no such file beside the scene") from None
    except (OSError, ValueError) as error:
        raise UsageError(f"{place} can't be read: {str(error).splitlines()[0]}") from None
    if columns.shape[1] not in (3, 6, 9):
        raise UsageError(f"{place}: expected 3, 6 or 9 columns (position, normal, x axis), got {columns.shape[1]}")
    parts = np.split(columns, columns.shape[1] // 3, axis=1)
    return dict(zip(_GIVEN, parts, strict=False)), place


def _vectors(found: Mapping[str, Any], key: str, where: str) -> Array:
    try:
        vectors = np.array(found.get(key, ()), dtype=float)
    except (TypeError, ValueError):
        vectors = np.zeros(0)
    if vectors.ndim != 2 or vectors.shape[1] != 3 or not len(vectors) or not np.isfinite(vectors).all():
        raise UsageError(f"{where}: {key} must be a list of [x, y, z], all finite")
    return vectors


def _units(found: Mapping[str, Any], key: str, where: str, count: int) -> Array | None:
    """Directions, one for each marker, as unit vectors; None where there are none."""
    if key not in found:
        return None
    vectors = _vectors(found, key, where)
    if len(vectors) != count:
        raise UsageError(f"{where}: {key} must be as many as positions, {count}, got {len(vectors)}")
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if (length < 1e-9).any():
        raise UsageError(f"{where}: {key}[{int(length.argmin())}] has no direction")
    units: Array = vectors / length
    return units


def read_limits(tables: Mapping[str, TomlTable], mechanics: Mechanics, where: str) -> tuple[Limit, ...]:
    """How each joint resists beyond its range: as its table says, or as the model file's reader chose."""
    names = [joint.name for joint in mechanics.joints]
    for name, table in tables.items():
        if name not in names:
            raise UsageError(f"{table.location}: the model has no joint {name!r}; {suggestion(name, names)}")
        table.check_keys(("limit_stiffness", "limit_damping"))
    limits = []
    for joint in mechanics.joints:
        table = tables.get(joint.name, TomlTable({}, where))
        if table.data and joint.range is None:
            raise UsageError(f"{where}: joint {joint.name!r} has no range in the model; a limit needs one")
        stiffness, damping = joint.limit or (0.0, 0.0)
        if "limit_stiffness" in table.data:
            stiffness, damping = table.number("limit_stiffness", minimum=0), 0.0
        limits.append(Limit(stiffness, table.number("limit_damping", damping, minimum=0)))
    return tuple(limits)


def _law_numbers(table: TomlTable, law: str) -> dict[str, float]:
    """The force law's numbers: those of the law's own table before the common ones; no k_s under the viscous law."""
    for name in LAWS:
        table.table(name).check_keys(NUMBERS)
    own = TomlTable({**table.data, **table.table(law).data}, table.location)
    numbers = {key: own.number(key, minimum=0) for key in NUMBERS if key != "ks"}
    return {**numbers, "ks": own.number("ks", None if law == "elastic" else 0.0, minimum=0)}


def _shape(geoms: Mapping[str, GeomDef], name: str, table: TomlTable) -> GeomDef:
    geom = _named(geoms, name, table, "geometry")
    if geom.kind not in SHAPES:
        raise UsageError(
            f"{table.location}: {name!r} is a {geom.kind}; contact is computed against {', '.join(SHAPES)}"
        )
    return geom


def _named(things: Mapping[str, T], name: str, table: TomlTable, what: str) -> T:
    if name not in things:
        raise UsageError(f"{table.location}: no {what} {name!r}; {suggestion(name, list(things))}")
    return things[name]
