"""WSG-50 driver: motions, their limits and their failures, with the mock on a pty and on TCP."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from tests.real.wsg.harness import CLOCK, CONFIG, CommandRecord, connected, eventually, mock, relayed, unmodified

from gelflow.errors import PeerRefused, SafetyError, UsageError
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig
from gelflow.protocols import Gripper
from gelflow.real.transport import transport_for
from gelflow.real.wsg.checks import check_limits
from gelflow.real.wsg.config import WsgConfig, WsgLimits
from gelflow.real.wsg.driver import WsgGripper


@pytest.mark.parametrize("wire", [0, 1], ids=["pty", "tcp"])
def test_home_move_grasp_and_release_over_pty_and_tcp(wire: int) -> None:
    record = CommandRecord()
    with mock() as (server, plant):
        gripper = WsgGripper(
            transport_for(server.addresses[wire], clock=CLOCK),
            clock=CLOCK,
            config=CONFIG,
            on_command=record.command,
            on_measurement=record.states.append,
        )
        assert isinstance(gripper, Gripper)
        with gripper:
            state = gripper.state()
            assert state.width == pytest.approx(0.050, abs=1e-6) and not state.referenced and state.grasp == "idle"
            gripper.home()
            assert gripper.state().referenced and gripper.state().width == pytest.approx(0.110, abs=3e-4)
            gripper.move(width=0.040, speed=0.2)
            assert gripper.state().width == pytest.approx(0.040, abs=3e-4)
            plant.set_part(0.025)
            gripper.grasp(width=0.025, speed=0.02, force=20)
            state = gripper.state()
            assert state.grasp == "holding" and state.force == 20 and state.width == pytest.approx(0.025, abs=1e-6)
            gripper.release(width=0.060, speed=0.2)
            assert gripper.state().grasp == "idle" and gripper.state().width == pytest.approx(0.060, abs=3e-4)
        assert not server.fast_stopped  # the disconnect was announced
        gripper.close()  # a second close has no effect
    assert record.names == ["home", "move", "grasp", "release", "stop", "disconnect"]
    assert record.commands[2][1] == {"width": 0.025, "speed": 0.02, "force": 20}
    stamps = [state.stamp for state in record.states]
    assert len(stamps) > 10 and all(a <= b for a, b in itertools.pairwise(stamps))


def test_reconnect_repeats_no_command() -> None:
    with mock() as (server, plant):
        gripper = WsgGripper(transport_for(server.addresses[1], clock=CLOCK), clock=CLOCK, config=CONFIG)
        with gripper:
            gripper.home()
            gripper.move(width=0.040, speed=0.4)
        before = plant.gripper_state()[0]
        with gripper:
            assert gripper.state().referenced
            with pytest.raises(UsageError, match="already connected"):
                gripper.connect()
        assert plant.gripper_state()[0] == before


def test_calls_without_a_connection_raise_usage_error() -> None:
    gripper = WsgGripper(transport_for("tcp:127.0.0.1:1", clock=CLOCK), clock=CLOCK)
    for call in (gripper.state, gripper.home, gripper.stop, gripper.acknowledge_fault):
        with pytest.raises(UsageError, match="connect"):
            call()
    gripper.close()


def test_commands_outside_the_limits_are_not_sent() -> None:
    with relayed(unmodified) as (gripper, relay, _):
        gripper.home()
        before = len(relay.sent)
        good = {"width": 0.05, "speed": 0.1, "force": 20.0}
        for name, value in itertools.chain(
            itertools.product(["width"], [-0.001, 0.1101, math.nan, math.inf, -math.inf]),
            itertools.product(["speed"], [0.0049, 0.4201, 0.0, -0.1, math.nan]),
            itertools.product(["force"], [4.9, 80.1, 0.0, math.nan]),
        ):
            wrong = {**good, name: value}
            with pytest.raises(SafetyError, match=name):
                gripper.grasp(**wrong)
            if name != "force":
                with pytest.raises(SafetyError, match=name):
                    gripper.move(width=wrong["width"], speed=wrong["speed"])
                with pytest.raises(SafetyError, match=name):
                    gripper.release(width=wrong["width"], speed=wrong["speed"])
        assert len(relay.sent) == before


def test_a_width_that_equals_a_rounded_limit_of_the_device_is_allowed() -> None:
    reported = float(np.float32(109.7)) / 1e3  # less than 0.1097 m
    limits = WsgLimits(width=(0.0, reported))
    check_limits(limits, width=0.1097)
    for width in (0.1097 + 1e-6, math.nan):
        with pytest.raises(SafetyError, match=r"outside 0\.0 to 0\.1096"):
            check_limits(limits, width=width)


def test_configured_limits_and_device_limits_are_combined() -> None:
    narrow = WsgConfig(reply_timeout=20, stale_after=20, limits=WsgLimits(width=(0.010, 0.090), force=(5, 30)))
    with connected(config=narrow, device=MockWsgConfig(stroke=0.080), width=0.060) as (gripper, _, _, _):
        assert gripper.limits == WsgLimits(width=(0.010, 0.080), force=(5, 30))
        gripper.home()
        for width in (0.009, 0.081):
            with pytest.raises(SafetyError, match="width"):
                gripper.move(width=width, speed=0.1)
        with pytest.raises(SafetyError, match="force"):
            gripper.grasp(width=0.02, speed=0.1, force=31)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: WsgLimits(width=(0.0, 0.2)),
        lambda: WsgLimits(force=(50, 40)),
        lambda: WsgLimits(speed=(math.nan, 0.1)),
        lambda: WsgConfig(reply_timeout=0),
        lambda: WsgConfig(update_period=0.4),
        lambda: WsgConfig(command_interval=-1),
        lambda: transport_for("ttyUSB0", clock=CLOCK),
        lambda: transport_for("tcp:host", clock=CLOCK),
        lambda: transport_for("tcp:host:0", clock=CLOCK),
        lambda: transport_for("tcp:host:99999", clock=CLOCK),
        lambda: transport_for("serial:", clock=CLOCK),
    ],
)
def test_invalid_settings_raise_usage_error(wrong: Callable[[], object]) -> None:
    with pytest.raises(UsageError):
        wrong()


def test_home_is_required_and_refused_while_a_part_may_be_held() -> None:
    with connected() as (gripper, _, plant, _):
        with pytest.raises(SafetyError, match="home it first"):
            gripper.move(width=0.05, speed=0.1)
        gripper.home()
        gripper.move(width=0.040, speed=0.4)
        plant.set_part(0.025)
        gripper.grasp(width=0.025, speed=0.1, force=20)
        with pytest.raises(SafetyError, match="may be held"):
            gripper.home()
        with pytest.raises(SafetyError, match="is held"):
            gripper.move(width=0.05, speed=0.1)
        with pytest.raises(SafetyError, match="already held"):
            gripper.grasp(width=0.025, speed=0.1, force=20)
        gripper.stop()  # the device reports idle, but the part is still between the fingers
        eventually(lambda: gripper.state().grasp == "idle", "the stop did not end the grip")
        with pytest.raises(SafetyError, match="may be held"):
            gripper.home()


def test_grasp_never_opens_and_release_never_closes() -> None:
    with connected() as (gripper, _, _, _):
        gripper.home()
        gripper.move(width=0.040, speed=0.4)
        with pytest.raises(SafetyError, match="would open"):
            gripper.grasp(width=0.050, speed=0.1, force=20)
        with pytest.raises(SafetyError, match="would close"):
            gripper.release(width=0.030, speed=0.1)


def test_motion_longer_than_its_timeout_is_not_started() -> None:
    with connected(config=WsgConfig(reply_timeout=20, stale_after=20, home_timeout=50)) as (gripper, _, _, record):
        gripper.home()
        with pytest.raises(UsageError, match="higher speed"):
            gripper.move(width=0.0, speed=0.005)
        assert record.names == ["home"]


def test_missing_part_and_early_contact_are_distinguished() -> None:
    with connected() as (gripper, _, plant, record):
        gripper.home()
        with pytest.raises(PeerRefused, match="CMD_FAILED"):
            gripper.grasp(width=0.030, speed=0.4, force=20)
        assert gripper.state().grasp == "no part"
        gripper.release(width=0.100, speed=0.4)
        plant.set_part(0.040)
        with pytest.raises(PeerRefused, match="AXIS_BLOCKED"):
            gripper.grasp(width=0.030, speed=0.4, force=20)
        assert record.names[-2:] == ["grasp", "stop"]  # blocked fingers do not continue to push
        with pytest.raises(SafetyError, match="may be held"):
            gripper.home()
        gripper.release(width=0.100, speed=0.4)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        assert gripper.state().grasp == "holding"


def test_blocked_move_stops_and_raises() -> None:
    with connected() as (gripper, _, plant, record):
        gripper.home()
        plant.set_part(0.040)
        with pytest.raises(PeerRefused, match="AXIS_BLOCKED"):
            gripper.move(width=0.020, speed=0.4)
        assert record.names[-1] == "stop"


def test_empty_fingers_close_with_the_smallest_force() -> None:
    with connected() as (gripper, _, plant, _):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=60)
        gripper.release(width=0.100, speed=0.4)
        forces = []
        command = plant.command_gripper
        plant.command_gripper = lambda **values: (forces.append(values["force"]), command(**values))  # type: ignore
        gripper.move(width=0.060, speed=0.4)
        assert forces == [CONFIG.limits.force[0]]


def test_lost_part_appears_in_the_state() -> None:
    with connected() as (gripper, server, plant, _):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        server.lose_part()
        eventually(lambda: gripper.state().grasp == "part lost", "the loss did not appear in the state")
