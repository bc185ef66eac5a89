"""Loading of scenes from a TOML file and the MJCF or URDF file that it names (docs/guide/scenes.md)."""

from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, cast

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim.arguments import shown
from gelflow.sim.scene.contacts import FRICTION_LAWS, read_contacts, read_points, warn_of_gaps
from gelflow.sim.scene.joint_limits import read_limits
from gelflow.sim.scene.mjcf.mechanics import SiteDef, read_mechanics
from gelflow.sim.scene.pads import read_pads
from gelflow.sim.scene.presets import Presets, apply_preset, read_presets
from gelflow.sim.scene.scene import DEFAULT_INTEGRATOR, DEFAULT_TOLERANCE, Precision, Scene
from gelflow.sim.scene.shapes import used_shapes
from gelflow.sim.scene.sites import add_sites
from gelflow.toml_tables import TomlTable, read_toml, set_by_path, suggestion

INTEGRATORS = ("bdf1", "bdf2")
MODEL_SUFFIXES = (".xml", ".urdf")  # of model files that are loaded without a TOML file
PRECISIONS: tuple[Precision, ...] = ("double", "single")

_SOLVER_KEYS = ("step", "integrator", "tolerance", "precision")
# Tables of named elements: each key is the name of an element, for example [pads.left].
_ELEMENT_TABLES = ("joints", "sites", "shapes", "points", "contacts", "pads")
_KEYS = ("format", "model", *_SOLVER_KEYS, "friction", *_ELEMENT_TABLES, "presets")


def scene_names() -> tuple[str, ...]:
    """Names of the scenes that are part of gelflow."""
    names = (file.name for file in _shipped_scenes().iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml")))


def load_scene(
    scene: str | Path,
    *,
    preset: str | None = None,
    friction: str | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Scene:
    """Load a scene.

    Parameters
    ----------
    scene: name of a scene of gelflow, or path of a TOML file; the path of an MJCF or URDF file gives a scene without
        contacts and pads, with the time step of that file
    preset: name of a preset of the file, such as "fast", which trades accuracy for speed
    friction: "viscous" or "elastic", instead of the default friction law of the file
    overrides: values that replace those of the file and of the preset, by dotted key, such as {"pads.pad.rows": 50};
        `*` matches every table at its level. Keys and values are checked like those of the file.

    Raises UsageError, in one line, on an unknown key or name, a missing file, or an element that is not supported.
    """
    path = find_scene(scene)
    data = scene_tables(path)
    presets = read_presets(TomlTable(data, str(path)), top_level_keys=_SOLVER_KEYS, element_tables=_ELEMENT_TABLES)
    if preset is not None:
        apply_preset(data, presets, preset, str(path))
    overrides = {} if overrides is None else overrides
    if not isinstance(overrides, Mapping):
        raise UsageError(f"overrides must be a mapping of dotted keys to values, got {type(overrides).__name__}")
    for key, value in overrides.items():
        if not isinstance(key, str):
            raise UsageError(f"overrides must have dotted keys, such as 'pads.pad.rows', got {shown(key)}")
        set_by_path(data, key, value.tolist() if isinstance(value, np.generic | np.ndarray) else value)
    if friction is not None:
        data["friction"] = friction
    return _read_scene(path, TomlTable(data, str(path)), presets)


def scene_tables(path: Path) -> dict[str, Any]:
    """The tables of a scene file; for a model file those of a scene that has nothing but the model."""
    if path.suffix in MODEL_SUFFIXES:
        return {"format": 1, "model": path.name}
    try:
        return read_toml(path)
    except UsageError as error:
        if path.suffix == ".toml" or not path.is_file():
            raise
        xacro = "; run xacro and load its output" if path.suffix == ".xacro" else ""
        raise UsageError(f"{error}; a scene is a .toml file, or a model file: .xml (MJCF) or .urdf{xacro}") from None


def _read_scene(path: Path, top: TomlTable, presets: Presets) -> Scene:
    if (version := top.integer("format")) > 1:
        raise UsageError(f"{path}: format is {version}; this gelflow reads format 1")
    top.check_keys(_KEYS)
    friction = top.string("friction", "viscous", choices=FRICTION_LAWS)
    mechanics = add_sites(top.tables("sites"), read_mechanics(path.parent / top.string("model")))
    points = read_points(top.tables("points"), top.tables("contacts"), mechanics)
    contacts = read_contacts(top.tables("contacts"), points, mechanics, friction)
    warn_of_gaps(contacts, points, top.tables("points"), mechanics)
    pads = read_pads(top.tables("pads"), mechanics, friction, path.parent)
    shape_names = {contact.shape for contact in contacts} | {name for pad in pads for name in pad.against}
    point_names = {contact.points for contact in contacts}
    sampled_geoms = {points[name].geom for name in point_names}
    shapes, unused_geoms = used_shapes(mechanics, top.tables("shapes"), shape_names, sampled_geoms)
    unused_points = tuple(f"points {name}: in no contact" for name in points if name not in point_names)
    return Scene(
        name=path.stem,
        path=path,
        step=top.number("step", mechanics.step if path.suffix in MODEL_SUFFIXES else None, minimum=1e-6),
        integrator=top.string("integrator", DEFAULT_INTEGRATOR, choices=INTEGRATORS),
        tolerance=top.number("tolerance", DEFAULT_TOLERANCE, minimum=1e-15, maximum=0.1),
        precision=cast("Precision", top.string("precision", "double", choices=PRECISIONS)),
        friction=friction,
        gravity=mechanics.gravity,
        bodies=mechanics.bodies,
        joints=mechanics.joints,
        limits=read_limits(top.tables("joints"), mechanics, top.location),
        tendons=mechanics.tendons,
        couplings=mechanics.couplings,
        loop_closures=mechanics.loop_closures,
        actuators=mechanics.actuators,
        shapes=shapes,
        points=tuple(p for p in points.values() if p.name in point_names),
        contacts=contacts,
        pads=pads,
        sites=tuple(SiteDef(name, body, pose) for name, (body, pose) in mechanics.sites.items()),
        geoms=mechanics.geoms,
        q0=mechanics.q0,
        keyframe_controls=mechanics.keyframe_controls,
        not_modelled=(*mechanics.not_modelled, *unused_geoms, *unused_points),
        presets=presets,
    )


def find_scene(scene: str | Path) -> Path:
    """The file of a scene, by name or path. Raises UsageError for an unknown name."""
    if not isinstance(scene, str | Path):
        raise UsageError(f"scene must be a name or a path, got {type(scene).__name__}")
    path, names = Path(scene), scene_names()
    if scene in names:  # even if the working directory has a file of this name
        return Path(str(_shipped_scenes())) / f"{scene}.toml"
    if path.suffix in (".toml", *MODEL_SUFFIXES) or path.is_file():
        return path
    raise UsageError(f"no scene {str(scene)!r}; {suggestion(str(scene), names)} (or give a .toml, .xml or .urdf file)")


def _shipped_scenes() -> Traversable:
    return resources.files("gelflow.sim") / "scenes"
