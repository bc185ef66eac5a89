"""Parsing and compilation of model files by MuJoCo, with package addresses and actuators of URDF added."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco

from gelflow.errors import UsageError


def compile_model(path: Path) -> tuple[Any, bool]:
    """The compiled model (mujoco.MjModel), and whether the file is URDF.

    Raises UsageError, in one line, if a file is missing or invalid.
    """
    if not path.is_file():
        raise UsageError(f"no such model file: {path}")
    robot = _urdf(path)
    spec = None
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if robot is not None:
            spec.compiler.fusestatic = False  # keep the link frames: a pad may refer to them as sites
            _find_meshes(spec, path)
            _add_motors(spec, robot)
        return spec.compile(), robot is not None
    except (ValueError, mujoco.FatalError) as error:
        raise UsageError(f"{path}: {_clarified(' '.join(str(error).split()), spec)}") from None


def element_names(model: Any, kind: str, count: int) -> list[str]:
    """Names of the elements of a kind ("body", "joint", …); an element without a name gets its kind and index."""
    names = [getattr(model, kind)(i).name for i in range(count)]
    taken = set(names)
    for i, name in enumerate(names):
        if not name:
            generated = f"{kind}{i}"
            while generated in taken:
                generated += "_"
            names[i] = generated
            taken.add(generated)
    return names


def _clarified(message: str, spec: Any) -> str:
    """MuJoCo's message, or a clearer one for a mesh that is missing or of an unsupported format."""
    match = re.search(r"(?:rror opening|decoder found for mesh) file '([^']*)'", message)
    if match is None or spec is None:
        return message
    file_name = Path(match[1]).name
    for mesh in spec.meshes:
        if mesh.file and Path(mesh.file).name == file_name:
            name = mesh.name or Path(mesh.file).stem
            if "decoder" in message:
                return f"mesh {name!r}: {mesh.file} has an unsupported format; convert it to .stl or .obj"
            return f"mesh {name!r}: no file {mesh.file} (searched at {match[1]}); add the file or correct its path"
    return message


def _urdf(path: Path) -> ElementTree.Element | None:
    """The root element of a URDF file; None for MJCF and for invalid XML, which MuJoCo reports."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return None
    if root.tag != "robot":
        return None
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise UsageError(f"{path}: has xacro macros, which are not expanded; run xacro and load its output")
    for joint in root.iter("joint"):
        if (mimic := joint.find("mimic")) is not None:
            raise UsageError(
                f"{path}: joint {joint.get('name')!r} mimics {mimic.get('joint')!r}, which is not supported: remove "
                "<mimic> and drive the joint by its own actuator"
            )
    return root


def _find_meshes(spec: Any, path: Path) -> None:
    """Resolve file:// and package:// addresses of meshes; packages are searched in the folders above the model."""
    for mesh in spec.meshes:
        scheme, _, rest = mesh.file.partition("://")
        if scheme == "file":
            mesh.file = rest
        elif scheme == "package":
            package, _, inside = rest.partition("/")
            candidates = [
                candidate
                for folder in path.resolve().parents
                for candidate in (folder / rest, folder / inside)
                if candidate == folder / rest or folder.name == package
            ]
            mesh.file = next((str(file) for file in candidates if file.is_file()), mesh.file)


def _add_motors(spec: Any, robot: ElementTree.Element) -> None:
    """Add a motor for each joint of a <transmission> or <ros2_control>, or for all joints if the file has neither.

    The control is the joint force, as in the effort interface of ROS, within the effort limit of the joint.
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
    scalar_types = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for joint in spec.joints:
        if joint.type in scalar_types and (not driven or joint.name in driven):
            name = driven.get(joint.name, joint.name)
            spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
