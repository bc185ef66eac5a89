"""The events on the timeline of a session: attempts, decisions, warnings and stops."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.session.reader import Record
from gelflow.session.viewer_messages import ERRORS, WARNINGS, event_text

Kind = Literal["inserted", "not inserted", "decision", "difference", "warning", "stop"]
_LONGEST = 90  # of a text [characters]
_DESCEND = "descend"  # phase with which an attempt starts


@dataclass(frozen=True)
class TimelineEvent:
    """An event, or an attempt from `time` to `end` [s]."""

    time: float
    end: float
    kind: Kind
    text: str
    insertion: int | None = None
    attempt: int | None = None


def phases(events: Sequence[Record]) -> list[tuple[float, str]]:
    """Times [s] and names of the phases of a run."""
    states = [event for event in events if event.value["name"] == "state" and "state" in event.value["values"]]
    return [(event.stamp, str(event.value["values"]["state"])) for event in states]


def descents(run: Sequence[tuple[float, str]]) -> list[float]:
    """Times at which the descent of an attempt starts [s]."""
    return [time for time, phase in run if phase == _DESCEND]


def correction_text(action: NDArray[np.float64], digits: int = 2) -> str:
    """A correction (dx [m], dy [m], dyaw [rad]) in words, with `digits` of a millimetre and one less of a degree."""
    dx, dy, yaw = action * (1e3, 1e3, 180 / np.pi)
    return f"x {dx:+.{digits}f} mm, y {dy:+.{digits}f} mm, yaw {yaw:+.{digits - 1}f}°"


def timeline_events(
    events: Sequence[Record], attempts: Sequence[Record], decisions: Sequence[Record]
) -> list[TimelineEvent]:
    """All events of a session, in order of time."""
    found = [*_attempts(attempts, phases(events)), *_warnings_and_stops(events)]
    for record in decisions:
        decision = record.value
        text = f"decision: {correction_text(decision.action)}"
        found.append(TimelineEvent(record.time, record.time, "decision", text, decision.insertion, decision.attempt))
    return sorted(found, key=lambda event: event.time)


def _attempts(attempts: Sequence[Record], run: Sequence[tuple[float, str]]) -> Iterable[TimelineEvent]:
    """An attempt lasts from the descent before its record to the record."""
    starts = descents(run)
    for record in attempts:
        values = record.value
        start = max((time for time in starts if time <= record.time), default=record.time)
        outcome = str(values.get("outcome", "ended"))
        insertion, attempt = values.get("insertion"), values.get("attempt")
        text = f"insertion {insertion}, attempt {attempt}: {outcome}"
        kind: Kind = "inserted" if outcome == "inserted" else "not inserted"
        yield TimelineEvent(start, record.time, kind, text, insertion, attempt)


def _warnings_and_stops(events: Sequence[Record]) -> Iterable[TimelineEvent]:
    for record in events:
        name, values = str(record.value["name"]), record.value["values"]
        if name == "arm stopped":
            continue  # also the normal end of a run; a failure has the event "stopped" too
        if name in ERRORS or name in WARNINGS:
            text = event_text(name, values)
            text = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
            yield TimelineEvent(record.time, record.time, "stop" if name in ERRORS else "warning", text)
