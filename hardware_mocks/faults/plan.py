"""Fault plans: which device fails in which way, from which time or event on, and for how long."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from gelflow.errors import UsageError

DEVICES = ("left_camera", "right_camera", "cameras", "arm", "gripper", "world")
EVENTS = ("gripped", "approach", "descent", "lowering", "released", "attempt")
DIRECTIONS = ("in", "out", "both")  # as seen from the device: commands, replies
_CAMERAS = DEVICES[:3]
_LINKS = (*_CAMERAS, "arm", "gripper")
_TWO_WAY = ("arm", "gripper")


@dataclass(frozen=True)
class Kind:
    """One kind of fault: the devices that can have it, and its parameters with their defaults and limits."""

    devices: tuple[str, ...]
    parameters: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)  # default, minimum, maximum
    message: bool = False  # a fault of messages, which has a direction on the arm and the gripper
    momentary: bool = False  # has no duration


_SHARE = (0.5, 0.0, 1.0)
KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "drop": Kind(_LINKS, {"share": _SHARE}, message=True),
        "delay": Kind(_LINKS, {"share": (1.0, 0.0, 1.0), "delay": (0.2, 0.0, 60.0)}, message=True),
        "duplicate": Kind(_LINKS, {"share": _SHARE}, message=True),
        "reorder": Kind(_LINKS, {"share": _SHARE}, message=True),
        "corrupt": Kind(_LINKS, {"share": _SHARE, "count": (4, 1, 1e6)}, message=True),
        "split": Kind(_LINKS, {"share": (1.0, 0.0, 1.0), "delay": (0.02, 0.0, 60.0)}, message=True),
        "garbage": Kind(_LINKS, {"share": _SHARE, "count": (200, 1, 1e6)}, message=True),
        "disconnect": Kind(_LINKS),
        "stall": Kind(_LINKS),
        "freeze": Kind(_LINKS, {"loop": (1, 1, 32)}),
        "blacken": Kind(_CAMERAS),
        "rescale": Kind(_CAMERAS, {"zoom": (1.15, 0.2, 5.0)}),
        "emergency_stop": Kind(("arm", "gripper")),
        "motors_off": Kind(("arm",)),
        "rapid_stop": Kind(("arm",)),
        "restart": Kind(("arm",), momentary=True),
        "lose_part": Kind(("gripper",), momentary=True),
        "stiff_gel": Kind(("world",), {"factor": (5.0, 0.05, 50.0)}),
        "slip": Kind(("world",), {"factor": (0.2, 0.001, 1.0)}),
    }
)


def parameters_of(kind: str, device: str) -> tuple[str, ...]:
    """Names of the parameters of a kind of fault on a device."""
    return tuple(name for name in KINDS[kind].parameters if name != "loop" or device in _CAMERAS)


@dataclass(frozen=True)
class Fault:
    """One fault. It begins at a time, at an event, or at random times. Times are robot time [s], heights [m].

    Raises UsageError for combinations that do not exist.
    """

    device: str  # one of DEVICES
    kind: str  # one of KINDS
    at: float | None = None  # start, after the first command to gripper or arm
    event: str = ""  # start at this event, one of EVENTS, instead of a time
    rate: float = 0.0  # start at random times, this often per second, instead of a time
    seed: int = 0  # of all random numbers of this fault
    after: float = 0.0  # delay of the start after the event
    below: float | None = None  # height of the lower face for the events descent and lowering
    attempt: int = 1  # descent, lowering and attempt count from this attempt on
    duration: float = math.inf
    direction: str = "both"  # of the messages
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _choose("device", self.device, DEVICES)
        _choose("kind", self.kind, tuple(KINDS))
        kind = KINDS[self.kind]
        if self.device not in kind.devices:
            raise UsageError(f"kind {self.kind} exists for {', '.join(kind.devices)}, not for {self.device}")
        if (self.at is not None) + bool(self.event) + (self.rate > 0) != 1:
            raise UsageError(f"the fault {self.kind} needs exactly one of at, event and random")
        if self.event:
            _choose("event", self.event, EVENTS)
        if self.below is not None and self.event not in ("descent", "lowering"):
            raise UsageError("below belongs to the events descent and lowering")
        if self.attempt > 1 and self.event not in ("descent", "lowering", "attempt"):
            raise UsageError("attempt belongs to the events descent, lowering and attempt")
        if self.after > 0 and not self.event:
            raise UsageError("after belongs to events")
        if not (self.duration > 0 and self.after >= 0 and self.attempt >= 1 and (self.at is None or self.at >= 0)):
            raise UsageError("duration must be above 0, at and after at least 0, attempt at least 1")
        _choose("direction", self.direction, DIRECTIONS)
        if self.direction != "both" and not (kind.message and self.device in _TWO_WAY):
            raise UsageError("direction belongs to the messages of arm and gripper")
        valid = parameters_of(self.kind, self.device)
        for name, value in self.parameters.items():
            if name not in valid:
                known = ", ".join(valid) or "none"
                raise UsageError(f"{self.kind} of {self.device} has no parameter {name!r}; its parameters: {known}")
            _, low, high = kind.parameters[name]
            if not low <= value <= high:
                raise UsageError(f"{name} of kind {self.kind} must be {low:g} to {high:g}, got {value}")

    @property
    def values(self) -> dict[str, Any]:
        """All parameters of the kind; for messages also the seed."""
        kind = KINDS[self.kind]
        values: dict[str, Any] = {name: kind.parameters[name][0] for name in parameters_of(self.kind, self.device)}
        values |= self.parameters
        for name in {"count", "loop"} & set(values):
            values[name] = int(values[name])
        return values | ({"seed": self.seed} if kind.message else {})

    def __str__(self) -> str:
        when = f"at {self.at:g} s" if self.at is not None else self.event or f"{self.rate:g} times per second"
        when += f" below {1e3 * self.below:g} mm" if self.below is not None else ""
        when += f" of attempt {self.attempt}" if self.attempt > 1 else ""
        when += f" + {self.after:g} s" if self.after else ""
        lasting = "" if math.isinf(self.duration) or KINDS[self.kind].momentary else f" for {self.duration:g} s"
        direction = f" {self.direction}" if self.direction != "both" else ""
        parameters = "".join(f", {name} {value:g}" for name, value in self.parameters.items())
        return f"{self.device}{direction}: {self.kind} {when}{lasting}{parameters}"


@dataclass(frozen=True)
class FaultPlan:
    """The faults of one run."""

    faults: tuple[Fault, ...] = ()

    def __str__(self) -> str:
        return "; ".join(map(str, self.faults)) or "no fault"


def _choose(what: str, value: str, names: tuple[str, ...]) -> None:
    if value not in names:
        raise UsageError(f"{what} is {value!r}; it must be one of {', '.join(names)}")
