"""Phases of a run: one table of what each phase allows, and the state machine that enforces it."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

from gelflow.errors import SafetyError

_ADVICE = "; inspect the robot, then start a new run"


def with_advice(text: str) -> str:
    """The reason of a stop with the advice for the operator, which is not appended a second time."""
    return text.removesuffix(_ADVICE) + _ADVICE


class Phase(StrEnum):
    """Phases of a run."""

    IDLE = "idle"
    PREFLIGHT = "preflight"
    LOAD = "load"
    APPROACH = "approach"
    DESCEND = "descend"
    LOWER = "lower"
    RETREAT = "retreat"
    CORRECT = "correct"
    RELEASE = "release"
    HOLD = "hold"
    LATCHED = "latched"


@dataclass(frozen=True)
class PhaseRule:
    """One row of the table: rights of a phase, and the phases that may follow it. `LATCHED` may follow every phase."""

    action: str
    moves: bool = False  # targets are accepted; a held part is moved only while both pads are observed
    on_contact: str = ""  # reaction to contact above the threshold; empty where nothing can touch
    following: tuple[Phase, ...] = ()


PHASES: Mapping[Phase, PhaseRule] = MappingProxyType(
    {
        Phase.IDLE: PhaseRule("no run, or between two parts", following=(Phase.PREFLIGHT, Phase.LOAD)),
        Phase.PREFLIGHT: PhaseRule("checks of all devices", following=(Phase.LOAD, Phase.IDLE)),
        Phase.LOAD: PhaseRule(
            "without a part to the hand-over; grasp; comparison of the pads before and after it",
            moves=True,
            following=(Phase.APPROACH, Phase.RETREAT),
        ),
        Phase.APPROACH: PhaseRule(
            "with the part down to the start height",
            moves=True,
            on_contact="hold, retreat; this height becomes that of the rim",
            following=(Phase.DESCEND, Phase.RETREAT),
        ),
        Phase.DESCEND: PhaseRule(
            "reference at rest, then the descent of an attempt",
            moves=True,
            on_contact="hold, observe",
            following=(Phase.LOWER, Phase.RETREAT),
        ),
        Phase.LOWER: PhaseRule(
            "into the hole",
            moves=True,
            on_contact="hold, observe; near the floor: release",
            following=(Phase.RELEASE, Phase.RETREAT),
        ),
        Phase.RETREAT: PhaseRule(
            "straight up",
            moves=True,
            on_contact="hold, end: the part is stuck",
            following=(Phase.CORRECT, Phase.RELEASE, Phase.IDLE),
        ),
        Phase.CORRECT: PhaseRule(
            "to the corrected pose",
            moves=True,
            on_contact="hold, retreat; this height becomes that of the rim",
            following=(Phase.DESCEND, Phase.RETREAT),
        ),
        Phase.RELEASE: PhaseRule("the fingers open; comparison of the pads", following=(Phase.RETREAT, Phase.IDLE)),
        Phase.HOLD: PhaseRule(
            "the reference is frozen while a pad is not readable, for at most stale_frame",
            following=(Phase.APPROACH, Phase.DESCEND, Phase.LOWER, Phase.RETREAT, Phase.CORRECT),
        ),
        Phase.LATCHED: PhaseRule("no motion until a new run"),
    }
)
# The reference may be frozen in every phase in which a part is moved.
HOLDABLE = PHASES[Phase.HOLD].following


class PhaseMachine:
    """The present phase of a run. Thread-safe; `on_change` is called with every new phase."""

    def __init__(self, on_change: Callable[[Phase], None] = lambda phase: None) -> None:
        self._phase = Phase.IDLE
        self.latched = ""  # the reason why motion is forbidden; empty while it is allowed
        self._on_change = on_change
        self._lock = threading.Lock()

    @property
    def phase(self) -> Phase:
        """The present phase."""
        return self._phase

    def enter(self, phase: Phase) -> None:
        """Change to `phase`. Raises SafetyError when the table does not allow it after the present one."""
        with self._lock:
            present = self._phase
            if phase == present:
                return
            if present == Phase.LATCHED:
                raise SafetyError(with_advice(f"motion is latched: {self.latched}"))
            allowed = phase in PHASES[present].following or phase == Phase.LATCHED
            if not allowed and not (phase == Phase.HOLD and present in HOLDABLE):
                raise SafetyError(f"phase {phase} may not follow phase {present}; start a new run")
            self._phase = phase
        self._on_change(phase)

    def require_motion(self) -> None:
        """Raise SafetyError when the present phase allows no motion."""
        if not PHASES[self._phase].moves:
            raise SafetyError(f"target refused: no motion is allowed in phase {self._phase}")
