"""Additions to the URDF reader of MuJoCo: files of meshes, motors, and repair of masses that no rigid body has."""

import os
import warnings
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene.geometry.collada import read_collada
from gelflow.sim.scene.geometry.mesh import TriangleMesh

_PACKED = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])  # rows and columns of xx, yy, zz, xy, xz, yz
_ROUNDING = 1e-9  # relative violation of the triangle inequality that printed decimals of a thin body can cause
_MARGIN = 1e-12  # relative, so that MuJoCo's exact comparison holds after its own rounding
_THIN = 1e-6  # the same where a principal inertia is zero or negative: a joint about its axis must be able to move
_LEAST_MASS, _LEAST_INERTIA = 1e-9, 1e-12  # [kg], [kg m²]: far below those of the bodies that such a link carries


def read_urdf(path: Path) -> ElementTree.Element | None:
    """The root element of a URDF file; None for MJCF and for invalid XML, which MuJoCo reports.

    Raises UsageError, in one line, if the file has macros or an invalid <mimic>.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError):
        return None
    if root.tag.rpartition("}")[2] != "robot":
        return None
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise UsageError(f"{path}: has xacro macros, which are not expanded; run xacro and load its output")
    for element in root.iter():  # a namespace is a part of the tags here; MuJoCo does not know namespaces
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    _mimic_joints(root, path)  # its errors are clearer than those of MuJoCo's parser
    _check_floating(root, path)
    return root


def _check_floating(robot: ElementTree.Element, path: Path) -> None:
    """Raises UsageError for a floating joint below another link than the world; MuJoCo has free joints only there."""
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        link = "" if parent is None else parent.get("link", "")
        if joint.get("type") == "floating" and link != "world":
            name = joint.get("name", "")
            raise UsageError(f"{path}: joint {name!r} is floating, so its parent must be called 'world', got {link!r}")


def parse_urdf(robot: ElementTree.Element, path: Path) -> Any:
    """The file as a mujoco.MjSpec, with mesh files resolved, inertia repaired and motors added."""
    if addresses := _rename_meshes(robot):
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
        spec.modelfiledir = str(path.parent)
    else:
        spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False  # keep the link frames: a pad may refer to them as sites
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE  # URDF has no densities
    for mesh in spec.meshes:
        mesh.file = _mesh_file(addresses.get(mesh.file, mesh.file), path)
        if Path(mesh.file).suffix.lower() == ".dae" and (path.parent / mesh.file).is_file():
            _insert_triangles(mesh, read_collada(path.parent / mesh.file))
    for body, moves in _links(spec.worldbody):
        if body.explicitinertial and np.isfinite(body.fullinertia).all():
            _repair_inertia(body, f"{path.name}: link {body.name!r}", moves=moves)
    _correct_ranges(spec, robot, path)
    mimics = _mimic_joints(robot, path)
    _couple(spec, mimics)
    _add_motors(spec, robot, path, without=mimics)
    return spec


def _rename_meshes(robot: ElementTree.Element) -> dict[str, str]:
    """Give meshes different names where only their folders differ; the addresses by the new names.

    MuJoCo names a mesh by its file, and would use the first of two files of one name for both.
    """
    renamed: dict[str, str] = {}
    taken: dict[str, str] = {}  # address by the name of the mesh
    for mesh in robot.iter("mesh"):
        address = mesh.get("filename", "")
        stem = Path(address).stem
        while taken.setdefault(stem, address) != address:
            stem += "_"
        if stem != Path(address).stem:
            name = stem + Path(address).suffix
            renamed[name] = address
            mesh.set("filename", name)
    return renamed


def compile_urdf(spec: Any, path: Path) -> Any:
    """Compile a completed URDF file (mujoco.MjSpec) to a mujoco.MjModel.

    Links without mass between two joints get the least mass that can be simulated, with a warning. Raises UsageError if
    one carries no mass either.
    """
    try:
        return spec.compile()
    except ValueError as error:
        if "mjMINVAL" not in str(error):
            raise
    spec.compiler.boundmass, spec.compiler.boundinertia = _LEAST_MASS, _LEAST_INERTIA
    model = spec.compile()
    bounded = (model.body_mass <= _LEAST_MASS) | (model.body_inertia.min(axis=1) <= _LEAST_INERTIA)
    moving = [i for i in np.flatnonzero(bounded) if model.body_dofnum[i] > 0]
    for i in moving:
        if model.body_subtreemass[i] <= _LEAST_MASS * model.nbody:
            raise UsageError(
                f"{path}: link {model.body(i).name!r} moves without any mass; give it an <inertial>, or the file "
                '<mujoco><compiler inertiafromgeom="true"/></mujoco> for 1000 kg/m³ in its collision geometry'
            )
    names = ", ".join(model.body(i).name for i in moving)
    warnings.warn(
        f"{path.name}: moving links without mass or without inertia: {names}; simulated with at least "
        f"{_LEAST_MASS:g} kg and {_LEAST_INERTIA:g} kg m²",
        stacklevel=2,
    )
    return model


def _mimic_joints(robot: ElementTree.Element, path: Path) -> dict[str, tuple[str, float, float]]:
    """For each joint with <mimic>: the joint that it follows, multiplier and offset. Raises UsageError."""
    names = {joint.get("name", "") for joint in robot.findall("joint")}
    mimics = {}
    for joint in robot.findall("joint"):
        if (mimic := joint.find("mimic")) is None:
            continue
        name, leader = joint.get("name", ""), mimic.get("joint", "")
        if leader not in names:
            raise UsageError(f"{path}: joint {name!r} mimics {leader!r}, which the file does not have")
        try:
            mimics[name] = leader, float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
        except ValueError:
            raise UsageError(f"{path}: joint {name!r}: multiplier and offset of <mimic> must be numbers") from None
    return mimics


def _correct_ranges(spec: Any, robot: ElementTree.Element, path: Path) -> None:
    """Remove the ranges of continuous joints, which have none. Raises UsageError for a range without extent.

    MuJoCo limits a continuous joint with bounds, and does not limit a joint whose bounds are equal or interchanged.
    """
    for joint in robot.findall("joint"):
        name, kind, limit = joint.get("name", ""), joint.get("type"), joint.find("limit")
        if limit is None or kind not in ("continuous", "revolute", "prismatic"):
            continue
        if kind == "continuous":
            for found in spec.joints:
                if found.name == name:
                    found.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            continue
        lower, upper, effort = (float(limit.get(key, 0)) for key in ("lower", "upper", "effort"))
        if not lower <= upper or lower == upper != 0:
            raise UsageError(f"{path}: joint {name!r}: lower limit {lower:g} must be below upper limit {upper:g}")
        if not effort >= 0:
            raise UsageError(f"{path}: joint {name!r}: the effort of <limit> must not be negative, got {effort:g}")


def _couple(spec: Any, mimics: dict[str, tuple[str, float, float]]) -> None:
    """Add the joint equality of each <mimic>."""
    known = {equality.name1 for equality in spec.equalities}  # newer versions of MuJoCo read <mimic> themselves
    for name, (leader, multiplier, offset) in mimics.items():
        if name in known:
            continue
        data = np.zeros(mujoco.mjNEQDATA)
        data[:2] = offset, multiplier
        spec.add_equality(
            name=f"{name} mimics {leader}",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            name2=leader,
            data=data,
        )


def _insert_triangles(mesh: Any, triangles: TriangleMesh) -> None:
    """Replace the file of a mesh (mujoco.MjsMesh) by triangles."""
    mesh.name, mesh.file = mesh.name or Path(mesh.file).stem, ""
    mesh.uservert, mesh.userface = triangles.vertices.reshape(-1), triangles.faces.reshape(-1)


def _mesh_file(address: str, path: Path) -> str:
    """The file of a mesh, or the address itself if there is none.

    A relative address is searched in the folder of the model and in those above it, a package:// address also in the
    folders of ROS_PACKAGE_PATH.
    """
    scheme, separator, rest = address.partition("://")
    if scheme == "file":
        return rest
    if scheme != "package" and (separator or (path.parent / address).is_file()):
        return address  # as MuJoCo reads it
    package, _, inside = rest.partition("/") if separator else ("", "", address)
    return next((str(file) for file in _candidates(package, inside, path) if file.is_file()), address)


def _candidates(package: str, inside: str, path: Path) -> Iterator[Path]:
    """Where a mesh of a package may be, best first; an empty package stands for a relative address."""
    above = path.resolve().parents
    if package:
        ros = [Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
        for folder in (*above, *ros):
            yield folder / package / inside
            if folder.name == package:
                yield folder / inside
    for folder in above:  # also a package whose folder has another name, such as that of a branch
        yield folder / inside


def _links(body: Any, moves: bool = False) -> Iterator[tuple[Any, bool]]:
    """A body (mujoco.MjsBody) and those below it, each with whether there is a joint between it and the world."""
    moves |= bool(body.joints)
    yield body, moves
    for child in body.bodies:
        yield from _links(child, moves)


def _repair_inertia(body: Any, owner: str, *, moves: bool) -> None:
    """Give a link (mujoco.MjsBody) the nearest inertia that a rigid body can have, with a warning if it `moves`.

    The second moments of the mass, Σ = tr(I)/2 E − I, are not negative in a rigid body; negative ones are set to a
    small value.
    """
    inertia = np.zeros((3, 3))
    inertia[_PACKED] = body.fullinertia
    inertia.T[_PACKED] = body.fullinertia
    principal, axes = np.linalg.eigh(inertia)
    if np.abs(principal).max() < mujoco.mjMINVAL:  # none: see compile_urdf
        body.fullinertia, body.inertia = np.full(6, np.nan), np.zeros(3)
        return
    if not principal[2] > 0:
        raise UsageError(f"{owner}: principal inertias must be positive, got {_text(principal)} kg m²")
    moments = principal.sum() / 2 - principal
    excess = -2 * float(moments.min())
    smallest = (_MARGIN if principal[0] > 0 else _THIN) * principal[2]
    if moments.min() >= smallest:
        return
    moments = moments.clip(min=smallest)
    repaired = moments.sum() - moments
    body.fullinertia = (axes @ np.diag(repaired) @ axes.T)[_PACKED]
    if excess <= _ROUNDING * principal[2] or not moves:
        return
    warnings.warn(
        f"{owner}: principal inertias {_text(principal)} kg m² break the triangle inequality by {excess:.3g} kg m² "
        f"({100 * excess / principal[2]:.2g} % of the largest); simulated with {_text(repaired)} kg m²",
        stacklevel=2,
    )


def _text(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _add_motors(spec: Any, robot: ElementTree.Element, path: Path, without: Container[str]) -> None:
    """Add a motor for each joint of a <transmission> or <ros2_control>, or for all joints if the file has neither.

    Joints of `without` follow others and have no motor of their own. The control is the joint force, as in the effort
    interface of ROS, within the effort limit of the joint. Raises UsageError for a joint that the file does not have.
    """
    driven = _driven_joints(robot)
    all_joints = robot.find(".//transmission") is None and robot.find(".//ros2_control") is None
    names = {joint.get("name", "") for joint in robot.findall("joint")}
    if unknown := sorted(driven.keys() - names):
        raise UsageError(f"{path}: a motor drives joint {unknown[0]!r}, which the file does not have")
    scalar_types = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for joint in spec.joints:
        if joint.type in scalar_types and joint.name not in without and (all_joints or joint.name in driven):
            name = driven.get(joint.name, joint.name)
            spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)


def _driven_joints(robot: ElementTree.Element) -> dict[str, str]:
    """Names of the actuators by joint. An actuator of several joints becomes one of each: "actuator/joint"."""
    pairs: dict[str, str] = {}
    for transmission in robot.iter("transmission"):
        joints = [joint.get("name", "") for joint in transmission.findall("joint")]
        actuators = [actuator.get("name", "") for actuator in transmission.findall("actuator")]
        if len(actuators) != len(joints):
            actuators = actuators[:1] * len(joints) or joints
        pairs.update({joint: name or joint for joint, name in zip(joints, actuators, strict=True)})
    for control in robot.iter("ros2_control"):
        for joint in control.findall("joint"):
            if joint.find("command_interface") is not None:
                pairs.setdefault(joint.get("name", ""), joint.get("name", ""))
    names = list(pairs.values())
    return {joint: name if names.count(name) == 1 else f"{name}/{joint}" for joint, name in pairs.items()}
