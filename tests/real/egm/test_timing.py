"""Statistics of the EGM cycles: counters, and the driver against the mock arm over UDP."""

import itertools
import math
from array import array

import pytest
from tests.real.egm.harness import ArmAndMock, near_start

from gelflow.real.egm.reference_generator import EgmFlag
from gelflow.real.egm.timing import BINS, WORDS, TimingCounters


def counters() -> TimingCounters:
    return TimingCounters(memoryview(bytearray(array("q", [0] * WORDS).tobytes())).cast("q"))


def test_counters_without_cycles_have_no_times() -> None:
    timing = counters().read(0)
    assert (timing.cycles, timing.lost, timing.unanswered, timing.missed) == (0, 0, 0, 0)
    assert all(map(math.isnan, (*timing.jitter, *timing.answer)))


def test_jitter_is_relative_to_the_clock_of_the_robot() -> None:
    """100 messages on time, one 2.05 ms late, and three lost before the last one."""
    shared = counters()
    for number in range(100):
        shared.add(number, 0.004 * number, 0.004 * number, 0.004 * number + 0.35e-3)
    shared.add(100, 0.4 + 2.05e-3, 0.4, math.nan)
    shared.count_unanswered()
    shared.add(104, 0.416 + 2.05e-3, 0.416, 0.416 + 1.0)
    timing = shared.read(102)
    assert timing.lost == 3 and timing.unanswered == 1
    assert timing.missed == pytest.approx(4 / 105)
    assert timing.jitter == pytest.approx((1e-4, 1e-4, 21e-4, 21e-4))
    assert timing.answer[:2] == pytest.approx((4e-4, 4e-4)) and timing.answer[3] == pytest.approx(1e-4 * BINS)


@pytest.mark.parametrize("answered", [-1e6, -0.1, -1e-4, 1e6])
def test_an_impossible_time_of_an_answer_counts_in_the_nearest_bin(answered: float) -> None:
    shared = counters()
    shared.add(0, 0.0, 0.0, answered)
    timing = shared.read(1)
    assert timing.answer[3] == pytest.approx(1e-4 if answered < 0 else 1e-4 * BINS)
    assert timing.lost == timing.unanswered == 0 and all(map(math.isnan, timing.jitter))


def test_driver_counts_missed_cycles() -> None:
    with ArmAndMock() as cell:
        cell.mock.lose(3, share=0.2)
        cell.go(near_start(0.003, 0, 0))
        cell.clock.sleep(0.2)
        timing, records = cell.arm.timing, cell.arm.drain_log()
    lost = sum(b.sequence - a.sequence - 1 for a, b in itertools.pairwise(records))
    assert timing.lost == pytest.approx(lost, abs=3) and timing.lost > 10
    assert timing.unanswered == pytest.approx(sum(EgmFlag.UNANSWERED in r.flags for r in records), abs=3)
    assert 0.05 < timing.missed < 0.6
    assert timing.cycles == pytest.approx(len(records), abs=10)
    assert 0 < timing.jitter[0] <= timing.jitter[1] <= timing.jitter[2] <= timing.jitter[3]
    assert 0 < timing.answer[0] <= timing.answer[3]
