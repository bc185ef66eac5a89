"""A model file, parsed and compiled by MuJoCo; what URDF says and MuJoCo passes over is added here."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco

from gelflow.errors import UsageError


def compile_model(path: Path) -> tuple[Any, bool]:
    """The compiled model (mujoco.MjModel), and whether the file is URDF.

    Raises UsageError, in one line, when a file is missing or unreadable.
    """
    if not path.is_file():
        raise UsageError(f"no such model file: {path}")
    robot = _urdf(path)
    spec = None
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if robot is not None:
            spec.compiler.fusestatic = False  # bodies are merged by us, and their frames keep their names
            _find_meshes(spec, path)
            _add_motors(spec, robot)
        return spec.compile(), robot is not None
    except (ValueError, mujoco.FatalError) as error:
        raise UsageError(f"{path}: {_explained(' '.join(str(error).split()), spec)}") from None


def element_names(model: Any, kind: str, count: int) -> list[str]:
    """Names of a model's elements, by MuJoCo's accessor ("body", "joint", …); those without one get one made up."""
    given = [getattr(model, kind)(i).name for i in range(count)]
    taken = set(given)
    for i, name in enumerate(given):
        if not name:
            made = f"{kind}{i}"
            while made in taken:
                made += "_"
            given[i] = made
            taken.add(made)
    return given


def _explained(message: str, spec: Any) -> str:
    """MuJoCo's message, or a clearer one for a mesh that is not there or that it can't read."""
    found = re.search(r"(?:rror opening|decoder found for mesh) file '([^']*)'", message)
    if found is None or spec is None:
        return message
    stem = Path(found[1]).name
    for mesh in spec.meshes:
        if mesh.file and Path(mesh.file).name == stem:
            name = mesh.name or Path(mesh.file).stem
            if "decoder" in message:
                return f"mesh {name!r}: {mesh.file} is of a kind that is not read; convert it to .stl or .obj"
            return f"mesh {name!r}: no file {mesh.file} (looked for {found[1]}); put it there, or correct its path"
    return message


def _urdf(path: Path) -> ElementTree.Element | None:
    """The root of a URDF file; None for MJCF, and for what MuJoCo will complain about."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return None
    if root.tag != "robot":
        return None
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise UsageError(f"{path}: has xacro macros, which are not expanded; run xacro and load what it writes")
    for joint in root.iter("joint"):
        if (mimic := joint.find("mimic")) is not None:
            raise UsageError(
                f"{path}: joint {joint.get('name')!r} mimics {mimic.get('joint')!r}, which is not modelled: remove "
                "<mimic> and drive the joint by itself"
            )
    return root


def _find_meshes(spec: Any, path: Path) -> None:
    """Resolve package:// (a folder above the model that holds the package, or is it) and file:// addresses."""
    for mesh in spec.meshes:
        scheme, _, rest = mesh.file.partition("://")
        if scheme == "file":
            mesh.file = rest
        elif scheme == "package":
            package, _, inside = rest.partition("/")
            places = [
                place
                for folder in path.resolve().parents
                for place in (folder / rest, folder / inside)
                if place == folder / rest or folder.name == package
            ]
            mesh.file = next((str(place) for place in places if place.is_file()), mesh.file)


def _add_motors(spec: Any, robot: ElementTree.Element) -> None:
    """A motor for each joint that a transmission or ros2_control drives, or for every joint when the file has neither.

    Its control is the joint's force, as in ROS's effort interface; the joint's effort limit holds.
    """
    driven = {}
    for transmission in robot.iter("transmission"):
        actuator = transmission.find("actuator")
        for joint in transmission.findall("joint"):
            name = joint.get("name")
            driven[name] = name if actuator is None else actuator.get("name", name)
    for control in robot.iter("ros2_control"):
        for joint in control.findall("joint"):
            if joint.find("command_interface") is not None:
                driven.setdefault(joint.get("name"), joint.get("name"))
    one_way = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for joint in spec.joints:
        if joint.type in one_way and (not driven or joint.name in driven):
            name = driven.get(joint.name, joint.name)
            spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
