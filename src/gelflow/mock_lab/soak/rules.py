"""The rules that hold under every fault plan, as a table: name and condition."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gelflow.mock_lab.soak.session_facts import SessionFacts

MAX_PUSH = 1e-3  # largest slip of a part in the grip without a stop [m]
_HOLD_MOTION = 50e-6  # largest change of the reference after a latch that counts as a hold [m]
_WORKSPACE_MARGIN = 2.1e-3  # largest distance of a reference outside the workspace that the driver allows [m]


@dataclass(frozen=True)
class RunFacts:
    """One run under one plan."""

    outcome: str  # of the part as the runner reports it, or how the run ended without one
    exit_code: int | None  # None: the run was ended from outside, because it did not end
    errors: str  # standard error of the run
    idle: float  # longest time without any motion [s]
    allowed_idle: float  # the longest time-out plus one second [s]
    truth: Mapping[str, Any]  # of the part; empty when none was presented
    session: SessionFacts


RULES: Mapping[str, Callable[[RunFacts], bool]] = MappingProxyType(
    {
        "called inserted, but is not": lambda run: run.outcome == "inserted" and not run.truth.get("inserted", False),
        "pushed in the grip without a stop": lambda run: run.truth.get("largest_push", 0.0) > MAX_PUSH,
        "motion after a latch": lambda run: run.session.moved_after_latch > _HOLD_MOTION,
        "target outside was not refused": lambda run: run.session.outside > _WORKSPACE_MARGIN,
        "hang": lambda run: run.exit_code is None or run.idle > run.allowed_idle,
        "unexpected exception": lambda run: "Traceback" in run.errors or run.exit_code not in (0, 1, 2, 143, None),
        "no stop was sent": lambda run: run.session.moved and not run.session.stop_recorded,
        "recording not readable": lambda run: run.session.readable == "no",
    }
)


def violations(run: RunFacts) -> list[str]:
    """Names of the rules that a run violates."""
    return [name for name, violated in RULES.items() if violated(run)]
