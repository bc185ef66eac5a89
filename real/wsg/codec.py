"""The WSG-50's binary protocol as bytes: frames, checksum, commands and replies. No I/O.

A frame is `AA AA AA | id u8 | length u16 LE | payload | crc u16 LE`; a reply's payload starts with a status
u16 LE. The wire counts in mm, mm/s and mm/s²; everything above this module in metres.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from gelflow.errors import PeerError, UsageError
from gelflow.real.wsg.constants import LONGEST_PERIOD, SHORTEST_PERIOD, Command, Status, UpdateMode

PREAMBLE = b"\xaa\xaa\xaa"
HEADER = 6  # bytes before the payload
MM = 1e3  # mm in a metre
ACKNOWLEDGE_KEY = b"ack"


# What follows the status SUCCESS, as struct formats; commands that are not named here answer the status alone.
_REPLY_LAYOUT = {
    Command.GET_ACCELERATION: "<f",
    Command.GET_FORCE_LIMIT: "<f",
    Command.GET_SOFT_LIMITS: "<2f",
    Command.SYSTEM_STATE: "<I",
    Command.GRASP_STATE: "<B",
    Command.WIDTH: "<f",
    Command.SPEED: "<f",
    Command.FORCE: "<f",
    Command.TEMPERATURE: "<h",
    Command.DEVICE_INFO: "<BBHI",
    Command.LIMITS: "<8f",
}


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes, crc: int = 0xFFFF) -> int:
    """The device's own checksum: the table of the CCITT polynomial, but shifted right as it is updated.

    Over a whole frame with its checksum the result is 0.
    """
    for byte in data:
        crc = _CRC_TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc


@dataclass(frozen=True)
class Packet:
    """One message in either direction."""

    id: int
    payload: bytes = b""

    def encode(self, *, crc: bool = True) -> bytes:
        """The bytes on the wire; `crc=False` sends 00 00, for a device whose checking is off.

        Raises UsageError when id or payload don't fit.
        """
        if not 0 <= self.id <= 0xFF or len(self.payload) > 0xFFFF:
            raise UsageError(
                f"a frame holds an id of one byte and at most 65535 bytes, got id {self.id} and {len(self.payload)}"
            )
        head = PREAMBLE + struct.pack("<BH", self.id, len(self.payload)) + self.payload
        return head + struct.pack("<H", crc16(head) if crc else 0)


@dataclass(frozen=True)
class Corrupt:
    """Bytes that look like a frame of this id, but whose checksum is wrong."""

    id: int


Plausible = Callable[[int, int], bool]


class Decoder:
    """Bytes in, frames out, in any portions.

    Garbage is skipped and counted; a frame with a wrong checksum is told as `Corrupt`, and the search goes on one
    byte further, so that a good frame inside or behind it is still found. `plausible(id, payload length)` rejects
    false starts before their bytes are awaited. A start that never ends is given up by `expire`.
    """

    def __init__(self, *, plausible: Plausible, check_crc: bool = True) -> None:
        self._plausible = plausible
        self._check_crc = check_crc
        self._buffer = bytearray()
        self.discarded = 0  # bytes that belonged to no frame

    @property
    def waiting(self) -> int:
        """Bytes held back because they may become a frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet | Corrupt]:
        """Take bytes as they came, return what they completed."""
        self._buffer += data
        found: list[Packet | Corrupt] = []
        while self._step(found):
            pass
        return found

    def expire(self) -> list[Packet | Corrupt]:
        """Give up the frame that is awaited (its rest did not come in time) and search what came after its start."""
        if not self._buffer:
            return []
        self._drop(1)
        return self.feed(b"")

    def reset(self) -> None:
        """Forget what was received."""
        self._drop(len(self._buffer))

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self.discarded += count

    def _step(self, found: list[Packet | Corrupt]) -> bool:
        """Decide on the head of the buffer; False when more bytes are needed."""
        buffer = self._buffer
        start = buffer.find(PREAMBLE)
        if start < 0:
            # The last two bytes may be the beginning of a preamble.
            keep = 2 if buffer[-2:] == PREAMBLE[:2] else 1 if buffer[-1:] == PREAMBLE[:1] else 0
            self._drop(len(buffer) - keep)
            return False
        self._drop(start)
        if len(buffer) < HEADER:
            if len(buffer) > 3 and buffer[3] == PREAMBLE[0]:
                self._drop(1)  # one AA too many: no command has this id
                return True
            return False
        command, length = struct.unpack_from("<BH", buffer, 3)
        if command == PREAMBLE[0] or not self._plausible(command, length):
            self._drop(1)
            return True
        total = HEADER + length + 2
        if len(buffer) < total:
            return False
        raw = bytes(buffer[:total])
        unchecked = not self._check_crc and raw[-2:] == b"\0\0"
        if not unchecked and crc16(raw) != 0:
            found.append(Corrupt(command))
            self._drop(1)
            return True
        found.append(Packet(command, raw[HEADER:-2]))
        del buffer[:total]
        return True


def plausible_reply(command: int, length: int) -> bool:
    """Whether a reply of this id may have a payload of this length: the status alone, or status and values."""
    if command == Command.LOOP:
        return 2 <= length <= 258
    try:
        layout = _REPLY_LAYOUT.get(Command(command), "<")
    except ValueError:
        return False
    return length in (2, 2 + struct.calcsize(layout))


def plausible_request(command: int, length: int) -> bool:
    """Whether a device should wait for a request of this length; ids it does not know may come too."""
    return length <= 258 if command == Command.LOOP else length <= 64


@dataclass(frozen=True)
class Reply:
    """A device's answer."""

    command: Command
    status: Status
    data: bytes = b""

    def values(self) -> tuple[float, ...]:
        """The numbers behind the status, in the wire's units. Raises PeerError when they are missing or not finite."""
        layout = _REPLY_LAYOUT.get(self.command, "<")
        if len(self.data) != struct.calcsize(layout):
            raise PeerError(
                f"the gripper answered {self.command.name} with {len(self.data)} bytes of data, "
                f"expected {struct.calcsize(layout)}: is it a WSG-50?"
            )
        values = struct.unpack(layout, self.data)
        if not all(math.isfinite(value) for value in values):
            raise PeerError(f"the gripper answered {self.command.name} with {values}, which is not a number")
        return values

    def encode(self, *, crc: bool = True) -> bytes:
        """The bytes on the wire (the device's side)."""
        return Packet(self.command, struct.pack("<H", self.status) + self.data).encode(crc=crc)


def reply(command: Command, status: Status, *values: float) -> Reply:
    """A reply with values in the wire's units (the device's side)."""
    return Reply(command, status, struct.pack(_REPLY_LAYOUT.get(command, "<"), *values) if values else b"")


def parse_reply(frame: Packet) -> Reply:
    """A received frame as a reply. Raises PeerError when id or status is not in the tables."""
    try:
        command = Command(frame.id)
    except ValueError:
        raise PeerError(f"the gripper sent id {frame.id:#04x}, which no command has: is it a WSG-50?") from None
    if len(frame.payload) < 2:
        raise PeerError(f"the gripper answered {command.name} without a status: is it a WSG-50?")
    (code,) = struct.unpack_from("<H", frame.payload)
    try:
        return Reply(command, Status(code), frame.payload[2:])
    except ValueError:
        raise PeerError(f"the gripper answered {command.name} with status {code}, expected 0 to 30") from None


def home(direction: int) -> Packet:
    """Reference the fingers: 0 as the device is set up, 1 outwards, 2 inwards."""
    return Packet(Command.HOME, struct.pack("<B", direction))


def pre_position(width: float, speed: float) -> Packet:
    """Move to `width` [m] at `speed` [m/s]. The flags are always 0: their bits are read in opposite ways."""
    return Packet(Command.PRE_POSITION, struct.pack("<Bff", 0, width * MM, speed * MM))


def grasp(width: float, speed: float) -> Packet:
    """Grasp a part of nominal `width` [m] at `speed` [m/s]."""
    return Packet(Command.GRASP, struct.pack("<ff", width * MM, speed * MM))


def release(width: float, speed: float) -> Packet:
    """Let a part go: move to `width` [m] at `speed` [m/s]."""
    return Packet(Command.RELEASE, struct.pack("<ff", width * MM, speed * MM))


def acknowledge() -> Packet:
    """Leave FAST STOP."""
    return Packet(Command.ACKNOWLEDGE, ACKNOWLEDGE_KEY)


def set_force_limit(force: float) -> Packet:
    """Limit the grasping force [N]."""
    return Packet(Command.SET_FORCE_LIMIT, struct.pack("<f", force))


def request_updates(command: Command, mode: UpdateMode, period: float) -> Packet:
    """Ask for a state value; `period` [s] is the interval, or the shortest one for ON_CHANGE.

    Raises UsageError outside 0.010 to 9.999 s.
    """
    if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
        raise UsageError(f"the period of updates must be {SHORTEST_PERIOD} to {LONGEST_PERIOD} s, got {period}")
    return Packet(command, struct.pack("<BH", mode, round(period * MM)))
