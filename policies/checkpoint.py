"""Checkpoints: the tensors of a policy with its task, architecture and training settings.

A checkpoint is one safetensors file with a JSON header. Reading it executes no code of the file and needs no torch.
"""

import contextlib
import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from gelflow import __version__
from gelflow.errors import UsageError
from gelflow.policies.networks.base import Architecture, Network
from gelflow.policies.networks.flow_map_policy import FlowMapNetwork, NetworkPolicy
from gelflow.policies.networks.registry import architecture_from_json
from gelflow.task import INSERTION, InsertionTask, TaskDescription

FORMAT = 1
MAX_BYTES = 2_000_000  # [bytes]
_SHOWN = 8  # longest list of a setting that a message shows
_HEADER_KEY = "gelflow"
_HEADER_DIGEST = "header_sha256"  # missing in checkpoints of earlier versions
_SHIPPED = Path(__file__).resolve().parent / "checkpoints"


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint file."""

    task: Mapping[str, Any]  # as from TaskDescription.to_json
    architecture: Architecture
    tensors: Mapping[str, NDArray[Any]]
    training: Mapping[str, Any]  # command, settings and validation results of the training
    versions: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""  # SHA-256 of the file


def default_checkpoint() -> Path:
    """Path of the insertion policy that is included in gelflow."""
    return _SHIPPED / "insertion.safetensors"


def shipped_checkpoints() -> list[Path]:
    """Paths of all policies that are included in gelflow, former ones included: recorded sessions name them."""
    return sorted(_SHIPPED.glob("*.safetensors"))


def save_checkpoint(
    path: Path,
    *,
    task: TaskDescription,
    architecture: Architecture,
    tensors: Mapping[str, NDArray[Any]],
    training: Mapping[str, Any],
) -> None:
    """Writes a checkpoint atomically.

    Raises UsageError when the tensors do not fit the architecture or the file would exceed 2 MB.
    """
    stored = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in tensors.items()}
    architecture.network(task, stored)
    header = {
        "format": FORMAT,
        "task": task.to_json(),
        "task_digest": task.digest(),
        "architecture": architecture.to_json(),
        "training": dict(training),
        "tensors_sha256": _fingerprint(stored),
        "versions": {"gelflow": __version__, "python": platform.python_version(), "numpy": np.__version__},
    }
    header = json.loads(json.dumps(header))  # as it is read
    header[_HEADER_DIGEST] = _header_fingerprint(header)
    data = safetensors.numpy.save(stored, metadata={_HEADER_KEY: json.dumps(header, sort_keys=True)})
    if len(data) > MAX_BYTES:
        raise UsageError(
            f"checkpoint would have {len(data)} bytes, more than {MAX_BYTES}; reduce the number of hidden units"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, data)


def replace_file(path: Path, data: bytes) -> None:
    """Writes a file as a whole: a process that is killed meanwhile leaves the previous file intact."""
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Reads a checkpoint.

    Raises UsageError when the file is missing, not a checkpoint, damaged, or has a newer format.
    """
    path = Path(path)
    data = _read(path)
    header = _read_header(path, data)
    try:
        stored = header.pop(_HEADER_DIGEST, None)
        if stored is not None and stored != _header_fingerprint(header):
            raise ValueError("checksum mismatch of the header")
        tensors = safetensors.numpy.load(data)
        if header["tensors_sha256"] != _fingerprint(tensors):
            raise ValueError("checksum mismatch of the tensors")
        if types := {str(values.dtype) for values in tensors.values()} - {"float32"}:
            raise ValueError(f"tensors of type {', '.join(sorted(types))}")
        return Checkpoint(
            task=dict(header["task"]),
            architecture=architecture_from_json(header["architecture"]),
            tensors=tensors,
            training=dict(header["training"]),
            versions=dict(header["versions"]),
            digest=hashlib.sha256(data).hexdigest(),
        )
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} is a damaged checkpoint ({_one_line(error)}); copy it or train it again") from error


def load_policy(path: str | Path, *, task: InsertionTask = INSERTION) -> NetworkPolicy:
    """Loads the policy of a checkpoint for the insertion `task`, for one part at a time. Raises as `load_network`."""
    network = load_network(path, task=task)
    if not isinstance(network, FlowMapNetwork):
        raise UsageError(f"{path}: network {network.architecture.kind} does not correct the poses of an insertion")
    return NetworkPolicy(network)


def load_network(path: str | Path, *, task: TaskDescription) -> Network:
    """Loads the network of a checkpoint for `task`; `Network.batch_policy` acts in its environments.

    Raises UsageError as `load_checkpoint` does, and when the checkpoint was trained for another task description; the
    message lists the fields that differ.
    """
    checkpoint = load_checkpoint(path)
    if different := task_differences(checkpoint.task, task.to_json()):
        raise UsageError(
            f"{path} was trained for another task: {different}; train a policy for this task, or use that task"
        )
    try:
        return checkpoint.architecture.network(task, checkpoint.tensors)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from error


def task_differences(trained: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The fields in which two task descriptions differ, with both values; empty if they are equal.

    Fields of descriptions within them, such as that of the part, are compared one by one. Only the names of the tasks
    are given where these differ.
    """
    for name in ("name", "task.name"):
        if name in trained and trained[name] != wanted.get(name):
            trained, wanted = ({name: given.get(name)} for given in (trained, wanted))
    return ", ".join(_differences(trained, wanted))


def _differences(trained: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterator[str]:
    for name in [*wanted, *(name for name in trained if name not in wanted)]:
        old, new = trained.get(name, "absent"), wanted.get(name, "absent")
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from (f"{name}.{text}" for text in _differences(old, new))
        elif old != new:
            yield f"{name} {_short(old)} (here {_short(new)})"


def _short(value: Any) -> str:
    if isinstance(value, Mapping) and "name" in value:
        return repr(value["name"])
    return f"{len(value)} values" if isinstance(value, list) and len(value) > _SHOWN else repr(value)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise UsageError(f"no checkpoint at {path}; create one with: gelflow train") from error
    except OSError as error:
        raise UsageError(f"cannot read checkpoint {path}: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise UsageError(f"{path} exceeds {MAX_BYTES} bytes, the limit of a gelflow checkpoint")
    return data


def _read_header(path: Path, data: bytes) -> dict[str, Any]:
    """The JSON header: a safetensors file starts with 8 bytes of header length, followed by the header."""
    message = f"{path} is not a gelflow checkpoint (expected a safetensors file with a {_HEADER_KEY!r} header)"
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or not 2 <= length <= MAX_BYTES or data[8:9] != b"{":
        raise UsageError(message)
    if len(data) < 8 + length:
        raise UsageError(
            f"{path} is a damaged checkpoint (truncated after {len(data)} bytes); copy it or train it again"
        )
    try:
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_HEADER_KEY])
        version = int(header["format"])
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(message) from error
    if version > FORMAT:
        raise UsageError(f"{path} has format {version}; this gelflow reads format {FORMAT}: update gelflow")
    return dict(header)


def _header_fingerprint(header: Mapping[str, Any]) -> str:
    """SHA-256 of the header in its canonical form, without the field of the fingerprint."""
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()


def _fingerprint(tensors: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 over names and bytes; safetensors itself has no checksum."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode() + tensors[name].tobytes())
    return digest.hexdigest()


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
