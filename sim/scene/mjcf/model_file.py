"""Parsing and compilation of model files by MuJoCo."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.urdf import compile_urdf, parse_urdf, read_urdf

_COMPILING = threading.Lock()


@dataclass(frozen=True)
class CompiledModel:
    """A model file as MuJoCo compiled it. Each mocap body of the file has a free joint with the name of the body."""

    model: Any  # mujoco.MjModel
    urdf: bool
    q0: NDArray[np.float64]  # initial positions: the keyframe "start", else "home", else those of the file
    controls: NDArray[np.float64] | None  # of that keyframe; None where it sets none, which for MuJoCo are zeros
    mocap: tuple[str, ...]  # names of the mocap bodies


def compile_model(path: Path) -> CompiledModel:
    """Parse and compile an MJCF or URDF file.

    Raises UsageError, in one line, if a file is missing or invalid.
    """
    if not path.is_file():
        raise UsageError(f"no such model file: {path}")
    robot = read_urdf(path)
    spec = None
    try:
        with _no_log_file():
            if hasattr(mujoco, "mj_clearCache"):  # its cache does not notice a mesh that changes within a second
                mujoco.mj_clearCache(mujoco.mj_getCache())
            if robot is None:
                spec = mujoco.MjSpec.from_file(str(path))
                return _compiled(spec, spec.compile(), path, urdf=False)
            spec = parse_urdf(robot, path)
            return _compiled(spec, compile_urdf(spec, path), path, urdf=True)
    except UsageError:
        raise
    except (ValueError, mujoco.FatalError) as error:
        raise UsageError(f"{path}: {_clarified(' '.join(str(error).split()), spec)}") from None


@contextmanager
def _no_log_file() -> Iterator[None]:
    """MuJoCo writes its warnings into MUJOCO_LOG.TXT of the working directory, in addition to Python's warnings.

    Its handler of warnings and its cache belong to the process, so one thread at a time compiles.
    """
    with _COMPILING:
        handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(handler or (lambda _: None))
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(handler)


def _compiled(spec: Any, model: Any, path: Path, *, urdf: bool) -> CompiledModel:
    keys = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name) for name in ("start", "home"))
    key = next((k for k in keys if k >= 0), None)
    controls = None if key is None or not model.key_ctrl[key].any() else np.array(model.key_ctrl[key])
    if model.nmocap == 0:
        return CompiledModel(model, urdf, np.array(model.qpos0 if key is None else model.key_qpos[key]), controls, ())
    names = element_names(model, "body", model.nbody)
    mocap = [body for body in spec.bodies if body.mocap]
    joints = {model.joint(j).name for j in range(model.njnt)}
    if taken := [names[body.id] for body in mocap if names[body.id] in joints]:
        raise UsageError(
            f"{path}: mocap body {taken[0]!r} gets a free joint of its name, but the model has a joint "
            f"{taken[0]!r}; rename one of them"
        )
    if spec.compiler.settotalmass > 0:
        raise UsageError(f"{path}: settotalmass and mocap bodies exclude each other; give each body its mass")
    for keyframe in list(spec.keys):  # which have no positions of the new joints
        spec.delete(keyframe)
    for body in mocap:
        body.mocap = False
        body.add_freejoint(name=names[body.id])
        body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.0, 1.0], True  # without effect
        body.ipos, body.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    free = spec.compile()
    q0 = np.array(free.qpos0)
    if key is not None:
        other = np.ones(free.nq, bool)
        for body in mocap:
            pose = slice(q := free.jnt_qposadr[free.body_jntadr[body.id]], q + 7)
            which = model.body_mocapid[body.id]
            q0[pose] = [*model.key_mpos[key].reshape(-1, 3)[which], *model.key_mquat[key].reshape(-1, 4)[which]]
            other[pose] = False
        q0[other] = model.key_qpos[key]
    return CompiledModel(free, urdf, q0, controls, tuple(names[body.id] for body in mocap))


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
    """MuJoCo's message, or a clearer one for a file of an unsupported format and for a mesh that is missing."""
    if match := re.search(r"find decoder for resource '([^']*)'", message):
        return f"{Path(match[1]).name} must have the suffix .xml (MJCF) or .urdf"
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
