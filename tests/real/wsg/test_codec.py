"""WSG-50 codec: known packets, and the decoder with arbitrary data."""

import itertools
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gelflow.errors import PeerError, UsageError
from gelflow.real.wsg import codec
from gelflow.real.wsg.codec import (
    Corrupt,
    Decoder,
    Packet,
    Reply,
    crc16,
    parse_reply,
    plausible_reply,
    plausible_request,
)
from gelflow.real.wsg.constants import Command, GraspState, Status, UpdateMode

KNOWN_REQUESTS = {
    "aa aa aa 20 01 00 00 8f 83": codec.home(0),
    "aa aa aa 24 03 00 61 63 6b dc b9": codec.acknowledge(),
    "aa aa aa 21 09 00 00 00 00 a0 42 00 00 c8 42 ca e3": codec.pre_position(0.080, 0.100),
    "aa aa aa 22 00 00 0e 76": Packet(Command.STOP),
    "aa aa aa 43 03 00 01 14 00 36 8d": codec.request_updates(Command.WIDTH, UpdateMode.PERIODIC, 0.020),
}
KNOWN_REPLIES = {
    "aa aa aa 20 02 00 1a 00 fc 32": codec.reply(Command.HOME, Status.CMD_PENDING),
    "aa aa aa 43 06 00 00 00 00 00 48 42 62 ff": codec.reply(Command.WIDTH, Status.SUCCESS, 50.0),
}


@pytest.mark.parametrize("text", [*KNOWN_REQUESTS, *KNOWN_REPLIES])
def test_known_packets_are_encoded_and_decoded(text: str) -> None:
    raw = bytes.fromhex(text)
    message = KNOWN_REQUESTS.get(text) or KNOWN_REPLIES[text]
    assert message.encode() == raw
    assert crc16(raw) == 0
    (event,) = Decoder(plausible=plausible_request if text in KNOWN_REQUESTS else plausible_reply).feed(raw)
    assert isinstance(event, Packet)
    if isinstance(message, Reply):
        assert parse_reply(event) == message
    else:
        assert event == message


def test_checksum_differs_from_ccitt_false() -> None:
    assert crc16(b"\xaa\xaa\xaa") == 0x50F5
    assert crc16(b"123456789") != 0x29B1  # check value of CCITT-FALSE


def test_zeros_replace_the_checksum_when_it_is_switched_off() -> None:
    raw = codec.home(1).encode(crc=False)
    assert raw[-2:] == b"\0\0"
    assert Decoder(plausible=plausible_request, check_crc=False).feed(raw) == [codec.home(1)]
    assert Decoder(plausible=plausible_request).feed(raw) == [Corrupt(Command.HOME)]


def test_lengths_are_encoded_in_millimetres() -> None:
    assert struct.unpack("<ff", codec.grasp(0.0255, 0.03).payload) == pytest.approx((25.5, 30.0))
    assert struct.unpack("<ff", codec.release(0.11, 0.42).payload) == (110.0, 420.0)
    assert codec.pre_position(0.05, 0.1).payload[0] == 0  # flags
    assert codec.set_force_limit(40.0).payload == struct.pack("<f", 40.0)


def test_status_and_grasp_state_names() -> None:
    assert [status.value for status in Status] == list(range(31))
    assert Status(18) is Status.CMD_FAILED and Status(29) is Status.AXIS_BLOCKED and Status(26) is Status.CMD_PENDING
    labels = ["idle", "grasping", "no part", "part lost", "holding", "releasing", "positioning", "error"]
    assert [state.label for state in GraspState] == labels


@pytest.mark.parametrize("period", [0.009, 10.0, -1.0, math.nan])
def test_period_outside_the_device_range_is_refused(period: float) -> None:
    with pytest.raises(UsageError, match="period"):
        codec.request_updates(Command.WIDTH, UpdateMode.PERIODIC, period)


def test_packet_with_too_large_id_or_payload_is_refused() -> None:
    for packet in (Packet(256), Packet(-1), Packet(Command.LOOP, bytes(65536))):
        with pytest.raises(UsageError):
            packet.encode()


def test_unknown_replies_raise_peer_error() -> None:
    for packet, text in (
        (Packet(0x99, b"\0\0"), "0x99"),
        (Packet(Command.STOP, b"\0"), "without a status"),
        (Packet(Command.STOP, struct.pack("<H", 31)), "status 31"),
    ):
        with pytest.raises(PeerError, match=text):
            parse_reply(packet)
    with pytest.raises(PeerError, match="4"):
        Reply(Command.WIDTH, Status.SUCCESS, b"").values()
    with pytest.raises(PeerError, match="not a number"):
        codec.reply(Command.WIDTH, Status.SUCCESS, math.nan).values()


# Decoder with arbitrary data

PACKETS = st.one_of(
    st.sampled_from([codec.reply(c, Status.CMD_PENDING).encode() for c in Command]),
    st.floats(0, 110, width=32).map(lambda width: codec.reply(Command.WIDTH, Status.SUCCESS, width).encode()),
    st.integers(0, 2**32 - 1).map(lambda flags: codec.reply(Command.SYSTEM_STATE, Status.SUCCESS, flags).encode()),
    st.binary(max_size=40).map(lambda data: Reply(Command.LOOP, Status.SUCCESS, data).encode()),
)


def split(data: bytes, positions: list[int]) -> list[bytes]:
    edges = [0, *sorted(position % (len(data) + 1) for position in positions), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def decoded(chunks: list[bytes]) -> list[Packet | Corrupt]:
    decoder = Decoder(plausible=plausible_reply)
    return [event for chunk in chunks for event in decoder.feed(chunk)]


@given(st.lists(PACKETS, max_size=8), st.lists(st.integers(0, 10_000), max_size=30))
def test_packets_are_decoded_from_portions_of_any_size(packets: list[bytes], positions: list[int]) -> None:
    events = decoded(split(b"".join(packets), positions))
    assert [event.encode() for event in events if isinstance(event, Packet)] == packets


@given(PACKETS, st.binary(max_size=60), st.lists(st.integers(0, 10_000), max_size=20))
def test_packet_after_garbage_is_decoded(packet: bytes, garbage: bytes, positions: list[int]) -> None:
    decoder = Decoder(plausible=plausible_reply)
    events = [event for chunk in split(garbage + packet, positions) for event in decoder.feed(chunk)]
    for _ in range(len(garbage) + len(packet)):  # the time-out of a packet announced by garbage
        if not decoder.waiting:
            break
        events += decoder.expire()
    assert any(isinstance(event, Packet) and event.encode() == packet for event in events)


@given(st.lists(st.binary(max_size=50), max_size=20))
def test_garbage_neither_blocks_nor_yields_packets_with_a_wrong_checksum(chunks: list[bytes]) -> None:
    decoder = Decoder(plausible=plausible_reply)
    for chunk in chunks:
        for event in decoder.feed(chunk):
            assert isinstance(event, Corrupt) or crc16(event.encode()) == 0
        assert decoder.waiting <= 258 + 8 + len(chunk)
    before = decoder.waiting
    for _ in range(before):
        decoder.expire()
    assert decoder.waiting == 0


@given(PACKETS, st.integers(0, 10_000), st.integers(1, 255))
def test_changed_byte_is_always_detected(packet: bytes, position: int, change: int) -> None:
    bad = bytearray(packet)
    bad[position % len(packet)] ^= change
    assert not any(isinstance(event, Packet) and event.encode() == packet for event in decoded([bytes(bad)]))
    good = codec.reply(Command.FORCE, Status.SUCCESS, 12.5).encode()
    decoder = Decoder(plausible=plausible_reply)
    events = decoder.feed(bytes(bad) + good)
    while decoder.waiting:
        events += decoder.expire()
    assert any(isinstance(event, Packet) and event.encode() == good for event in events)


@given(PACKETS, st.integers(1, 10_000))
def test_incomplete_packet_does_not_hide_the_next_one(packet: bytes, length: int) -> None:
    half = packet[: length % len(packet)]
    good = codec.reply(Command.WIDTH, Status.SUCCESS, 42.0).encode()
    decoder = Decoder(plausible=plausible_reply)
    events = decoder.feed(half + good)
    while decoder.waiting:
        events += decoder.expire()
    assert any(isinstance(event, Packet) and event.encode() == good for event in events)


def test_duplicates_are_two_packets_and_an_extra_preamble_byte_is_ignored() -> None:
    packet = codec.reply(Command.WIDTH, Status.SUCCESS, 50.0).encode()
    assert len(decoded([packet + packet])) == 2
    assert decoded([b"\xaa" + packet]) == decoded([packet])
    assert decoded([bytes([byte]) for byte in b"\xaa\xaa" + packet]) == decoded([packet])


def test_implausible_length_is_not_awaited() -> None:
    packet = codec.reply(Command.WIDTH, Status.SUCCESS, 50.0).encode()
    huge = b"\xaa\xaa\xaa\x43\xff\xff"
    decoder = Decoder(plausible=plausible_reply)
    assert len(decoder.feed(huge + packet)) == 1
    assert decoder.discarded == len(huge) and decoder.waiting == 0
