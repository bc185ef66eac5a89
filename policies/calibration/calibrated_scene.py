"""The scene of the insertion with calibrated values, as files that `load_scene` and every command open."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.policies.calibration.calibration import Calibration
from gelflow.policies.calibration.model.shear_model import QUANTITIES
from gelflow.sim.scene.loader import find_scene, scene_tables
from gelflow.sim.tasks.insertion_randomization import ARM_JOINTS, NOMINAL, simulator_parameters
from gelflow.toml_tables import toml_text

SCENE, MODEL = "scene.toml", "insertion.xml"
_ELASTIC = ("ks", "kt")  # in the table of the friction law
_HEADING = (
    "# The scene `insertion` with the values that gelflow calibrate has found for: {names}.\n"
    "# All other values, part and hole are those of the included scene.\n"
)


def write_scene(result: Calibration, folder: Path) -> list[Path]:
    """Write `scene.toml` and its model with the values of the known and partly known parameters; returns the files.

    Writes nothing when no parameter of the scene is known. Raises OSError, also where one of the files exists.
    """
    known = {
        e.parameter.name: e.value
        for e in result.estimates
        if e.verdict != "unknown" and e.parameter.name in QUANTITIES and not e.parameter.name.startswith("grasp")
    }
    if not known:
        return []
    shipped = find_scene("insertion")
    tables = scene_tables(shipped)
    changed = _changed_parameters(known)
    for name, value in changed.items():
        _set(tables, name, value)
    tables["model"] = MODEL
    scene, model = folder / SCENE, folder / MODEL
    for file, text in (
        (scene, _HEADING.format(names=", ".join(known)) + toml_text(tables)),
        (model, _model(shipped.with_name(MODEL), changed)),
    ):
        with file.open("x", encoding="utf-8") as out:
            out.write(text)
    return [scene, model]


def _changed_parameters(known: Mapping[str, float]) -> dict[str, float]:
    """Parameters of the simulator that differ from those of the scene."""

    def parameters(values: Mapping[str, float]) -> dict[str, float]:
        nominal = NOMINAL.replace(**values).sample(np.random.default_rng(0), 1, friction="elastic")
        return {name: float(value[0]) for name, value in simulator_parameters(nominal, elastic=True).items()}

    before = parameters({})
    return {name: value for name, value in parameters(known).items() if value != before[name]}


def _set(tables: dict[str, Any], parameter: str, value: float) -> None:
    """Set a parameter such as `pad_left.kn` of a contact, or `left.ks` of a pad; those of the arm are in the model."""
    owner, key = parameter.rsplit(".", 1)
    owner = owner.partition("/")[0]  # the walls of the hole are one contact
    for kind in ("contacts", "pads"):
        if owner in tables[kind]:
            table = tables[kind][owner]
            (table["elastic"] if key in _ELASTIC else table)[key] = value


def _model(shipped: Path, parameters: Mapping[str, float]) -> str:
    """The model of the scene, with the parameters of the arm's servos."""
    root = ElementTree.fromstring(shipped.read_bytes())
    for servo in root.iterfind("actuator/position"):
        name = servo.get("name")
        if name in ARM_JOINTS and f"{name}.kp" in parameters:
            servo.set("kp", repr(parameters[f"{name}.kp"]))
            servo.set("kv", repr(parameters[f"{name}.kd"]))
    return ElementTree.tostring(root, encoding="unicode") + "\n"
