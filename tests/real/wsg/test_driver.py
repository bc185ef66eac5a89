"""The WSG-50 driver against the mock on a pty and on TCP, with a relay between them that spoils the bytes."""

import itertools
import math
import os
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress

import pytest

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError, PeerError, PeerRefused, PeerTimeout, SafetyError, UsageError
from gelflow.hardware_mocks.plant import KinematicGripper
from gelflow.hardware_mocks.wsg.device import MockWsgGripper
from gelflow.hardware_mocks.wsg.finger_controller import MockWsgConfig
from gelflow.protocols import Gripper, GripperState
from gelflow.real.transport import TcpTransport, transport_for
from gelflow.real.wsg.codec import crc16, reply
from gelflow.real.wsg.config import WsgConfig, WsgLimits
from gelflow.real.wsg.constants import STATE_COMMANDS, Command, Status
from gelflow.real.wsg.driver import WsgGripper

CLOCK = ScaledClock(5.0)
PATIENT = 10.0  # a time-out that only a failing test reaches [s, wall]
# The device needs no more time than its own motions do; a busy test machine may.
CONFIG = WsgConfig(reply_timeout=20.0, home_timeout=50.0, move_timeout=50.0, stale_after=20.0)
MOTION_IDS = {Command.HOME, Command.PRE_POSITION, Command.STOP, Command.FAST_STOP, Command.GRASP, Command.RELEASE}


class Notebook:
    """What the recorder would get."""

    def __init__(self) -> None:
        self.commands: list[tuple[str, dict[str, float]]] = []
        self.states: list[GripperState] = []

    def command(self, name: str, values: Mapping[str, float]) -> None:
        self.commands.append((name, dict(values)))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.commands]


Spoil = Callable[[bytes], Iterable[bytes]]


class Relay:
    """A TCP peer that passes bytes on to the mock, and the mock's bytes back through `spoil`."""

    def __init__(self, target: tuple[str, int], spoil: Spoil) -> None:
        self.spoil = spoil
        self.sent = b""  # by the driver
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp:127.0.0.1:{self._listener.getsockname()[1]}"
        self._target = target
        self._links: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._serve, daemon=True)]
        self._threads[0].start()

    def _serve(self) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            device = socket.create_connection(self._target)
            self._links += [client, device]
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            back = threading.Thread(target=self._back, args=(device, client), daemon=True)
            self._threads.append(back)
            back.start()
            while data := client.recv(4096):
                self.sent += data
                device.sendall(data)
            device.shutdown(socket.SHUT_RDWR)  # wakes the way back, too

    def _back(self, device: socket.socket, client: socket.socket) -> None:
        with suppress(OSError):
            while data := device.recv(4096):
                for chunk in self.spoil(data):
                    client.sendall(chunk)

    def close(self) -> None:
        for link in [self._listener, *self._links]:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        for thread in self._threads:
            thread.join(PATIENT)

    def ids(self) -> list[int]:
        """The commands that the driver sent."""
        return [self.sent[i + 3] for i in range(len(self.sent) - 3) if self.sent[i : i + 3] == b"\xaa\xaa\xaa"]


@contextmanager
def mock(
    *, width: float = 0.050, config: MockWsgConfig | None = None, clock: ScaledClock = CLOCK
) -> Iterator[tuple[MockWsgGripper, KinematicGripper]]:
    plant = KinematicGripper(clock, width=width)
    with MockWsgGripper(plant, clock=clock, config=config, tcp_port=0) as device:
        yield device, plant


@contextmanager
def connected(
    *, config: WsgConfig = CONFIG, device: MockWsgConfig | None = None, width: float = 0.050
) -> Iterator[tuple[WsgGripper, MockWsgGripper, KinematicGripper, Notebook]]:
    with mock(config=device, width=width) as (server, plant):
        notes = Notebook()
        transport = transport_for(server.addresses[0], clock=CLOCK)
        with WsgGripper(
            transport, clock=CLOCK, config=config, on_command=notes.command, on_measurement=notes.states.append
        ) as gripper:
            yield gripper, server, plant, notes


@contextmanager
def relayed(spoil: Spoil, *, config: WsgConfig = CONFIG) -> Iterator[tuple[WsgGripper, Relay, KinematicGripper]]:
    with mock() as (server, plant):
        relay = Relay(server.tcp_address, spoil)
        try:
            with WsgGripper(transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=config) as gripper:
                yield gripper, relay, plant
        finally:
            relay.close()


def untouched(data: bytes) -> Iterable[bytes]:
    return [data]


def eventually(reached: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENT
    while not reached():
        assert time.monotonic() < end, what
        time.sleep(0.005)


def await_trouble(gripper: WsgGripper) -> None:
    """Ask for the state until that raises: the reading thread notices a lost link a little later than it happens."""
    end = time.monotonic() + PATIENT
    while time.monotonic() < end:
        gripper.state()
        time.sleep(0.005)
    pytest.fail("the driver did not notice")


# ------------------------------------------------------------------ the life of a grip


@pytest.mark.parametrize("wire", [0, 1], ids=["pty", "tcp"])
def test_a_whole_life(wire: int) -> None:
    notes = Notebook()
    with mock() as (server, plant):
        gripper = WsgGripper(
            transport_for(server.addresses[wire], clock=CLOCK),
            clock=CLOCK,
            config=CONFIG,
            on_command=notes.command,
            on_measurement=notes.states.append,
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
        gripper.close()  # twice is fine
    assert notes.names == ["home", "move", "grasp", "release", "stop", "disconnect"]
    assert notes.commands[2][1] == {"width": 0.025, "speed": 0.02, "force": 20}
    stamps = [state.stamp for state in notes.states]
    assert len(stamps) > 10 and all(a <= b for a, b in itertools.pairwise(stamps))


def test_it_can_be_connected_again_and_repeats_no_command() -> None:
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


def test_before_connect_and_after_close_it_says_so() -> None:
    gripper = WsgGripper(transport_for("tcp:127.0.0.1:1", clock=CLOCK), clock=CLOCK)
    for call in (gripper.state, gripper.home, gripper.stop, gripper.acknowledge_fault):
        with pytest.raises(UsageError, match="connect"):
            call()
    gripper.close()


# ------------------------------------------------------------------ what is refused


def test_nothing_outside_the_limits_is_sent() -> None:
    with relayed(untouched) as (gripper, relay, _):
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


def test_a_laboratorys_own_limits_and_the_devices_hold_too() -> None:
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
def test_wrong_settings_are_named(wrong: Callable[[], object]) -> None:
    with pytest.raises(UsageError):
        wrong()


def test_home_comes_first_and_never_while_a_part_may_be_held() -> None:
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
        gripper.stop()  # the device calls itself idle now, and yet the part is between the fingers
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


def test_a_motion_that_can_not_end_in_time_is_not_begun() -> None:
    with connected(config=WsgConfig(reply_timeout=20, stale_after=20, home_timeout=50)) as (gripper, _, _, notes):
        gripper.home()
        with pytest.raises(UsageError, match="higher speed"):
            gripper.move(width=0.0, speed=0.005)
        assert notes.names == ["home"]


# ------------------------------------------------------------------ grasps that fail


def test_no_part_and_an_early_contact_are_told_apart() -> None:
    with connected() as (gripper, _, plant, notes):
        gripper.home()
        with pytest.raises(PeerRefused, match="CMD_FAILED"):
            gripper.grasp(width=0.030, speed=0.4, force=20)
        assert gripper.state().grasp == "no part"
        gripper.release(width=0.100, speed=0.4)
        plant.set_part(0.040)
        with pytest.raises(PeerRefused, match="AXIS_BLOCKED"):
            gripper.grasp(width=0.030, speed=0.4, force=20)
        assert notes.names[-2:] == ["grasp", "stop"]  # blocked fingers do not go on pushing
        with pytest.raises(SafetyError, match="may be held"):
            gripper.home()
        gripper.release(width=0.100, speed=0.4)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        assert gripper.state().grasp == "holding"


def test_a_blocked_move_stops_and_says_so() -> None:
    with connected() as (gripper, _, plant, notes):
        gripper.home()
        plant.set_part(0.040)
        with pytest.raises(PeerRefused, match="AXIS_BLOCKED"):
            gripper.move(width=0.020, speed=0.4)
        assert notes.names[-1] == "stop"


def test_a_lost_part_shows_in_the_state() -> None:
    with connected() as (gripper, server, plant, _):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        server.lose_part()
        eventually(lambda: gripper.state().grasp == "part lost", "the loss did not show")


# ------------------------------------------------------------------ stops and faults


def test_fast_stop_waits_for_an_operator() -> None:
    with connected() as (gripper, server, _, notes):
        gripper.home()
        server.raise_fast_stop()
        eventually(lambda: gripper.state().fault == "FAST_STOP", "FAST STOP did not show")
        with pytest.raises(SafetyError, match="FAST_STOP"):
            gripper.home()
        with pytest.raises(SafetyError, match="FAST_STOP"):
            gripper.move(width=0.05, speed=0.1)
        assert "acknowledge fault" not in notes.names and server.fast_stopped
        gripper.acknowledge_fault()
        assert gripper.state().fault == "" and not server.fast_stopped
        gripper.move(width=0.100, speed=0.4)
        gripper.fast_stop()
        eventually(lambda: gripper.state().fault == "FAST_STOP", "FAST STOP did not show")


def in_thread(call: Callable[[], object]) -> tuple[threading.Thread, list[GelflowError]]:
    errors: list[GelflowError] = []

    def run() -> None:
        try:
            call()
        except GelflowError as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, errors


def test_a_stop_from_another_thread_ends_a_motion_and_two_motions_do_not_mix() -> None:
    with connected() as (gripper, _, _, _):
        gripper.home()
        thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
        eventually(lambda: gripper.state().grasp == "positioning", "the move did not begin")
        with pytest.raises(SafetyError, match="in progress"):
            gripper.release(width=0.110, speed=0.1)
        gripper.stop()
        thread.join(PATIENT)
        assert len(errors) == 1 and "CMD_ABORTED" in str(errors[0])
        assert gripper.state().width > 0.09


def test_closing_in_mid_motion_stops_the_fingers() -> None:
    with connected() as (gripper, _, plant, _):
        gripper.home()
        thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
        eventually(lambda: gripper.state().grasp == "positioning", "the move did not begin")
        gripper.close()
        thread.join(PATIENT)
        assert errors
        width = plant.gripper_state()[0]
        time.sleep(0.05)
        assert plant.gripper_state()[0] == width > 0.09


def test_closing_while_a_part_is_held_does_not_stop_the_grip() -> None:
    with connected() as (gripper, server, plant, notes):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        gripper.close()
        assert notes.names[-2:] == ["grasp", "disconnect"]
        with WsgGripper(transport_for(server.addresses[0], clock=CLOCK), clock=CLOCK, config=CONFIG) as other:
            assert other.state().grasp == "holding" and other.state().force == 20
            with pytest.raises(SafetyError, match="may be held"):
                other.home()


def test_after_an_unannounced_end_the_next_session_finds_fast_stop_and_the_part() -> None:
    with mock() as (server, plant):
        relay = Relay(server.tcp_address, untouched)
        first = WsgGripper(transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=CONFIG)
        first.connect()
        first.home()
        plant.set_part(0.040)
        first.grasp(width=0.040, speed=0.4, force=20)
        relay.close()  # the cable is pulled
        with pytest.raises(PeerError, match=r"closed|broke"):
            await_trouble(first)
        with pytest.raises(PeerError, match=r"closed|broke"):
            first.move(width=0.05, speed=0.1)
        first.close()
        eventually(lambda: server.fast_stopped, "the device did not notice")
        with WsgGripper(transport_for(server.addresses[1], clock=CLOCK), clock=CLOCK, config=CONFIG) as second:
            assert second.state().fault == "FAST_STOP"
            second.acknowledge_fault()
            with pytest.raises(SafetyError, match="may be held"):  # idle by its own word, but it presses
                second.home()
            plant.set_part(None)
            second.home(part_removed=True)


def test_a_dry_run_sends_no_motion() -> None:
    with mock() as (server, plant):
        with WsgGripper(transport_for(server.addresses[1], clock=CLOCK), clock=CLOCK, config=CONFIG) as gripper:
            gripper.home()
        relay = Relay(server.tcp_address, untouched)
        notes = Notebook()
        dry = WsgConfig(reply_timeout=20, stale_after=20, dry_run=True)
        with WsgGripper(
            transport_for(relay.address, clock=CLOCK), clock=CLOCK, config=dry, on_command=notes.command
        ) as gripper:
            width = gripper.state().width
            gripper.home()
            gripper.grasp(width=0.1, speed=0.1, force=20)
            gripper.release(width=0.110, speed=0.1)
            gripper.move(width=0.1, speed=0.1)
            gripper.stop()
            with pytest.raises(SafetyError):
                gripper.move(width=0.2, speed=0.1)
        relay.close()
        assert notes.names == ["home", "grasp", "release", "move", "stop", "disconnect"]
        assert not MOTION_IDS & set(relay.ids()) and Command.SET_FORCE_LIMIT not in relay.ids()
        assert plant.gripper_state()[0] == pytest.approx(width)
        assert not server.fast_stopped


# ------------------------------------------------------------------ the recorder


def test_a_command_that_can_not_be_recorded_is_not_sent() -> None:
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


def test_a_measurement_that_can_not_be_recorded_ends_the_link_but_not_the_stop() -> None:
    full = threading.Event()

    def record(state: GripperState) -> None:
        if full.is_set():
            raise PeerError("the disk is full")

    with mock() as (server, plant):
        transport = transport_for(server.addresses[1], clock=CLOCK)
        with WsgGripper(transport, clock=CLOCK, config=CONFIG, on_measurement=record) as gripper:
            gripper.home()
            thread, errors = in_thread(lambda: gripper.move(width=0.010, speed=0.005))
            eventually(lambda: gripper.state().grasp == "positioning", "the move did not begin")
            full.set()
            thread.join(PATIENT)
            assert "disk is full" in str(errors[0])
            with pytest.raises(PeerError, match="disk is full"):
                gripper.state()
            eventually(lambda: plant.gripper_state()[1] == 0.0, "the fingers were not stopped")
            assert plant.gripper_state()[0] > 0.05
        eventually(lambda: not server.fast_stopped, "the disconnect was not announced")


# ------------------------------------------------------------------ spoilt bytes


def split(data: bytes) -> Iterable[bytes]:
    return (bytes([byte]) for byte in data)


def doubled(data: bytes) -> Iterable[bytes]:
    """Every frame twice."""
    parts = data.split(b"\xaa\xaa\xaa")
    yield parts[0] + b"".join(2 * (b"\xaa\xaa\xaa" + part) for part in parts[1:])


def with_garbage(data: bytes) -> Iterable[bytes]:
    yield b"\x00\xff\xaaxyz" + data.replace(b"\xaa\xaa\xaa", b"\x01\xaa\xaa\xaa\xaa") + b"\xaa\xaa"


@pytest.mark.parametrize("spoil", [split, doubled, with_garbage])
def test_spoilt_bytes_do_not_disturb(spoil: Spoil) -> None:
    with relayed(spoil) as (gripper, _, plant):
        gripper.home()
        plant.set_part(0.040)
        gripper.grasp(width=0.040, speed=0.4, force=20)
        assert gripper.state().grasp == "holding" and gripper.state().fault == ""
        gripper.release(width=0.1, speed=0.4)
        gripper.move(width=0.08, speed=0.4)
        assert gripper.state().width == pytest.approx(0.08, abs=3e-4)


def test_a_late_success_of_an_earlier_grasp_is_not_taken_for_this_one() -> None:
    late = reply(Command.GRASP, Status.SUCCESS).encode()

    def repeat(data: bytes) -> Iterable[bytes]:
        pending = reply(Command.GRASP, Status.CMD_PENDING).encode()
        return [data.replace(pending, late + pending)]

    with relayed(repeat) as (gripper, _, _):
        gripper.home()
        with pytest.raises(PeerRefused, match="CMD_FAILED"):
            gripper.grasp(width=0.040, speed=0.4, force=20)


def test_a_bad_checksum_is_a_fault_until_acknowledged() -> None:
    spoil = threading.Event()

    def once(data: bytes) -> Iterable[bytes]:
        if spoil.is_set() and len(data) > 8:
            spoil.clear()
            return [data[:-1] + bytes([data[-1] ^ 0x10])]
        return [data]

    with relayed(once) as (gripper, _, _):
        gripper.home()
        spoil.set()
        eventually(lambda: gripper.state().fault == "BAD_CHECKSUM", "the wrong checksum did not show")
        with pytest.raises(SafetyError, match="BAD_CHECKSUM"):
            gripper.move(width=0.1, speed=0.1)
        gripper.acknowledge_fault()
        gripper.move(width=0.1, speed=0.4)


class TimedTransport(TcpTransport):
    """A TCP connection that notes what is written, and when."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port, clock=CLOCK)
        self.writes: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        self.writes.append((CLOCK.now(), data))
        super().write(data)


def test_every_frame_goes_out_in_one_write_and_not_too_fast() -> None:
    with mock() as (server, _):
        transport = TimedTransport(*server.tcp_address)
        with WsgGripper(transport, clock=CLOCK, config=CONFIG) as gripper:
            gripper.home()
    written = [data for _, data in transport.writes]
    assert all(data[:3] == b"\xaa\xaa\xaa" and crc16(data) == 0 for data in written)
    assert [data[3] for data in written] == [
        *(Command.DEVICE_INFO, Command.LIMITS, *STATE_COMMANDS),
        *(Command.HOME, Command.STOP, Command.DISCONNECT),
    ]
    unhurried = [stamp for stamp, data in transport.writes[:-2]]
    assert min(b - a for a, b in itertools.pairwise(unhurried)) >= CONFIG.command_interval - 1e-6


# ------------------------------------------------------------------ peers that are not there


def test_a_closed_port_is_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    gripper = WsgGripper(transport_for(f"tcp:127.0.0.1:{port}", clock=CLOCK), clock=CLOCK)
    with pytest.raises(PeerError, match=f"tcp:127.0.0.1:{port}.*refused.*address") as caught:
        gripper.connect()
    assert "\n" not in str(caught.value)


def test_a_missing_or_wrong_device_file_is_one_clear_line(tmp_path: os.PathLike[str]) -> None:
    plain = os.path.join(tmp_path, "file")
    with open(plain, "w") as file:
        file.write("not a line")
    for path, reason in ((os.path.join(tmp_path, "none"), "no such device"), (plain, plain)):
        with pytest.raises(PeerError, match=reason) as caught:
            WsgGripper(transport_for(f"serial:{path}", clock=CLOCK), clock=CLOCK).connect()
        assert "\n" not in str(caught.value)


def test_one_line_serves_one_program() -> None:
    with connected() as (_, server, _, _), pytest.raises(PeerError, match="another program"):
        WsgGripper(transport_for(server.addresses[0], clock=CLOCK), clock=CLOCK).connect()


def test_silent_peers_time_out() -> None:
    quick = WsgConfig(reply_timeout=0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp:127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(PeerTimeout, match="DEVICE_INFO"):
            WsgGripper(transport_for(address, clock=CLOCK), clock=CLOCK, config=quick).connect()
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        address = f"serial:{os.ttyname(slave)}"
        with pytest.raises(PeerTimeout, match="DEVICE_INFO"):
            WsgGripper(transport_for(address, clock=CLOCK), clock=CLOCK, config=quick).connect()
    finally:
        os.close(master)
        os.close(slave)


def test_a_peer_that_falls_silent_in_mid_motion_times_out_and_is_told_to_stop() -> None:
    silent = threading.Event()

    def swallow(data: bytes) -> Iterable[bytes]:
        return [] if silent.is_set() else [data]

    impatient = WsgConfig(reply_timeout=2.0, move_timeout=6.0, home_timeout=50.0, stale_after=3.0)
    with relayed(swallow, config=impatient) as (gripper, relay, plant):
        gripper.home()
        silent.set()
        with pytest.raises(PeerTimeout, match="PRE_POSITION"):
            gripper.move(width=0.060, speed=0.02)
        assert relay.ids()[-2:] == [Command.PRE_POSITION, Command.STOP]
        eventually(lambda: plant.gripper_state()[1] == 0.0, "the fingers were not stopped")
        with pytest.raises(PeerTimeout, match="old"):
            gripper.state()


def test_a_device_that_is_no_gripper_is_named() -> None:
    def other_type(data: bytes) -> Iterable[bytes]:
        # Device info with type 2, and its checksum.
        return [bytes.fromhex("aaaaaa500a000000020100 04 bec30000") + b"\x00\x00"] if data[3:4] == b"\x50" else [data]

    config = WsgConfig(reply_timeout=20, stale_after=20, crc=False)
    with pytest.raises(PeerError, match="type 2"), relayed(other_type, config=config):
        pass
