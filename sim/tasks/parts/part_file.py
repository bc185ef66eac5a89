"""Reads part files: the TOML description of a part, its hole, its grasp and its misalignment."""

import math
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.part import CUBOID, SHAPES, Part
from gelflow.task import INSERTION, InsertionTask, insertion_task
from gelflow.toml_tables import TomlTable, read_toml, suggestion

FORMAT = 1

_DEFAULT_DENSITY = 1000.0  # [kg/m³]
_TABLES = ("format", "name", "part", "hole", "grasp", "misalignment", "symmetry")
_PART_KEYS = {"box": ("size",), "cylinder": ("diameter", "height"), "mesh": ("file", "scale")}
_WEIGHTS = ("density", "mass")


def part_names() -> tuple[str, ...]:
    """Names of the parts that are part of gelflow."""
    return tuple(sorted(Path(file.name).stem for file in _folder().iterdir() if file.name.endswith(".toml")))


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
        return insertion_task(_read_part(top, path), misalignment=_misalignment(top.table("misalignment")))
    except UsageError as error:
        raise error if str(error).startswith(str(path)) else UsageError(f"{path}: {error}") from None


def _read_part(top: TomlTable, path: Path) -> Part:
    table = top.table("part")
    shape = table.string("shape", choices=SHAPES)
    table.check_keys(("shape", *_PART_KEYS[shape], *_WEIGHTS))
    if shape == "mesh":
        return _read_mesh_part(top, path)
    hole = top.table("hole").check_keys(("clearance", "depth"))
    if shape == "box":
        x, y, z = table.numbers("size", 3)
        clearance = hole.numbers("clearance", 2) if isinstance(hole.data.get("clearance"), list) else _both(hole)
        symmetry, volume = 4 if x == y and clearance[0] == clearance[1] else 2, x * y * z
    else:
        x = y = table.number("diameter", minimum=0)
        z, clearance, symmetry = table.number("height", minimum=0), _both(hole), 0
        volume = math.pi * x * x / 4 * z
    return Part(
        name=top.string("name", path.stem),
        shape=shape,
        size=(x, y, z),
        grasp_width=x,
        density=_density(table, volume),
        clearance=(clearance[0], clearance[1]),
        depth=hole.number("depth", CUBOID.depth),
        symmetry=symmetry,
        grasp_height=_pair(top.table("grasp").check_keys(("height",)), "height", CUBOID.grasp_height),
    )


def _read_mesh_part(top: TomlTable, path: Path) -> Part:
    """A part whose shape is a mesh; size, grasp width and symmetry are found from it, unless the file gives them."""
    from gelflow.sim.tasks.parts import mesh_part

    table, hole = top.table("part"), top.table("hole").check_keys(("clearance", "depth"))
    file = (path.parent / table.string("file")).resolve()
    scale = table.number("scale", 1.0, minimum=1e-9)
    grasp = _pair(top.table("grasp").check_keys(("height",)), "height", CUBOID.grasp_height)
    mesh = mesh_part.load_part_mesh(file, scale)
    left, right = mesh_part.grasped_sides(mesh, grasp)
    x, y, z = (float(extent) for extent in mesh.vertices.max(0) - mesh.vertices.min(0))
    given = top.table("symmetry").check_keys(("rotations", "mirror"))
    symmetry, mirror = (1, ()) if len(given.data) == 2 else mesh_part.found_symmetry(mesh, file.name)
    if "mirror" in given.data:
        mirror = given.strings("mirror") if given.data["mirror"] else ()
    return Part(
        name=top.string("name", path.stem),
        shape="mesh",
        size=(x, y, z),
        grasp_width=right - left,
        density=_density(table, mesh.volume()),
        clearance=_both(hole),
        depth=hole.number("depth", CUBOID.depth),
        grasp_height=grasp,
        symmetry=given.integer("rotations", symmetry, minimum=0),
        mirror=mirror,
        mesh=mesh_part.file_digest(file),
        mesh_file=str(file),
        mesh_scale=scale,
    )


def _density(table: TomlTable, volume: float) -> float:
    if "mass" not in table.data:
        return table.number("density", _DEFAULT_DENSITY)
    if "density" in table.data:
        raise UsageError(f"{table.location}: give either mass or density")
    return table.number("mass") / volume if volume > 0 else 0.0


def _both(hole: TomlTable) -> tuple[float, float]:
    clearance = hole.number("clearance")
    return clearance, clearance


def _pair(table: TomlTable, key: str, default: tuple[float, float]) -> tuple[float, float]:
    low, high = table.numbers(key, 2, default)
    return low, high


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
    path = Path(part)
    if path.suffix == ".toml" or path.is_file():
        return path
    shipped = Path(str(_folder())) / f"{part}.toml"
    if not shipped.is_file():
        raise UsageError(f"no part {str(part)!r}; {suggestion(str(part), part_names())} (or give a .toml file)")
    return shipped


def _folder() -> Traversable:
    return resources.files("gelflow.sim") / "tasks" / "parts" / "shipped"
