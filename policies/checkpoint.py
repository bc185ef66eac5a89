"""Checkpoints: the tensors of a policy, and as JSON the task they were trained for and how they were made.

One safetensors file: tensors and JSON header in one, read without running any code of the file, without torch.
"""

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from gelflow import __version__
from gelflow.errors import UsageError
from gelflow.policies.networks import Architecture, Network, NetworkPolicy
from gelflow.task import INSERTION, InsertionTask

FORMAT = 1
LARGEST = 2_000_000  # [bytes]
_KEY = "gelflow"


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint's file holds."""

    task: Mapping[str, Any]  # InsertionTask.to_json
    architecture: Architecture
    tensors: Mapping[str, NDArray[Any]]
    training: Mapping[str, Any]  # the command that made it, its settings and figures
    versions: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""  # SHA-256 of the file, for recordings


def default_checkpoint() -> Path:
    """The insertion policy that comes with gelflow."""
    return Path(__file__).resolve().parent / "checkpoints" / "insertion.safetensors"


def save_checkpoint(
    path: Path,
    *,
    task: InsertionTask,
    architecture: Architecture,
    tensors: Mapping[str, NDArray[Any]],
    training: Mapping[str, Any],
) -> None:
    """Write a checkpoint; the file appears whole or not at all.

    Raises UsageError when the tensors do not fit the architecture, or the file would be over 2 MB.
    """
    stored = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in tensors.items()}
    Network(architecture, task, stored)
    header = {
        "format": FORMAT,
        "task": task.to_json(),
        "task_digest": task.digest(),
        "architecture": architecture.to_json(),
        "training": dict(training),
        "tensors_sha256": _fingerprint(stored),
        "versions": {"gelflow": __version__, "python": platform.python_version(), "numpy": np.__version__},
    }
    data = safetensors.numpy.save(stored, metadata={_KEY: json.dumps(header, sort_keys=True)})
    if len(data) > LARGEST:
        raise UsageError(f"checkpoint would have {len(data)} bytes, more than {LARGEST}; take fewer hidden units")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(data)
    partial.replace(path)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises UsageError in one line when the file is missing, is no checkpoint, is damaged, or is of a newer format.
    """
    data = _read(path)
    header = _header(path, data)
    try:
        tensors = safetensors.numpy.load(data)
        if header["tensors_sha256"] != _fingerprint(tensors):
            raise ValueError("the tensors are not those that were saved")
        return Checkpoint(
            task=dict(header["task"]),
            architecture=Architecture.from_json(header["architecture"]),
            tensors=tensors,
            training=dict(header["training"]),
            versions=dict(header["versions"]),
            digest=hashlib.sha256(data).hexdigest(),
        )
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is a damaged checkpoint ({_line(error)}); copy or train it again") from error


def load_policy(path: str | Path, *, task: InsertionTask = INSERTION) -> NetworkPolicy:
    """The policy of a checkpoint, ready to act under `task`.

    Raises UsageError as `load` does, and when the checkpoint was trained under another task description (the
    message names the fields that differ).
    """
    path = Path(path)
    checkpoint = load_checkpoint(path)
    if different := task_differences(checkpoint.task, task.to_json()):
        raise UsageError(f"{path} was trained for another task: {different}; train for this one, or run that one")
    try:
        return NetworkPolicy(Network(checkpoint.architecture, task, checkpoint.tensors))
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error


def task_differences(trained: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The fields in which two task descriptions differ, with both values; empty when they are equal."""
    absent = "absent"
    names = [*wanted, *(name for name in trained if name not in wanted)]
    pairs = [(name, trained.get(name, absent), wanted.get(name, absent)) for name in names]
    return ", ".join(f"{name} {old!r} (here {new!r})" for name, old, new in pairs if old != new)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except FileNotFoundError as error:
        raise UsageError(f"no checkpoint at {path}; make one with: gelflow train insertion --out DIR") from error
    except OSError as error:
        raise UsageError(f"cannot read checkpoint {path}: {error.strerror}") from error
    if len(data) > LARGEST:
        raise UsageError(f"{path} is over {LARGEST} bytes: larger than any checkpoint of gelflow")
    return data


def _header(path: Path, data: bytes) -> dict[str, Any]:
    """The checkpoint's JSON: from the 8 bytes of length and the JSON header that open a safetensors file."""
    foreign = f"{path} is no checkpoint of gelflow (expected a safetensors file with a {_KEY!r} header)"
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or not 2 <= length <= LARGEST or data[8:9] != b"{":
        raise UsageError(foreign)
    if len(data) < 8 + length:
        raise UsageError(f"{path} is a damaged checkpoint (cut off after {len(data)} bytes); copy or train it again")
    try:
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_KEY])
        version = int(header["format"])
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(foreign) from error
    if version > FORMAT:
        raise UsageError(f"{path} has format {version}; this gelflow reads format {FORMAT}: update gelflow")
    return dict(header)


def _fingerprint(tensors: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over names and bytes: the format itself would not notice a flipped bit."""
    whole = hashlib.sha256()
    for name in sorted(tensors):
        whole.update(name.encode() + tensors[name].tobytes())
    return whole.hexdigest()


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
