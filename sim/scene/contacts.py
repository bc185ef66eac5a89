"""Contact points sampled on geometries, and contacts between point sets and shapes."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim.scene.default_points import (
    WIDEST_GAP,
    choose_spacings,
    default_surface,
    largest_gap,
    smallest_width,
)
from gelflow.sim.scene.geometry.sampling import (
    ENDS,
    FACES,
    box_surface,
    capsule,
    check_count,
    cylinder,
    ellipsoid,
    mesh_surface,
)
from gelflow.sim.scene.mjcf.mechanics import GeomDef, Mechanics
from gelflow.sim.scene.shapes import shape_geom
from gelflow.toml_tables import TomlTable

Array = NDArray[np.float64]

FRICTION_LAWS = ("viscous", "elastic")
DAMPING_LAWS = ("hunt-crossley", "linear")  # the first is the default
_RENAMED_DAMPING = {"depth": "hunt-crossley", "plain": "linear"}
CONTACT_PARAMS = ("kn", "kt", "mu", "kd", "ks")  # parameters of the contact law (docs/reference/physics.md)
_STIFFNESS_UNITS = ("per point", "per area")
_DENSITY_KEYS = ("resolution", "count", "angles", "radii", "heights", "faces")


@dataclass(frozen=True)
class PointsDef:
    """Contact points sampled on a geometry."""

    name: str
    geom: str
    body: int
    points: Array  # in the body frame [m], shape (n, 3)
    areas: Array  # components of the area along the axes of the geometry [m²], shape (n, 3); their sum is the area
    weights: Array  # factors on the contact parameters: ones, or the areas [m²]; shape (n,)
    radius: float = 0.0  # > 0: a single point, the centre of a sphere of this radius [m]
    pose: Pose = field(default_factory=Pose)  # of the geometry in the body frame
    per_area: bool = False  # weights are areas


@dataclass(frozen=True)
class ContactDef:
    """A contact between a point set and a shape."""

    name: str
    group: str  # table of the TOML file; a table with several shapes becomes several contacts
    points: str
    shape: str
    law: str  # friction law: "viscous" or "elastic"
    damping: str  # "hunt-crossley" (scaled by penetration depth, eq. 8 of Xu et al., CoRL 2022) or "linear"
    params: Mapping[str, float]  # kn, kt, mu, kd, ks


def read_points(
    tables: Mapping[str, TomlTable], contacts: Mapping[str, TomlTable], mechanics: Mechanics
) -> dict[str, PointsDef]:
    """The point sets of the tables `points.NAME`; `contacts` are the tables `contacts.NAME`.

    Raises UsageError on an unknown or unsupported geometry.
    """
    geoms = {geom.name: geom for geom in mechanics.geoms}
    for table in contacts.values():  # a wrong name leaves points without partner and without default density
        table.lookup(tables, table.string("points"), "points")
        for shape in table.strings("against"):
            table.lookup(geoms, shape, "geometry")
    spacings = _default_spacings(tables, contacts, geoms)
    return {name: _sample(name, table, geoms, spacings.get(name)) for name, table in tables.items()}


def warn_of_gaps(
    contacts: Sequence[ContactDef],
    points: Mapping[str, PointsDef],
    tables: Mapping[str, TomlTable],
    mechanics: Mechanics,
) -> None:
    """Warn of each contact whose shape fits between the points, unless points on it cover the opposite direction."""
    geoms = {geom.name: geom for geom in mechanics.geoms}
    gaps: dict[str, float] = {}

    def covered(name: str, shape: str) -> bool:
        sampled, width = points[name], smallest_width(geoms[shape])
        if sampled.radius > 0 or np.isinf(width):
            return True
        if name not in gaps:
            geom = geoms[sampled.geom]
            faces = tables[name].strings("faces", FACES if geom.kind == "box" else ENDS)
            gaps[name] = largest_gap(geom, geom.pose.inverse().apply(sampled.points), faces)
        return gaps[name] <= WIDEST_GAP * width

    pairs = [(contact, points[contact.points].geom) for contact in contacts]
    for contact, geom in pairs:
        if covered(contact.points, contact.shape):
            continue
        if any(other.shape == geom and of == contact.shape and covered(other.points, geom) for other, of in pairs):
            continue
        given = tables[contact.points].data.keys() & {*_DENSITY_KEYS}
        denser = "increase count" if "count" in given else f"omit {', '.join(sorted(given))}"
        advice = f"{denser}, or add" if given else "add"
        warnings.warn(
            f"{tables[contact.points].location}: {contact.shape!r}, {smallest_width(geoms[contact.shape]):.3g} m wide, "
            f"can pass between the points of {geom!r}, whose gaps are up to {gaps[contact.points]:.3g} m; {advice} a "
            f"contact of points on {contact.shape!r} against {geom!r}",
            stacklevel=2,
        )


def read_contacts(
    tables: Mapping[str, TomlTable], points: Mapping[str, PointsDef], mechanics: Mechanics, friction: str
) -> tuple[ContactDef, ...]:
    """The contacts of the tables `contacts.NAME`, one per shape; `friction` is the default friction law.

    Raises UsageError on an unknown name, an invalid value, and a combination that is not supported.
    """
    geoms = {geom.name: geom for geom in mechanics.geoms}
    contacts = []
    for group, table in tables.items():
        table.check_keys(("points", "against", "damping", "law", *FRICTION_LAWS, *CONTACT_PARAMS))
        sampled = table.lookup(points, table.string("points"), "points")
        law = table.string("law", friction, choices=FRICTION_LAWS)
        damping = table.string("damping", DAMPING_LAWS[0], choices=DAMPING_LAWS, renamed=_RENAMED_DAMPING)
        params = read_contact_params(table, law)
        against = table.strings("against")
        for shape in against:
            _check_contact(sampled, shape_geom(geoms, shape, table), law, table)
            name = group if len(against) == 1 else f"{group}/{shape}"
            contacts.append(ContactDef(name, group, sampled.name, shape, law, damping, params))
    return tuple(contacts)


def read_contact_params(table: TomlTable, law: str) -> dict[str, float]:
    """The parameters of the contact law, by name; `ks` is 0 under the viscous law.

    Values in the subtable of the law (`viscous`, `elastic`) take precedence over those of the table itself.
    """
    for name in FRICTION_LAWS:
        table.table(name).check_keys(CONTACT_PARAMS)
    merged = TomlTable({**table.data, **table.table(law).data}, table.location)
    params = {key: merged.number(key, minimum=0) for key in CONTACT_PARAMS if key != "ks"}
    return {**params, "ks": merged.number("ks", None if law == "elastic" else 0.0, minimum=0)}


def is_per_area(table: TomlTable) -> bool:
    """Whether the key `stiffness` of a table sets the contact parameters per area instead of per point."""
    return table.string("stiffness", "per point", choices=_STIFFNESS_UNITS) == "per area"


def _check_contact(sampled: PointsDef, shape: GeomDef, law: str, table: TomlTable) -> None:
    if shape.body == sampled.body:
        raise UsageError(f"{table.location}: {sampled.geom!r} and {shape.name!r} are on one body and cannot collide")
    if sampled.radius > 0 and shape.kind != "plane":
        raise UsageError(
            f"{table.location}: the exact contact point of a sphere supports planes only; sample {shape.name!r} "
            f"instead, or give points {sampled.name!r} a count"
        )
    if sampled.radius > 0 and law == "elastic":
        raise UsageError(
            f"{table.location}: the exact point of {sampled.geom!r} moves over the sphere as it rolls and "
            'cannot keep an anchor; set law = "viscous" for this contact'
        )


def _default_spacings(
    tables: Mapping[str, TomlTable], contacts: Mapping[str, TomlTable], geoms: Mapping[str, GeomDef]
) -> dict[str, float]:
    """The spacing of each point set that is in a contact and whose table gives no density [m].

    Names of geometries that do not exist are left to the reader of points.
    """
    partners: dict[str, list[GeomDef]] = {}
    for table in contacts.values():
        partners.setdefault(table.string("points"), []).extend(geoms[shape] for shape in table.strings("against"))
    sampled = {name: geoms.get(str(table.data.get("geom"))) for name, table in tables.items()}
    default = {
        name: geom
        for name, geom in sampled.items()
        if geom and partners.get(name) and not tables[name].data.keys() & {*_DENSITY_KEYS}
    }
    return choose_spacings(default, partners)


def _sample(name: str, table: TomlTable, geoms: Mapping[str, GeomDef], spacing: float | None) -> PointsDef:
    geom = table.lookup(geoms, table.string("geom"), "geometry")
    if geom.kind == "sphere" and "count" not in table.data:
        if len(table.data) > 1:
            raise UsageError(
                f"{table.location}: without a count {geom.name!r} is one exact contact point, which takes no other keys"
            )
        radius, center = float(geom.size[0]), geom.pose.position[None]
        return PointsDef(name, geom.name, geom.body, center, np.ones((1, 3)), np.ones(1), radius, geom.pose, False)
    if spacing is not None:
        table.check_keys(("geom", "stiffness"))
    try:
        local, areas = _surface(table, geom) if spacing is None else default_surface(geom, spacing)
    except UsageError as error:
        located = str(error).startswith(table.location)
        raise UsageError(str(error) if located else f"{table.location}: {error}") from None
    per_area = is_per_area(table)
    weights = areas.sum(1) if per_area else np.ones(len(areas))
    points = geom.pose.apply(local)
    return PointsDef(name, geom.name, geom.body, points, areas, weights, 0.0, geom.pose, per_area)


def _surface(table: TomlTable, geom: GeomDef) -> tuple[Array, Array]:
    """Points on the surface of a geometry, in its frame [m], and their areas along its axes [m²]."""
    size = geom.size.tolist()
    if geom.kind == "box":
        table.check_keys(("geom", "resolution", "faces", "stiffness"))
        if not table.data.keys() & {"resolution", "faces"}:
            raise UsageError(f"{table.location}: in no contact, so without default density; give resolution")
        return box_surface(size, table.integers("resolution", 3), faces=table.strings("faces", FACES))
    if geom.kind == "cylinder":
        table.check_keys(("geom", "angles", "radii", "heights", "faces", "stiffness"))
        angles, radii = table.integer("angles", 8), table.integer("radii", 4)
        faces, heights = table.strings("faces", ENDS), table.integer("heights", 5)
        if "heights" in table.data and "wall" not in faces:
            raise UsageError('heights apply to the wall; add faces = ["-z", "+z", "wall"]')
        rows = radii * sum(face != "wall" for face in faces) + heights * ("wall" in faces)
        check_count(table.location, angles * rows)
        return cylinder(*size[:2], angles=angles, radii=radii, heights=heights, faces=faces)
    if geom.mesh is not None:
        table.check_keys(("geom", "count", "stiffness"))
        return mesh_surface(geom.mesh, count=table.integer("count"))
    if geom.kind not in ("sphere", "capsule", "ellipsoid"):
        supported = "box, cylinder, sphere, capsule, ellipsoid, mesh"
        raise UsageError(f"{geom.kind} {geom.name!r} cannot be sampled; supported: {supported}")
    table.check_keys(("geom", "count", "faces", "stiffness"))
    count, faces = table.integer("count"), table.strings("faces", ENDS)
    check_count(table.location, count)
    if geom.kind == "ellipsoid":
        return ellipsoid(size, count=count, faces=faces)
    return capsule(size[0], size[1] if geom.kind == "capsule" else 0.0, count=count, faces=faces)
