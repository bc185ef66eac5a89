"""The WSG-50's binary protocol as bytes: packets, checksum, commands and replies. No I/O.

A packet is `AA AA AA | id u8 | length u16 LE | payload | crc u16 LE`; the payload of a reply starts with a status
u16 LE. Units on the wire are mm, mm/s and mm/s²; this module converts them to and from metres.
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


# Struct formats of the values after the status SUCCESS; replies to other commands contain the status alone.
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
    """Checksum of the device: the CCITT polynomial's table, with the register shifted right.

    The result over a whole packet including its checksum is 0.
    """
    for byte in data:
        crc = _CRC_TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc


@dataclass(frozen=True)
class Packet:
    """One protocol packet, in either direction."""

    id: int
    payload: bytes = b""

    def encode(self, *, crc: bool = True) -> bytes:
        """The bytes on the wire; `crc=False` sends 00 00 for a device whose checksum is switched off.

        Raises UsageError when the id or the payload is too large.
        """
        if not 0 <= self.id <= 0xFF or len(self.payload) > 0xFFFF:
            raise UsageError(
                "a packet has an id of one byte and at most 65535 bytes of payload, "
                f"got id {self.id} and {len(self.payload)} bytes"
            )
        head = PREAMBLE + struct.pack("<BH", self.id, len(self.payload)) + self.payload
        return head + struct.pack("<H", crc16(head) if crc else 0)


@dataclass(frozen=True)
class Corrupt:
    """A packet of this id with a wrong checksum."""

    id: int


Plausible = Callable[[int, int], bool]


class Decoder:
    """Incremental decoder: bytes in portions of any size in, packets out.

    Garbage is skipped and counted. A packet with a wrong checksum is reported as `Corrupt`, and the search continues
    one byte further, so that a valid packet inside or after it is still decoded. `plausible(id, payload length)`
    rejects false preambles before their bytes are awaited. `expire` abandons an incomplete packet.
    """

    def __init__(self, *, plausible: Plausible, check_crc: bool = True) -> None:
        self._plausible = plausible
        self._check_crc = check_crc
        self._buffer = bytearray()
        self.discarded = 0  # bytes that belonged to no packet

    @property
    def waiting(self) -> int:
        """Number of bytes of an incomplete packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet | Corrupt]:
        """Add received bytes; returns the packets that they complete."""
        self._buffer += data
        packets: list[Packet | Corrupt] = []
        while self._step(packets):
            pass
        return packets

    def expire(self) -> list[Packet | Corrupt]:
        """Abandon the incomplete packet, whose remainder is late, and decode the bytes after its first one."""
        if not self._buffer:
            return []
        self._drop(1)
        return self.feed(b"")

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self.discarded += count

    def _step(self, packets: list[Packet | Corrupt]) -> bool:
        """Decode the head of the buffer; False when more bytes are needed."""
        buffer = self._buffer
        start = buffer.find(PREAMBLE)
        if start < 0:
            # The last two bytes may be the start of a preamble.
            keep = 2 if buffer[-2:] == PREAMBLE[:2] else 1 if buffer[-1:] == PREAMBLE[:1] else 0
            self._drop(len(buffer) - keep)
            return False
        self._drop(start)
        if len(buffer) < HEADER:
            if len(buffer) > 3 and buffer[3] == PREAMBLE[0]:
                self._drop(1)  # an extra AA: no command has this id
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
            packets.append(Corrupt(command))
            self._drop(1)
            return True
        packets.append(Packet(command, raw[HEADER:-2]))
        del buffer[:total]
        return True


def plausible_reply(command: int, length: int) -> bool:
    """Whether a reply with this id can have a payload of this length: the status alone, or status and values."""
    if command == Command.LOOP:
        return 2 <= length <= 258
    try:
        layout = _REPLY_LAYOUT.get(Command(command), "<")
    except ValueError:
        return False
    return length in (2, 2 + struct.calcsize(layout))


def plausible_request(command: int, length: int) -> bool:
    """Whether a device should wait for a request of this length; unknown ids are plausible."""
    return length <= 258 if command == Command.LOOP else length <= 64


@dataclass(frozen=True)
class Reply:
    """A reply of the device."""

    command: Command
    status: Status
    data: bytes = b""

    def values(self) -> tuple[float, ...]:
        """The values after the status, in the wire's units. Raises PeerError when they are missing or not finite."""
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
        """The bytes on the wire (sent by the device)."""
        return Packet(self.command, struct.pack("<H", self.status) + self.data).encode(crc=crc)


def reply(command: Command, status: Status, *values: float) -> Reply:
    """A reply with values in the wire's units (sent by the device)."""
    return Reply(command, status, struct.pack(_REPLY_LAYOUT.get(command, "<"), *values) if values else b"")


def parse_reply(packet: Packet) -> Reply:
    """A received packet as a reply. Raises PeerError when the id or the status is unknown."""
    try:
        command = Command(packet.id)
    except ValueError:
        raise PeerError(f"the gripper sent the unknown id {packet.id:#04x}: is it a WSG-50?") from None
    if len(packet.payload) < 2:
        raise PeerError(f"the gripper answered {command.name} without a status: is it a WSG-50?")
    (code,) = struct.unpack_from("<H", packet.payload)
    try:
        return Reply(command, Status(code), packet.payload[2:])
    except ValueError:
        raise PeerError(f"the gripper answered {command.name} with status {code}, expected 0 to 30") from None


def home(direction: int) -> Packet:
    """Reference the fingers: 0 in the direction set on the device, 1 outwards, 2 inwards."""
    return Packet(Command.HOME, struct.pack("<B", direction))


def pre_position(width: float, speed: float) -> Packet:
    """Move to `width` [m] at `speed` [m/s]. The flags are 0, because sources disagree on the meaning of their bits."""
    return Packet(Command.PRE_POSITION, struct.pack("<Bff", 0, width * MM, speed * MM))


def grasp(width: float, speed: float) -> Packet:
    """Grasp a part of nominal `width` [m] at `speed` [m/s]."""
    return Packet(Command.GRASP, struct.pack("<ff", width * MM, speed * MM))


def release(width: float, speed: float) -> Packet:
    """Release a part: move to `width` [m] at `speed` [m/s]."""
    return Packet(Command.RELEASE, struct.pack("<ff", width * MM, speed * MM))


def acknowledge() -> Packet:
    """Leave FAST STOP."""
    return Packet(Command.ACKNOWLEDGE, ACKNOWLEDGE_KEY)


def set_force_limit(force: float) -> Packet:
    """Limit the grasping force [N]."""
    return Packet(Command.SET_FORCE_LIMIT, struct.pack("<f", force))


def request_updates(command: Command, mode: UpdateMode, period: float) -> Packet:
    """Request a state value; `period` [s] is the interval, for ON_CHANGE the shortest interval.

    Raises UsageError outside 0.010 to 9.999 s.
    """
    if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
        raise UsageError(f"the period of updates must be {SHORTEST_PERIOD} to {LONGEST_PERIOD} s, got {period}")
    return Packet(command, struct.pack("<BH", mode, round(period * MM)))
