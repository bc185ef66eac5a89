"""WSG-50 driver: stops, faults, dry runs and recording errors, with the mock on a pty and on TCP."""

import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
from tests.real.wsg.harness import (
    CLOCK,
    CONFIG,
    PATIENT,
    CommandRecord,
    Relay,
    connected,
    eventually,
    in_thread,
    mock,
    unmodified,
    wait_for_error,
)

from gelflow.errors import PeerError, PeerRefused, PeerTimeout, SafetyError
from gelflow.hardware_mocks.plant import KinematicGripper
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig
from gelflow.interrupts import Interrupted, interruptible
from gelflow.protocols import GripperState
from gelflow.real.transport import transport_for
from gelflow.real.wsg.codec import Packet
from gelflow.real.wsg.config import WsgConfig
from gelflow.real.wsg.constants import Command
from gelflow.real.wsg.driver import WsgGripper
from gelflow.real.wsg.link import WsgLink

MOTION_IDS = {Command.HOME, Command.PRE_POSITION, Command.STOP, Command.FAST_STOP, Command.GRASP, Command.RELEASE}


def assert_stopped_early(plant: KinematicGripper) -> None:
    """The fingers are at rest, and have hardly moved from 110 mm."""
    width = plant.gripper_state()[0]
    time.sleep(0.05)
    assert plant.gripper_state()[0] == width > 0.09


def grasp_without_result(gripper: WsgGripper, monkeypatch: pytest.MonkeyPatch) -> None:
    """A grasp that begins, and whose replies do not arrive."""
    link = gripper._link
    assert link is not None

    def no_result(packet: Packet, *, timeout: float, stops: int) -> None:
        link.send(packet)
        raise PeerTimeout("no result")

    monkeypatch.setattr(link, "run", no_result)
    with pytest.raises(PeerTimeout, match="no result"):
        gripper.grasp(width=0.010, speed=0.005, force=20)


def test_fast_stop_forbids_motion_until_acknowledged() -> None:
    with connected() as (gripper, server, _, record):
        gripper.home()
        server.raise_fast_stop()
        eventually(lambda: gripper.state().fault == "FAST_STOP", "FAST STOP did not appear in the state")
        with pytest.raises(SafetyError, match="FAST_STOP"):
            gripper.home()
        with pytest.raises(SafetyError, match="FAST_STOP"):
            gripper.move(width=0.05, speed=0.1)
        assert "acknowledge fault" not in record.names and server.fast_stopped
        gripper.acknowledge_fault()
        assert gripper.state().fault == "" and not server.fast_stopped
        gripper.move(width=0.100, speed=0.4)
        gripper.fast_stop()
        eventually(lambda: gripper.state().fault == "FAST_STOP", "FAST STOP did not appear in the state")


def test_stop_from_another_thread_ends_a_motion_and_a_second_motion_is_refused() -> None:
    with connected() as (gripper, _, _, _):
        gripper.home()
        thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
        eventually(lambda: gripper.state().grasp == "positioning", "the move did not start")
        with pytest.raises(SafetyError, match="in progress"):
            gripper.release(width=0.110, speed=0.1)
        gripper.stop()
        thread.join(PATIENT)
        assert len(errors) == 1 and "CMD_ABORTED" in str(errors[0])
        assert gripper.state().width > 0.09


def test_a_stop_while_the_force_limit_is_set_prevents_the_grasp(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (gripper, _, plant, _):
        gripper.home()
        limit_force = gripper._limit_force

        def stopped(link: WsgLink, force: float) -> None:
            limit_force(link, force)
            gripper.stop()

        monkeypatch.setattr(gripper, "_limit_force", stopped)
        with pytest.raises(PeerRefused, match="the gripper was stopped before GRASP was sent"):
            gripper.grasp(width=0.040, speed=0.4, force=20)
        assert plant.gripper_state()[0] == pytest.approx(0.110) and gripper.state().grasp == "idle"


def test_forbidden_motions_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither later ones nor one that is being prepared, and without a stop, which would end the grip of a part."""
    with connected() as (gripper, _, plant, record):
        gripper.home()
        limit_force = gripper._limit_force

        def forbidden(link: WsgLink, force: float) -> None:
            limit_force(link, force)
            assert gripper.forbid_motion("the operator pressed stop")

        monkeypatch.setattr(gripper, "_limit_force", forbidden)
        with pytest.raises(PeerRefused, match="the gripper was stopped before GRASP was sent"):
            gripper.grasp(width=0.040, speed=0.4, force=20)
        motions: list[Callable[[], None]] = [
            lambda: gripper.home(part_removed=True),
            lambda: gripper.move(width=0.04, speed=0.4),
            lambda: gripper.release(width=0.110, speed=0.1),
        ]
        for motion in motions:
            with pytest.raises(SafetyError, match="refused: the operator pressed stop"):
                motion()
        assert not gripper.forbid_motion("later")
        assert record.names == ["home", "grasp"] and plant.gripper_state()[0] == pytest.approx(0.110)


def test_a_release_that_is_forbidden_before_it_is_sent_keeps_the_grip(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (gripper, _, plant, record):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        link = gripper._link
        assert link is not None
        send = link.send

        def forbidden(packet: Packet, **options: Any) -> None:
            gripper.forbid_motion("the operator pressed stop")
            send(packet, **options)

        monkeypatch.setattr(link, "send", forbidden)
        with pytest.raises(PeerRefused, match="the gripper was stopped before RELEASE was sent"):
            gripper.release(width=0.110, speed=0.1)
        assert record.names[-1] == "release" and gripper.state().grasp == "holding"


def test_a_stop_that_came_too_early_is_sent_again_after_the_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    device = MockWsgConfig(shortest_command_interval=0.1, stops_at_any_rate=False)
    with connected(device=device, config=replace(CONFIG, command_interval=0.5)) as (gripper, _, plant, record):
        gripper.home()
        grasp_without_result(gripper, monkeypatch)
        assert record.names[-1] == "stop" and record.names.count("stop") <= 2  # one if this computer was interrupted
        eventually(lambda: plant.gripper_state()[1] == 0.0, "the fingers were not stopped")
        assert plant.gripper_state()[0] > 0.09


def test_a_stop_that_is_not_confirmed_is_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with connected() as (gripper, _, _, record):
        gripper.home()
        link = gripper._link
        assert link is not None
        request, lost = link.request, [PeerTimeout("no answer")]

        def damaged(packet: Packet, **options: Any) -> Any:
            if packet.id == Command.STOP and lost:
                raise lost.pop()
            return request(packet, **options)

        monkeypatch.setattr(link, "request", damaged)
        gripper.stop()
        assert record.names[-2:] == ["stop", "stop"]
        lost += [PeerTimeout("second"), PeerTimeout("first")]
        with pytest.raises(PeerTimeout, match="second"):
            gripper.stop()


def test_close_repeats_a_stop_that_was_not_confirmed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although a part may be held, by the state from before the grasp."""
    with connected() as (gripper, _, plant, record):
        gripper.home()
        link = gripper._link
        assert link is not None
        idle = gripper.state()

        def lost(packet: Packet, **_: object) -> None:
            raise PeerTimeout("no answer")

        with monkeypatch.context() as silent:
            silent.setattr(link, "request", lost)
            silent.setattr(gripper, "_limit_force", lambda link, force: None)
            grasp_without_result(gripper, silent)
        monkeypatch.setattr(gripper._values, "state", lambda corrupt: idle)
        gripper.close()
        assert record.names[-2:] == ["stop", "disconnect"]
        assert_stopped_early(plant)


def test_close_during_a_motion_stops_the_fingers() -> None:
    with connected() as (gripper, _, plant, _):
        gripper.home()
        thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
        eventually(lambda: gripper.state().grasp == "positioning", "the move did not start")
        gripper.close()
        thread.join(PATIENT)
        assert errors
        assert_stopped_early(plant)


def test_close_with_a_held_part_keeps_the_grip() -> None:
    with connected() as (gripper, server, plant, record):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        gripper.close()
        assert record.names[-2:] == ["grasp", "disconnect"]
        with WsgGripper(transport_for(server.addresses[0], clock=CLOCK), clock=CLOCK, config=CONFIG) as other:
            assert other.state().grasp == "holding" and other.state().force == 20
            with pytest.raises(SafetyError, match="may be held"):
                other.home()


def test_close_after_a_grasp_without_a_result_stops_the_fingers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stop after it was lost too: the device still reports that it grasps."""
    with connected() as (gripper, _, plant, record):
        gripper.home()
        with monkeypatch.context() as lost:
            lost.setattr(gripper, "_stop_twice", lambda link: None)
            grasp_without_result(gripper, lost)
        eventually(lambda: gripper.state().grasp == "grasping", "the grasp did not start")
        gripper.close()
        assert record.names[-2:] == ["stop", "disconnect"]
        assert_stopped_early(plant)


def test_unannounced_disconnect_leaves_fast_stop_and_the_held_part() -> None:
    with mock() as (server, plant):
        relay = Relay(server.tcp_address, unmodified)
        first = WsgGripper(transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=CONFIG)
        first.connect()
        first.home()
        plant.set_part(0.040)
        first.grasp(width=0.040, speed=0.4, force=20)
        relay.close()  # as if the cable were unplugged
        with pytest.raises(PeerError, match=r"closed|broke"):
            wait_for_error(first)
        with pytest.raises(PeerError, match=r"closed|broke"):
            first.move(width=0.05, speed=0.1)
        first.close()
        eventually(lambda: server.fast_stopped, "the device did not detect the disconnect")
        with WsgGripper(transport_for(server.addresses[1], clock=CLOCK), clock=CLOCK, config=CONFIG) as second:
            assert second.state().fault == "FAST_STOP"
            second.acknowledge_fault()
            with pytest.raises(SafetyError, match="may be held"):  # it reports idle, but the fingers press
                second.home()
            plant.set_part(None)
            second.home(part_removed=True)


def test_a_signal_during_the_disconnect_is_raised_after_it() -> None:
    """An unannounced disconnect raises FAST STOP."""

    def interrupt(name: str, values: Mapping[str, float]) -> None:
        if name == "stop":
            os.kill(os.getpid(), signal.SIGINT)

    with mock() as (server, _):
        transport = transport_for(server.addresses[1], clock=CLOCK)
        gripper = WsgGripper(transport, clock=CLOCK, config=CONFIG, on_command=interrupt)
        gripper.connect()
        with pytest.raises(Interrupted), interruptible():
            gripper.close()
        time.sleep(0.2)
        assert not server.fast_stopped


def test_dry_run_sends_no_motion() -> None:
    with mock() as (server, plant):
        with WsgGripper(transport_for(server.addresses[1], clock=CLOCK), clock=CLOCK, config=CONFIG) as gripper:
            gripper.home()
        relay = Relay(server.tcp_address, unmodified)
        record = CommandRecord()
        dry = WsgConfig(reply_timeout=20, stale_after=20, dry_run=True)
        with WsgGripper(
            transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=dry, on_command=record.command
        ) as gripper:
            width = gripper.state().width
            gripper.home()
            gripper.grasp(width=0.1, speed=0.1, force=20)
            gripper.release(width=0.110, speed=0.1)
            gripper.move(width=0.1, speed=0.1)
            gripper.stop()
            with pytest.raises(SafetyError):
                gripper.move(width=0.2, speed=0.1)
            gripper.acknowledge_fault()
        relay.close()
        assert record.names == ["home", "grasp", "release", "move", "stop", "acknowledge fault", "disconnect"]
        assert not (MOTION_IDS | {Command.SET_FORCE_LIMIT, Command.ACKNOWLEDGE}) & set(relay.ids())
        assert plant.gripper_state()[0] == pytest.approx(width)
        assert not server.fast_stopped


def test_command_that_cannot_be_recorded_is_not_sent() -> None:
    def full(name: str, values: Mapping[str, float]) -> None:
        raise PeerError(f"the disk is full: {name}")

    with mock() as (server, plant):
        gripper = WsgGripper(
            transport_for(server.addresses[0], clock=CLOCK), clock=CLOCK, config=CONFIG, on_command=full
        )
        with gripper:
            with pytest.raises(PeerError, match="disk is full: home"):
                gripper.home()
            assert plant.gripper_state()[0] == 0.050
        assert not server.fast_stopped


def test_measurement_that_cannot_be_recorded_ends_the_link_after_a_stop() -> None:
    full = threading.Event()

    def record(state: GripperState) -> None:
        if full.is_set():
            raise PeerError("the disk is full")

    with mock() as (server, plant):
        transport = transport_for(server.addresses[1], clock=CLOCK)
        with WsgGripper(transport, clock=CLOCK, config=CONFIG, on_measurement=record) as gripper:
            gripper.home()
            thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
            eventually(lambda: gripper.state().grasp == "positioning", "the move did not start")
            full.set()
            thread.join(PATIENT)
            assert "disk is full" in str(errors[0])
            with pytest.raises(PeerError, match="disk is full"):
                gripper.state()
            eventually(lambda: plant.gripper_state()[1] == 0.0, "the fingers were not stopped")
            assert plant.gripper_state()[0] > 0.05
        eventually(lambda: not server.fast_stopped, "the disconnect was not announced")
