"""Parsing and compilation of model files by MuJoCo."""

import re
from pathlib import Path
from typing import Any

import mujoco

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.urdf import complete_urdf, read_urdf


def compile_model(path: Path) -> tuple[Any, bool]:
    """The compiled model (mujoco.MjModel), and whether the file is URDF.

    Raises UsageError, in one line, if a file is missing or invalid.
    """
    if not path.is_file():
        raise UsageError(f"no such model file: {path}")
    robot = read_urdf(path)
    spec = None
    if hasattr(mujoco, "mj_clearCache"):  # its cache does not notice a mesh that changes within a second
        mujoco.mj_clearCache(mujoco.mj_getCache())
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if robot is not None:
            complete_urdf(spec, robot, path)
        return spec.compile(), robot is not None
    except UsageError:
        raise
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
