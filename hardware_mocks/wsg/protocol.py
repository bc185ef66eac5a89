"""Device side of the WSG-50's binary protocol, without I/O: bytes of a client in, replies and updates out.

A device has any number of sessions (a serial line, a TCP client), each with its own decoder and updates; the result of
a motion goes to the session that started it.
"""

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gelflow.clock import Clock
from gelflow.hardware_mocks.plant import GripperPlant
from gelflow.hardware_mocks.wsg.finger_controller import FingerController, MockWsgConfig
from gelflow.real.wsg.codec import (
    ACKNOWLEDGE_KEY,
    MM,
    Corrupt,
    Decoder,
    Packet,
    Reply,
    plausible_request,
    reply,
)
from gelflow.real.wsg.constants import (
    LONGEST_PERIOD,
    MOTIONS,
    SHORTEST_PERIOD,
    STATE_COMMANDS,
    Command,
    Status,
    UpdateMode,
)

_PACKET_TIMEOUT = 0.5  # an incomplete packet is abandoned after this time [s]

_WSG_50, _FIRMWARE = 1, 0x0400  # device type and firmware version

# Struct formats of the request payloads; commands that are not listed have none.
_REQUEST_LAYOUT = {
    Command.HOME: "<B",
    Command.PRE_POSITION: "<Bff",
    Command.ACKNOWLEDGE: "<3s",
    Command.GRASP: "<ff",
    Command.RELEASE: "<ff",
    Command.SET_ACCELERATION: "<f",
    Command.SET_FORCE_LIMIT: "<f",
    Command.SET_SOFT_LIMITS: "<ff",
    Command.SYSTEM_STATE: "<BH",
    Command.GRASP_STATE: "<BH",
    Command.WIDTH: "<BH",
    Command.SPEED: "<BH",
    Command.FORCE: "<BH",
    Command.TEMPERATURE: "<BH",
}


@dataclass
class _Update:
    mode: UpdateMode
    period: float  # [s]
    due: float
    last: bytes


class WsgDevice:
    """The mock device. Thread-safe."""

    def __init__(self, plant: GripperPlant, *, clock: Clock, config: MockWsgConfig | None = None) -> None:
        self.clock = clock
        self.config = config or MockWsgConfig()
        self.fingers = FingerController(plant, self.config)
        self.lock = threading.RLock()
        self._owner: WsgSession | None = None
        self._frozen: dict[int, dict[Command, float]] = {}  # state values that a fault repeats, by its number

    def freeze(self, number: int) -> None:
        """Report the present state values until `unfreeze(number)`."""
        with self.lock:
            self._frozen[number] = self._state_values()

    def unfreeze(self, number: int) -> None:
        """End the fault with this number."""
        with self.lock:
            self._frozen.pop(number, None)

    def poll(self) -> None:
        """Advance the motion in progress; its result goes to the session that started it."""
        with self.lock:
            if ended := self.fingers.poll(self.clock.now()):
                self._finish(*ended)

    def start(self, session: "WsgSession", command: Command, values: tuple[float, ...]) -> Status:
        """Start a motion for a session; returns PENDING or the reason of a refusal."""
        now = self.clock.now()
        if command == Command.HOME:
            status = self.fingers.home(int(values[0]), now)
        elif command == Command.PRE_POSITION and values[0] != 0:
            status = Status.INVALID_PARAMETER  # drivers disagree on the meaning of the flags
        else:
            width, speed = values[-2:]
            status = self.fingers.travel(command, width / MM, speed / MM, now)
        if status == Status.CMD_PENDING:
            self._owner = session
        return status

    def stop(self, *, fast: bool = False) -> None:
        """Stop the fingers; `fast` also locks them."""
        with self.lock:
            ended = self.fingers.fast_stop() if fast else self.fingers.stop()
            if ended is not None:
                self._finish(*ended)

    def state_reply(self, command: Command) -> Reply:
        """The reply to a request of a state value."""
        values = next(iter(self._frozen.values()), None) or self._state_values()
        return reply(command, Status.SUCCESS, values[command])

    def _state_values(self) -> dict[Command, float]:
        width, speed, force = self.fingers.measured
        return {
            Command.SYSTEM_STATE: int(self.fingers.flags()),
            Command.GRASP_STATE: int(self.fingers.grasp),
            Command.WIDTH: width * MM,
            Command.SPEED: speed * MM,
            Command.FORCE: force,
            Command.TEMPERATURE: 312,
        }

    def _finish(self, command: Command, status: Status) -> None:
        if self._owner is not None:
            self._owner.send(reply(command, status))
        self._owner = None


class WsgSession:
    """The session of one client with the device."""

    def __init__(self, device: WsgDevice) -> None:
        self._device = device
        self._decoder = Decoder(plausible=plausible_request, check_crc=device.config.crc)
        self._updates: dict[Command, _Update] = {}
        self._outbox: list[bytes] = []
        self._last_bytes = 0.0
        self._last_command = -float("inf")
        self.announced = False  # the client has announced its disconnect
        self._handlers = self._table()

    def _table(self) -> dict[Command, Callable[[Command, tuple[Any, ...]], Reply]]:
        groups: dict[tuple[Command, ...], Callable[[Command, tuple[Any, ...]], Reply]] = {
            (Command.DISCONNECT,): self._disconnect,
            MOTIONS: self._motion,
            (Command.STOP, Command.FAST_STOP): self._stop,
            (Command.ACKNOWLEDGE,): self._acknowledge,
            (Command.SET_ACCELERATION, Command.GET_ACCELERATION): self._acceleration,
            (Command.SET_FORCE_LIMIT, Command.GET_FORCE_LIMIT): self._force_limit,
            (Command.SET_SOFT_LIMITS, Command.GET_SOFT_LIMITS, Command.CLEAR_SOFT_LIMITS): self._soft_limits,
            (Command.TARE_FORCE,): self._tare,
            (*STATE_COMMANDS, Command.TEMPERATURE): self._state,
            (Command.DEVICE_INFO, Command.LIMITS): self._description,
        }
        return {command: handler for commands, handler in groups.items() for command in commands}

    def receive(self, data: bytes) -> None:
        """Process bytes from the client, in portions of any size."""
        with self._device.lock:
            self._last_bytes = self._device.clock.now()
            self._handle(self._decoder.feed(data))

    def tick(self) -> list[bytes]:
        """Replies and due updates for the client, one packet each."""
        with self._device.lock:
            now = self._device.clock.now()
            if self._decoder.waiting and now - self._last_bytes > _PACKET_TIMEOUT:
                self._last_bytes = now
                self._handle(self._decoder.expire())
            for command, update in self._updates.items():
                if now >= update.due:
                    self._update(command, update, now)
            packets, self._outbox = self._outbox, []
            return packets

    def send(self, answer: Reply) -> None:
        """Queue a reply."""
        self._outbox.append(answer.encode(crc=self._device.config.crc))

    def lost(self) -> None:
        """Handle the end of the connection; an unannounced end is a fault."""
        if not self.announced and self._device.config.fast_stop_on_disconnect:
            self._device.stop(fast=True)

    def _handle(self, events: list[Packet | Corrupt]) -> None:
        for event in events:
            try:
                command = Command(event.id)
            except ValueError:
                payload = struct.pack("<H", Status.CMD_UNKNOWN)
                self._outbox.append(Packet(event.id, payload).encode(crc=self._device.config.crc))
                continue
            if isinstance(event, Corrupt):
                self.send(reply(command, Status.CHECKSUM_ERROR))
            else:
                self.send(self._answer(command, event.payload))

    def _answer(self, command: Command, payload: bytes) -> Reply:
        now = self._device.clock.now()
        since, self._last_command = now - self._last_command, now
        config = self._device.config
        at_any_rate = config.stops_at_any_rate and command in (Command.STOP, Command.FAST_STOP)
        if since < config.shortest_command_interval and not at_any_rate:
            return reply(command, Status.OVERRUN)
        self.announced = command == Command.DISCONNECT
        if command == Command.LOOP:
            return Reply(command, Status.SUCCESS, payload)
        if command == Command.TEMPERATURE and not payload:
            return self._device.state_reply(command)
        layout = _REQUEST_LAYOUT.get(command, "<")
        expected = struct.calcsize(layout)
        if len(payload) != expected:
            if not expected:
                return reply(command, Status.NO_PARAM_EXPECTED)
            short = len(payload) < expected
            return reply(command, Status.NOT_ENOUGH_PARAMS if short else Status.CMD_FORMAT_ERROR)
        return self._handlers[command](command, struct.unpack(layout, payload))

    def _update(self, command: Command, update: _Update, now: float) -> None:
        answer = self._device.state_reply(command)
        if update.mode == UpdateMode.ON_CHANGE:
            if answer.data == update.last:
                return
            update.due = now + update.period
        else:
            # A late tick does not shift the schedule, and at most one missed update is made up for.
            update.due = max(update.due + update.period, now)
        update.last = answer.data
        self.send(answer)

    def _state(self, command: Command, values: tuple[float, ...]) -> Reply:
        mode, period = int(values[0]), values[1] / MM
        answer = self._device.state_reply(command)
        if mode == UpdateMode.ONCE:
            self._updates.pop(command, None)
            return answer
        if mode not in list(UpdateMode):
            return reply(command, Status.INVALID_PARAMETER)
        if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
            return reply(command, Status.RANGE_ERROR)
        due = self._device.clock.now() + period
        self._updates[command] = _Update(UpdateMode(mode), period, due, answer.data)
        return answer

    def _disconnect(self, command: Command, _: tuple[float, ...]) -> Reply:
        self._updates.clear()
        return reply(command, Status.SUCCESS)

    def _motion(self, command: Command, values: tuple[float, ...]) -> Reply:
        return reply(command, self._device.start(self, command, values))

    def _stop(self, command: Command, _: tuple[float, ...]) -> Reply:
        self._device.stop(fast=command == Command.FAST_STOP)
        return reply(command, Status.SUCCESS)

    def _acknowledge(self, command: Command, values: tuple[Any, ...]) -> Reply:
        (key,) = values
        if key != ACKNOWLEDGE_KEY:
            return reply(command, Status.INVALID_PARAMETER)
        self._device.fingers.acknowledge()
        return reply(command, Status.SUCCESS)

    def _acceleration(self, command: Command, values: tuple[float, ...]) -> Reply:
        fingers = self._device.fingers
        if command == Command.GET_ACCELERATION:
            return reply(command, Status.SUCCESS, fingers.acceleration * MM)
        lowest, highest = self._device.config.acceleration
        if not lowest <= values[0] / MM <= highest:
            return reply(command, Status.RANGE_ERROR)
        fingers.acceleration = values[0] / MM
        return reply(command, Status.SUCCESS)

    def _force_limit(self, command: Command, values: tuple[float, ...]) -> Reply:
        fingers = self._device.fingers
        if command == Command.GET_FORCE_LIMIT:
            return reply(command, Status.SUCCESS, fingers.force_limit)
        lowest, nominal, _ = self._device.config.force
        if not lowest <= values[0] <= nominal:
            return reply(command, Status.RANGE_ERROR)
        fingers.force_limit = values[0]
        return reply(command, Status.SUCCESS)

    def _soft_limits(self, command: Command, values: tuple[float, ...]) -> Reply:
        fingers = self._device.fingers
        if command == Command.GET_SOFT_LIMITS:
            low, high = fingers.soft_limits or (0.0, self._device.config.stroke)
            return reply(command, Status.SUCCESS, low * MM, high * MM)
        if command == Command.CLEAR_SOFT_LIMITS:
            fingers.soft_limits = None
            return reply(command, Status.SUCCESS)
        low, high = (value / MM for value in values)
        if not 0 <= low < high <= self._device.config.stroke + 1e-7:
            return reply(command, Status.RANGE_ERROR)
        fingers.soft_limits = low, high
        return reply(command, Status.SUCCESS)

    def _tare(self, command: Command, _: tuple[float, ...]) -> Reply:
        return reply(command, Status.NOT_AVAILABLE)  # requires force-measuring fingers

    def _description(self, command: Command, _: tuple[float, ...]) -> Reply:
        config = self._device.config
        if command == Command.DEVICE_INFO:
            return reply(command, Status.SUCCESS, _WSG_50, 1, _FIRMWARE, config.serial_number)
        lengths = (config.stroke, *config.speed, *config.acceleration)
        return reply(command, Status.SUCCESS, *(value * MM for value in lengths), *config.force)
