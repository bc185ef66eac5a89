"""Faults of messages, without a wire: datagrams may overtake each other, bytes of a stream may not."""

import pytest

from gelflow.hardware_mocks.message_faults import MESSAGE_KINDS, MessageFault, MessageFaults

MESSAGES = [bytes([65 + i]) * 8 for i in range(6)]


def passed(fault: MessageFault, *, ordered: bool, end: bool = True) -> list[tuple[float, bytes]]:
    """Arrival times and bytes of six messages sent at 0, 1, … s."""
    link = MessageFaults(ordered=ordered)
    link.begin(0, fault)
    arrived: list[tuple[float, bytes]] = []
    for tenth in range(200):
        now = tenth / 10
        if tenth % 10 == 0 and tenth < 60:
            link.put(MESSAGES[tenth // 10], now)
        if tenth == 60 and end:
            link.end(0)
        arrived += [(now, message) for message in link.take(now)]
    return arrived


def test_without_a_fault_every_message_passes_at_once() -> None:
    link = MessageFaults(ordered=True)
    link.put(b"a", 1.0)
    assert link.next_due == 1.0 and link.take(1.0) == [b"a"] and link.next_due == float("inf")


def test_dropped_messages_are_missing() -> None:
    assert passed(MessageFault("drop"), ordered=False) == []
    some = passed(MessageFault("drop", share=0.5, seed=1), ordered=False)
    assert 0 < len(some) < 6 and all(message in MESSAGES for _, message in some)


@pytest.mark.parametrize("ordered", [True, False])
def test_delayed_messages_arrive_later(ordered: bool) -> None:
    assert passed(MessageFault("delay", delay=0.5), ordered=ordered) == [(i + 0.5, MESSAGES[i]) for i in range(6)]


def test_delayed_datagrams_are_overtaken_and_bytes_of_a_stream_are_not() -> None:
    fault = {"kind": "delay", "delay": 2.5, "share": 0.5, "seed": 3}
    datagrams = [message for _, message in passed(MessageFault(**fault), ordered=False)]  # type: ignore[arg-type]
    stream = [message for _, message in passed(MessageFault(**fault), ordered=True)]  # type: ignore[arg-type]
    assert sorted(datagrams) == MESSAGES and datagrams != MESSAGES
    assert stream == MESSAGES


def test_duplicated_messages_arrive_twice() -> None:
    arrived = passed(MessageFault("duplicate"), ordered=False)
    assert arrived == [(float(i), MESSAGES[i]) for i in range(6) for _ in (0, 1)]


def test_reordered_messages_arrive_after_the_next_one() -> None:
    arrived = [message for _, message in passed(MessageFault("reorder", share=0.5, seed=2), ordered=False)]
    assert sorted(arrived) == MESSAGES and arrived != MESSAGES
    last = [message for _, message in passed(MessageFault("reorder"), ordered=False)]
    assert sorted(last) == MESSAGES  # a message that was kept back arrives when the fault ends


def test_corrupt_messages_differ_in_the_given_number_of_bytes() -> None:
    for (_, message), sent in zip(passed(MessageFault("corrupt", count=3), ordered=False), MESSAGES, strict=True):
        assert len(message) == len(sent) and sum(a != b for a, b in zip(message, sent, strict=True)) == 3


def test_split_messages_arrive_in_two_parts() -> None:
    arrived = passed(MessageFault("split", delay=0.2), ordered=True)
    assert len(arrived) == 12 and b"".join(message for _, message in arrived) == b"".join(MESSAGES)
    assert [round(time % 1, 1) for time, _ in arrived] == [0.0, 0.2] * 6


def test_garbage_precedes_the_message() -> None:
    arrived = passed(MessageFault("garbage", count=5), ordered=True)
    assert [message for _, message in arrived[1::2]] == MESSAGES
    assert all(len(message) == 5 for _, message in arrived[::2])


@pytest.mark.parametrize("kind", MESSAGE_KINDS)
def test_equal_seeds_give_equal_faults(kind: str) -> None:
    runs = [passed(MessageFault(kind, share=0.5, seed=9), ordered=False) for _ in range(2)]
    assert runs[0] == runs[1]


def test_messages_that_wait_are_dropped_at_the_end_of_a_connection() -> None:
    for kind in ("delay", "reorder"):
        faults = MessageFaults(ordered=True)
        faults.begin(1, MessageFault(kind))
        faults.put(b"old", 0.0)
        faults.clear()
        faults.put(b"new", 1.0)
        faults.end(1)
        assert faults.take(10.0) == [b"new"]
