"""EGM driver: stops, latches and resets, against the mock arm over UDP."""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from tests.real.egm.harness import CONFIG, DOWN, START, ArmAndMock, near_start

from gelflow.errors import PeerTimeout, SafetyError
from gelflow.real.egm.cycle_log import EgmCycle
from gelflow.real.egm.reference_generator import EgmFlag


@pytest.fixture
def cell() -> Iterator[ArmAndMock]:
    with ArmAndMock() as cell:
        yield cell


def test_stop_ends_sending_and_latches_until_reset(cell: ArmAndMock) -> None:
    cell.arm.target(near_start(0.04, 0, 0), DOWN, lifetime=1.0)
    cell.clock.sleep(0.1)
    cell.arm.stop("contact was too hard")
    answers = cell.mock.report.answers
    cell.clock.sleep(0.2)
    assert cell.mock.report.answers - answers <= 1, "one answer may still be in transit"
    assert cell.arm.state().fault == "contact was too hard"
    assert not cell.arm.state().running
    with pytest.raises(SafetyError, match="stopped: contact was too hard; after the cause is removed, an operator"):
        cell.arm.target(START, DOWN, lifetime=0.5)
    # The time-out of the robot ends EGM; its program starts EGM again, and still nothing is sent.
    cell.until(lambda: cell.mock.report.sessions == 2, "EGM was started again")
    assert cell.mock.report.reason == "no answer for 2.0 s"
    stood = cell.plant.arm_pose()[0]
    assert cell.mock.report.answers - answers <= 1
    cell.arm.reset()
    cell.arm.wait_following(20)
    cell.clock.sleep(0.1)
    assert np.allclose(cell.plant.arm_pose()[0], stood, atol=1e-7), "the arm moved after the reset without a target"
    assert cell.mock.report.first_error < 1e-9
    cell.go(START)


def test_motors_off_and_rapid_stop_latch(cell: ArmAndMock) -> None:
    cell.mock.motors(False)
    assert cell.latched() == "motors off"
    assert not cell.arm.state().motors_on
    cell.mock.motors(True)
    cell.until(lambda: cell.mock.report.sessions == 2, "EGM was started again")
    cell.clock.sleep(0.1)
    assert not cell.arm.state().running
    cell.arm.reset()
    cell.arm.wait_following(20)
    cell.mock.rapid(False)
    assert cell.latched() == "RAPID stopped"
    with pytest.raises(SafetyError, match="RAPID stopped"):
        cell.arm.target(START, DOWN, lifetime=0.5)


def test_a_stop_during_a_reading_of_the_state_comes_with_its_reason(
    cell: ArmAndMock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flags came from one message and "running" from the next: a stop without a reason."""
    latest = cell.arm._latest

    def interrupted() -> EgmCycle:
        record = latest()
        cell.mock.motors(False)
        cell.until(lambda: EgmFlag.FOLLOWING not in latest().flags, "the message with motors off")
        return record

    monkeypatch.setattr(cell.arm, "_latest", interrupted)
    state = cell.arm.state()
    assert (state.running, state.fault) == (False, "motors off")


def test_reset_with_a_persisting_cause_does_not_allow_motion(cell: ArmAndMock) -> None:
    cell.mock.motors(False)
    cell.latched()
    cell.arm.reset()
    with pytest.raises(PeerTimeout, match=r"motors off\): switch the motors on and start the RAPID program"):
        cell.arm.wait_following(0.2)
    with pytest.raises(SafetyError, match="does not follow references"):
        cell.arm.target(START, DOWN, lifetime=0.5)


def test_sequence_restart_latches(cell: ArmAndMock) -> None:
    cell.until(lambda: cell.mock.report.sent > 30, "30 messages")
    cell.mock.restart_sequence()
    assert "EGM was restarted" in cell.latched()
    answers = cell.mock.report.answers
    cell.clock.sleep(0.1)
    assert cell.mock.report.answers == answers


def test_stale_feedback_holds_then_stops() -> None:
    with ArmAndMock(config=dataclasses.replace(CONFIG, stale=0.1, silence=0.6)) as cell:
        cell.arm.target(near_start(0.04, 0, 0), DOWN, lifetime=1.0)
        cell.clock.sleep(0.05)
        cell.mock.silence(0.3)
        cell.until(lambda: any("no EGM message for" in e.text for e in cell.arm.drain_events()), "a hold")
        # After the feedback has returned, the arm holds although the target has not expired, and accepts new targets.
        cell.until(lambda: cell.clock.now() - cell.arm.state().stamp < 0.05, "fresh feedback")
        first, _ = cell.arm.reference()
        cell.clock.sleep(0.05)
        assert np.array_equal(cell.arm.reference()[0], first)
        cell.arm.target(START, DOWN, lifetime=0.5)
        cell.mock.silence(60)
        assert "at most 0.6 s is allowed" in cell.latched()
        with pytest.raises(SafetyError, match="the arm is stopped"):
            cell.arm.target(START, DOWN, lifetime=0.5)


def test_full_log_stops_the_arm_without_losing_cycles() -> None:
    with ArmAndMock(config=dataclasses.replace(CONFIG, log_records=64)) as cell:
        assert "the log is full: 64 cycles were not fetched with drain_log()" in cell.latched()
        records = cell.arm.drain_log()
        assert len(records) == 64
        gaps = [(r.sequence, EgmFlag.LOST in r.flags) for r in records]
        assert all(b[0] == a[0] + 1 or b[1] for a, b in itertools.pairwise(gaps))
        answers = cell.mock.report.answers
        cell.clock.sleep(0.1)
        assert cell.mock.report.answers == answers, "draining does not resume"
