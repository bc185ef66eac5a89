"""Reads part files: the TOML description of a part, its hole, its grasp and its misalignment."""

import math
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gelflow.errors import UsageError
from gelflow.part import CUBOID, SHAPES, Part
from gelflow.task import INSERTION, InsertionTask, insertion_task
from gelflow.toml_tables import TomlTable, read_toml, suggestion

if TYPE_CHECKING:
    from gelflow.sim.scene.geometry.mesh import TriangleMesh

FORMAT = 1

_DEFAULT_DENSITY = 1000.0  # [kg/m³]
_HEAVIEST = 2.5  # [kg]; two pads hold 28 N at the mean grasp force (9.25 N) and friction (1.5) of the randomization
_MOST_ROTATIONS = 72
_TABLES = ("format", "name", "part", "hole", "grasp", "descent", "misalignment", "symmetry")
_PART_KEYS = {"box": ("size",), "cylinder": ("diameter", "height"), "mesh": ("file", "scale")}
_WEIGHTS = ("density", "mass")
_OUTLINE_HOLE, _MESH_HOLE = ("clearance", "depth"), ("file", "scale", "depth")


def part_names() -> tuple[str, ...]:
    """Names of the parts that are part of gelflow."""
    return tuple(sorted(Path(file.name).stem for file in _folder().iterdir() if file.name.endswith(".toml")))


def with_shipped_mesh(part: Part) -> Part:
    """The part with the file of its mesh if this comes with gelflow; descriptions hold only the digest of a file."""
    from gelflow.sim.tasks.parts import mesh_file

    for file in Path(str(_folder())).glob("*.obj") if part.mesh else ():
        if part.mesh == mesh_file.file_digest(file):
            return replace(part, mesh_file=str(file))
    return part


def shipped_mesh(part: Part) -> "TriangleMesh | None":
    """The mesh of a part of gelflow in the frame of the part [m], also with unknown `mesh_file`; None for others."""
    from gelflow.sim.tasks.parts import mesh_part

    found = with_shipped_mesh(replace(part, mesh_file=""))
    return mesh_part.MeshPart(found).mesh if found.mesh_file else None


def load_part(part: str | Path) -> InsertionTask:
    """The insertion of the part in a file.

    `part` is the name of a part of gelflow, such as "peg", or the path of a TOML file (docs/guide/own_part.md). Raises
    UsageError, in one line, on a missing file, an unknown key, or a value that is not possible.
    """
    path = _find(part)
    top = TomlTable(read_toml(path), str(path)).check_keys(_TABLES)
    if (version := top.integer("format")) > FORMAT:
        raise UsageError(f"{path}: format is {version}; this gelflow reads format {FORMAT}")
    try:
        misalignment = _misalignment(top.table("misalignment"))
        return insertion_task(_read_part(top, path), misalignment=misalignment, descent=_descent(top.table("descent")))
    except UsageError as error:
        raise error if str(error).startswith(str(path)) else UsageError(f"{path}: {error}") from None


def _read_part(top: TomlTable, path: Path) -> Part:
    table = top.table("part")
    shape = table.string("shape", choices=SHAPES)
    table.check_keys(("shape", *_PART_KEYS[shape], *_WEIGHTS))
    hole = _hole_fields(top.table("hole"), path, shape)
    part = _read_mesh_part(top, path, hole) if shape == "mesh" else _read_solid(top, path, shape, hole)
    _check_weight(part, table)
    if part.hole_mesh:
        part = _fitted(part)
    given = top.table("symmetry")
    if "rotations" in given.data:
        _check_rotations(part, given)
    return replace(part, mirror=_mirror(given)) if "mirror" in given.data else part


def _mirror(given: TomlTable) -> tuple[str, ...]:
    axes = given.strings("mirror") if given.data["mirror"] else ()
    return tuple(sorted(set(axes)))  # the order of the file has no meaning


def _hole_fields(hole: TomlTable, path: Path, shape: str) -> dict[str, Any]:
    """The fields of a part that describe its hole; with a mesh of the hole, `_fitted` sets the clearance later."""
    if "file" not in hole.check_keys((*_OUTLINE_HOLE, *_MESH_HOLE)).data:
        hole.check_keys(_OUTLINE_HOLE)
        both = shape != "box" or not isinstance(hole.data.get("clearance"), list)
        clearance = (hole.number("clearance"),) * 2 if both else hole.numbers("clearance", 2)
        return {"clearance": clearance, "depth": hole.number("depth", CUBOID.depth)}
    hole.check_keys(_MESH_HOLE)
    from gelflow.sim.tasks.parts import mesh_file

    file, scale = (path.parent / hole.string("file")).resolve(), hole.number("scale", 1.0, minimum=1e-9)
    z = mesh_file.load_mesh(file, scale).vertices[:, 2]
    height = round(float(z.max() - z.min()), 9)
    depth = hole.number("depth", height)
    if depth > height:
        raise UsageError(f"{hole.location}: depth must be at most {height:g}, the height of the mesh, got {depth:g}")
    return {"depth": depth, "hole_mesh": mesh_file.file_digest(file), "hole_scale": scale, "hole_file": str(file)}


def _fitted(part: Part) -> Part:
    """`part` with what follows from the mesh of its hole: twice the smallest gap as clearance, and common symmetry."""
    from gelflow.sim.tasks.parts.hole_mesh import mirror_axes, smallest_gap
    from gelflow.sim.tasks.parts.registry import part_geometry

    geometry = part_geometry(part)
    gap = round(smallest_gap(geometry.outline, geometry.hole), 6)
    if gap <= 0:
        raise UsageError(
            f"the part overlaps the mesh of its hole by {-1e3 * gap:.2f} mm; x and y of the mesh must be those of the "
            "part in the hole"
        )
    mirror = tuple(axis for axis in part.mirror if axis in mirror_axes(geometry.hole))
    return replace(part, clearance=(2 * gap, 2 * gap), mirror=mirror)


def _read_solid(top: TomlTable, path: Path, shape: str, hole: dict[str, Any]) -> Part:
    """A part that is a box or a cylinder."""
    table = top.table("part")
    if shape == "box":
        x, y, z = table.numbers("size", 3)
        square = x == y and "clearance" in hole and hole["clearance"][0] == hole["clearance"][1]
        symmetry, volume = 4 if square else 2, x * y * z
    else:
        x = y = table.number("diameter", minimum=0)
        z, symmetry = table.number("height", minimum=0), 0
        volume = math.pi * x * x / 4 * z
    top.table("symmetry").check_keys(("mirror",))
    return Part(
        name=top.string("name", path.stem),
        shape=shape,
        size=(x, y, z),
        grasp_width=x,
        density=_density(table, volume),
        grasp_height=_pair(top.table("grasp").check_keys(("height",)), "height", CUBOID.grasp_height),
        symmetry=symmetry,
        **hole,
    )


def _read_mesh_part(top: TomlTable, path: Path, hole: dict[str, Any]) -> Part:
    """A part whose shape is a mesh; size, grasp width and symmetry are found from it, unless the file gives them."""
    from gelflow.sim.tasks.parts import mesh_file, mesh_part

    table = top.table("part")
    file = (path.parent / table.string("file")).resolve()
    scale = table.number("scale", 1.0, minimum=1e-9)
    grasp = _pair(top.table("grasp").check_keys(("height",)), "height", CUBOID.grasp_height)
    mesh, centre = mesh_part.centred(mesh_file.load_mesh(file, scale))
    left, right = mesh_part.grasped_sides(mesh, grasp)
    # Rounded: a description, and thus the checkpoints for it, must be equal on computers with other arithmetic.
    x, y, z = (round(float(extent), 9) for extent in mesh.vertices.max(0) - mesh.vertices.min(0))
    if "hole_mesh" in hole:
        hole = {**hole, "hole_origin": (round(float(centre[0]) + (left + right) / 2, 9), round(float(centre[1]), 9))}
    given = top.table("symmetry").check_keys(("rotations", "mirror"))
    symmetry, mirror = (1, ()) if len(given.data) == 2 else mesh_part.found_symmetry(mesh, file.name)
    return Part(
        name=top.string("name", path.stem),
        shape="mesh",
        size=(x, y, z),
        grasp_width=round(right - left, 9),
        density=round(_density(table, mesh.volume()), 6),
        grasp_height=grasp,
        symmetry=given.integer("rotations", symmetry, minimum=0),
        mirror=mirror,
        mesh=mesh_file.file_digest(file),
        mesh_file=str(file),
        mesh_scale=scale,
        **hole,
    )


def _density(table: TomlTable, volume: float) -> float:
    if "mass" not in table.data:
        return table.number("density", _DEFAULT_DENSITY)
    if "density" in table.data:
        raise UsageError(f"{table.location}: give either mass or density")
    mass = table.number("mass", minimum=0)
    return mass / volume if volume > 0 else _DEFAULT_DENSITY


def _check_weight(part: Part, table: TomlTable) -> None:
    """Raises UsageError for a part that is heavier than the pads can hold."""
    from gelflow.sim.tasks.parts.registry import part_geometry

    if (mass := part_geometry(part).mass) > _HEAVIEST:
        raise UsageError(
            f"{table.location}: the part weighs {mass:.3g} kg; the gripper holds at most {_HEAVIEST:g} kg (mass is in "
            "kg, density in kg/m³)"
        )


def _check_rotations(part: Part, table: TomlTable) -> None:
    """Raises UsageError for rotations after which the mesh of a part does not fit into its hole."""
    from gelflow.sim.tasks.parts import mesh_part

    if part.symmetry > _MOST_ROTATIONS:
        raise UsageError(
            f"{table.location}: rotations must be at most {_MOST_ROTATIONS}, or 0 for a round part, got {part.symmetry}"
        )
    mesh, _ = mesh_part.centred(mesh_part.MeshPart(part).mesh)
    error, gap = mesh_part.rotation_error(mesh, part.name, part.symmetry), max(part.clearance) / 2
    if error > gap:
        kind = "round (rotations = 0)" if part.is_round else f"equal after 1/{part.symmetry} of a turn"
        raise UsageError(
            f"{table.location}: the mesh is not {kind}: it differs by {1e3 * error:.2g} mm, the gap beside the part is "
            f"{1e3 * gap:.2g} mm; rotations = 1 is a part without such a symmetry"
        )


def _pair(table: TomlTable, key: str, default: tuple[float, float]) -> tuple[float, float]:
    low, high = table.numbers(key, 2, default)
    return low, high


def _descent(table: TomlTable) -> float | None:
    return table.number("depth") if "depth" in table.check_keys(("depth",)).data else None


def _misalignment(table: TomlTable) -> tuple[float, float, float]:
    table.check_keys(("x", "y", "yaw_deg"))
    x, y, yaw = INSERTION.misalignment
    limits: dict[str, Any] = dict(zip(("x", "y", "yaw_deg"), INSERTION.workspace, strict=True))
    values = {"x": table.number("x", x, minimum=0), "y": table.number("y", y, minimum=0)}
    yaw_deg = table.number("yaw_deg", math.degrees(yaw), minimum=0)
    values["yaw_deg"] = yaw if "yaw_deg" not in table.data else math.radians(yaw_deg)
    for key, value in values.items():
        if value > limits[key] * (1 + 1e-9):
            shown = math.degrees(limits[key]) if key == "yaw_deg" else limits[key]
            raise UsageError(f"{table.location}: {key} must be at most {shown:g}, the workspace of the corrections")
    return values["x"], values["y"], values["yaw_deg"]


def _find(part: str | Path) -> Path:
    path, names = Path(part), part_names()
    if part in names:  # even if the working directory has a file of this name
        return Path(str(_folder())) / f"{part}.toml"
    if path.suffix == ".toml" or path.is_file():
        return path
    raise UsageError(f"no part {str(part)!r}; {suggestion(str(part), names)} (or give a .toml file)")


def _folder() -> Traversable:
    return resources.files("gelflow.sim") / "tasks" / "parts" / "shipped"
