"""Phases of a run: the table and the state machine that enforces it."""

import pytest

from gelflow.errors import SafetyError
from gelflow.real.runner.phases import HOLDABLE, PHASES, Phase, PhaseMachine

SEQUENCE = (  # an insertion with one correction
    *(Phase.PREFLIGHT, Phase.LOAD, Phase.APPROACH, Phase.DESCEND, Phase.RETREAT, Phase.CORRECT, Phase.DESCEND),
    *(Phase.LOWER, Phase.RELEASE, Phase.RETREAT, Phase.IDLE, Phase.LOAD),
)


def test_sequence_of_an_insertion_is_allowed() -> None:
    changes: list[Phase] = []
    machine = PhaseMachine(changes.append)
    for phase in SEQUENCE:
        machine.enter(phase)
    assert tuple(changes) == SEQUENCE


def test_every_phase_is_in_the_table_and_can_be_reached() -> None:
    assert set(PHASES) == set(Phase)
    reached = {following for rule in PHASES.values() for following in rule.following}
    assert reached | {Phase.HOLD, Phase.LATCHED} == set(Phase)


@pytest.mark.parametrize(
    ("present", "refused"), [(Phase.IDLE, Phase.LOWER), (Phase.LOAD, Phase.LOWER), (Phase.APPROACH, Phase.RELEASE)]
)
def test_phase_that_may_not_follow_is_refused(present: Phase, refused: Phase) -> None:
    machine = _machine_in(present)
    with pytest.raises(SafetyError, match=f"phase {refused} may not follow phase {present}"):
        machine.enter(refused)
    assert machine.phase == present


@pytest.mark.parametrize("phase", list(Phase))
def test_latched_follows_every_phase_and_nothing_follows_it(phase: Phase) -> None:
    machine = _machine_in(phase)
    machine.enter(Phase.LATCHED)
    for following in set(Phase) - {Phase.LATCHED}:
        with pytest.raises(SafetyError):
            machine.enter(following)
    with pytest.raises(SafetyError, match="no motion is allowed in phase latched"):
        machine.require_motion()


def test_hold_returns_to_the_phase_before_it() -> None:
    for phase in HOLDABLE:
        machine = _machine_in(phase)
        machine.enter(Phase.HOLD)
        with pytest.raises(SafetyError, match="no motion is allowed in phase hold"):
            machine.require_motion()
        machine.enter(phase)
        machine.require_motion()


def _machine_in(phase: Phase) -> PhaseMachine:
    """A machine brought to `phase` on the shortest allowed way."""
    ways: list[tuple[Phase, ...]] = [()]
    while True:
        way = ways.pop(0)
        present = way[-1] if way else Phase.IDLE
        if present == phase:
            break
        following = PHASES[present].following
        if present in HOLDABLE:
            following = (*following, Phase.HOLD)
        ways += [(*way, new) for new in (*following, Phase.LATCHED)]
    machine = PhaseMachine()
    for step in way:
        machine.enter(step)
    return machine
