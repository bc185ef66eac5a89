"""Contents of a session: the decision record, the description, and conversion to and from plain JSON data."""

import dataclasses
import datetime
import hashlib
import json
import math
import platform
import re
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from gelflow import __version__
from gelflow.errors import PeerError, UsageError
from gelflow.observation import FlowMap, Unit
from gelflow.task import InsertionTask

FORMAT = 1
SENSORS = ("left", "right")  # topic names of sensor 0 and 1
TRACKER_VERSION = "6"  # increases with each change of what the marker tracker measures
VERSIONED_PACKAGES = ("numpy", "scipy", "torch", "opencv-contrib-python-headless", "mcap", "protobuf")
_NUMBERS = re.compile(r"\[(\n[-+.,\deE\s]+)\]")  # a list of numbers in indented JSON
Record = TypeVar("Record")


def to_plain(value: Any) -> Any:
    """`value` as plain data for strict JSON; numbers are restored bit for bit.

    NaN and the infinities become the strings "NaN", "Infinity" and "-Infinity", as in protobuf's JSON mapping, so that
    an invalid measurement does not make the file unreadable. Raises UsageError for unsupported types.
    """
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, np.generic):
        return to_plain(value.item())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_plain({field.name: getattr(value, field.name) for field in dataclasses.fields(value)})
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, Path):
        return str(value)
    raise UsageError(f"a record cannot contain a {type(value).__name__}, only numbers, text, lists, tables and arrays")


def to_json(value: Any) -> bytes:
    """`value` as UTF-8 JSON. Raises UsageError for unsupported types."""
    return json.dumps(to_plain(value), allow_nan=False, separators=(",", ":")).encode()


def readable_json(value: Any) -> str:
    """`value` as indented JSON for files that people open, with lists of numbers on one line."""
    text = json.dumps(to_plain(value), allow_nan=False, indent=2)
    return _NUMBERS.sub(lambda found: "[" + " ".join(found[1].split()) + "]", text) + "\n"


def from_plain(kind: type[Record], data: Any, *, what: str) -> Record:
    """A dataclass from the result of `to_plain`; nested dataclasses and arrays are restored, lists become tuples.

    Raises UsageError when `data` does not match `kind`, for example because another version wrote it. `what` names
    the data in the message.
    """
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(data, Mapping) or set(data) - names:
        extra = f"unknown keys {sorted(set(data) - names)}" if isinstance(data, Mapping) else f"{data!r}"
        known = ", ".join(sorted(names))
        raise UsageError(f"{what}: expected the keys {known}, got {extra}; was it written by another version?")
    required = {f.name for f in dataclasses.fields(kind) if _is_required(f)}  # type: ignore[arg-type]
    if missing := sorted(required - set(data)):
        raise UsageError(f"{what}: {', '.join(missing)} missing; was it written by another program?")
    fields = typing.get_type_hints(kind)
    try:
        return kind(**{key: _field(fields[key], value, f"{what}, {key}") for key, value in data.items()})
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what}: {error}") from error


def _is_required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def described(kind: type[Record], description: Mapping[str, Any], key: str, *, what: str) -> list[Record]:
    """The dataclasses of a list in the description of a session.

    Raises KeyError without the list, UsageError as `from_plain`.
    """
    listed = description[key]
    if not isinstance(listed, Sequence) or isinstance(listed, str):
        raise UsageError(f"the session's description: {key} must be a list, got {listed!r}")
    return [from_plain(kind, one, what=what) for one in listed]


def _field(wanted: Any, value: Any, what: str) -> Any:
    if typing.get_origin(wanted) is np.ndarray:
        return np.asarray(value)
    for kind in (wanted, *typing.get_args(wanted)):
        if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
            return from_plain(kind, value, what=what)
    return _tuples(value)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


@dataclass(frozen=True)
class Decision:
    """One decision of the policy, with all data that a replay needs to recompute it from the recorded images.

    For each sensor a new tracker starts on the first image of `tracked` and then tracks the others in order;
    `reference` and `frames` select the tactile frames of the observation.

    Two names are keys of the file format and differ from the terms elsewhere: `action` is the correction of the policy,
    and `correction` is the pose that results from it.
    """

    insertion: int  # counts insertions from 0; the policy is reset when it changes
    attempt: int  # counts attempts of this insertion from 0
    tracked: tuple[tuple[int, ...], ...]  # per sensor: sequence numbers of all images tracked, in order
    reference: tuple[int, ...]  # per sensor: the image of the reference frame
    frames: tuple[tuple[int, ...], ...]  # per frame of the observation, per sensor: its image
    flow: NDArray[np.float32]  # the flow map, shape (frames * sensors * 2, rows, cols)
    divisor: float  # of the flow map, in `unit`
    unit: str
    action: NDArray[np.float64]  # the policy's correction: dx [m], dy [m], dyaw [rad] in the gripper's frame
    correction: NDArray[np.float64]  # the corrected gripper pose: x [m], y [m], yaw [rad] in the base frame
    depths: tuple[float, ...] = ()  # depth of the reference and of each frame below the attempt's start [m]

    def __post_init__(self) -> None:
        sensors = len(self.tracked)
        for name, images in [("reference", self.reference), *(("frames", frame) for frame in self.frames)]:
            if len(images) != sensors:
                raise UsageError(f"decision: {name} has {len(images)} images, but {sensors} sensors were tracked")
            for sensor, sequence in enumerate(images):
                if sequence not in self.tracked[sensor]:
                    raise UsageError(f"decision: image {sequence} of sensor {sensor} in {name} was never tracked")
        if not self.frames:
            raise UsageError("decision: it needs at least one frame in addition to the reference")

    @classmethod
    def of(cls, observation: FlowMap, **values: Any) -> "Decision":
        """A decision for `observation`; `values` are the other fields."""
        return cls(flow=observation.image, divisor=observation.divisor, unit=observation.unit, **values)

    @property
    def observation(self) -> FlowMap:
        """The recorded flow map; which of its values were interpolated is not recorded."""
        channels, rows, cols = self.flow.shape
        return FlowMap(
            self.flow, self.divisor, cast(Unit, self.unit), np.zeros((channels // 2, rows, cols), dtype=bool)
        )

    def to_json(self) -> dict[str, Any]:
        """As plain data, for `SessionRecorder.decision`."""
        return {**to_plain(self), "flow": to_plain(self.flow.reshape(-1)), "flow_shape": list(self.flow.shape)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Decision":
        """Inverse of `to_json`. Raises PeerError when the record is incomplete."""
        try:
            flow = np.array([float(v) for v in data["flow"]], dtype=np.float32).reshape(data["flow_shape"])
            return cls(
                insertion=int(data["insertion"]),
                attempt=int(data["attempt"]),
                tracked=tuple(tuple(map(int, images)) for images in data["tracked"]),
                reference=tuple(map(int, data["reference"])),
                frames=tuple(tuple(map(int, images)) for images in data["frames"]),
                flow=flow,
                divisor=float(data["divisor"]),
                unit=str(data["unit"]),
                action=np.array([float(v) for v in data["action"]]),
                correction=np.array([float(v) for v in data["correction"]]),
                depths=tuple(float(v) for v in data.get("depths", ())),
            )
        except (KeyError, TypeError, ValueError) as error:
            cause = f"lacks {error}" if isinstance(error, KeyError) else str(error)
            raise PeerError(f"decision record {cause}; expected the fields that Decision.to_json writes") from error


def file_digest(path: str | Path) -> str:
    """SHA-256 of a file, in hex; identifies the checkpoint of a session. Raises UsageError if unreadable."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}; name an existing file") from error


def software_versions() -> dict[str, str]:
    """Versions of tracker and packages that affect the numbers of a replay, and the machine type."""
    versions = {"gelflow": __version__, "tracker": TRACKER_VERSION}
    versions |= {"python": platform.python_version(), "machine": platform.machine()}
    for package in VERSIONED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions | _blas()


def _blas() -> dict[str, str]:
    """The matrix library of NumPy and the processor that it computes for: another one rounds differently."""
    from threadpoolctl import threadpool_info

    found = [one for one in threadpool_info() if one["user_api"] == "blas"]
    names = {f"{one['internal_api']} {one.get('architecture', '')}".strip() for one in found}
    return {"blas": ", ".join(sorted(names))}


def describe_session(
    *,
    task: InsertionTask,
    trackers: Sequence[Any],
    mounts: Sequence[Any],
    checkpoint: str | Path | None = None,
    lab: Any = None,
    **more: Any,
) -> dict[str, Any]:
    """The description of a session for `SessionRecorder.metadata`; contains all data that a replay needs.

    `trackers` and `mounts` are the tracker configuration and the camera mount of each sensor (dataclasses or plain
    data). `checkpoint` is the policy's file, stored as path and digest; `lab` is the lab configuration; further
    values (clock factor, seed) are stored as given. Raises UsageError when a sensor lacks a tracker or a mount.
    """
    if not len(trackers) == len(mounts) == task.sensors:
        raise UsageError(f"expected {task.sensors} trackers and mounts, got {len(trackers)} and {len(mounts)}")
    policy = None
    if checkpoint is not None:
        policy = {"path": str(Path(checkpoint).resolve()), "digest": file_digest(checkpoint)}
    described = {
        "format": FORMAT,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),  # robot time has no date
        "task": task.to_json(),
        "task_digest": task.digest(),
        "checkpoint": policy,
        "trackers": trackers,
        "mounts": mounts,
        "lab": {} if lab is None else lab,
        "versions": software_versions(),
        **more,
    }
    return dict(to_plain(described))
