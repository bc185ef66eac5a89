"""Replay: the same images in the same order give the same decisions; every difference is detected."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import PeerError
from gelflow.observation import FlowMap, Grid, TactileFrame, flow_map
from gelflow.protocols import CameraImage, Policy
from gelflow.session.decision_replay import Comparison, PerceptionPipeline, difference, replay
from gelflow.session.messages import Damage
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import Decision
from gelflow.task import InsertionTask

CLOCK = ScaledClock(1.0)
SMALL = InsertionTask(grid=Grid(2, 3, 1.0))


# Substitutes: an image is 12 numbers, the tracker sums its images, the policy keeps its last answer.


class SumTracker:
    """A tracker whose state depends on all images and their order."""

    def __init__(self, sensor: int) -> None:
        self.state = np.full(12, float(sensor))

    def start(self, data: bytes) -> NDArray[np.float64]:
        return self.track(data)

    def track(self, data: bytes) -> NDArray[np.float64]:
        self.state = 0.7 * self.state + np.frombuffer(data, dtype=np.uint8) / 3.0
        return self.state.copy()


def sum_frame(tracked: Sequence[NDArray[np.float64]], stamp: float) -> TactileFrame:
    shear = np.stack([one.reshape(6, 2) for one in tracked]).astype(np.float32)
    positions = SMALL.grid.positions().astype(np.float32)
    return TactileFrame(shear, np.ones((2, 6), dtype=bool), positions, stamp, "px", grid=SMALL.grid)


class EchoPolicy:
    """A policy whose answer depends on the flow map and on all answers since the reset."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain
        self.last = np.zeros(3)

    def reset(self) -> None:
        self.last = np.zeros(3)

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        value = observation.image.reshape(-1)[:3] * self.gain + observation.divisor
        self.last = 0.5 * self.last + value
        return self.last.copy()


PERCEPTION = PerceptionPipeline(SumTracker, sum_frame)
Change = Callable[[Decision], Decision]


def run_live(recorder: SessionRecorder, *, change: Change = lambda decision: decision, lose: int | None = None) -> None:
    """Two insertions of three attempts; the cameras are not synchronized and send more images than are tracked."""
    rng = np.random.default_rng(5)
    policy = EchoPolicy()
    count = [0, 10]
    for insertion in range(2):
        policy.reset()
        for attempt in range(3):
            tracked: list[list[int]] = [[], []]
            results: list[list[NDArray[np.float64]]] = [[], []]
            for sensor in (0, 1):
                tracker = SumTracker(sensor)
                for step in range(7 + sensor):
                    image = CameraImage(rng.bytes(12), CLOCK.now(), count[sensor])
                    count[sensor] += 1
                    if lose != image.sequence:
                        recorder.image(sensor, image)
                    if step % 2 == 0:
                        tracked[sensor].append(image.sequence)
                        results[sensor].append(tracker.track(image.data))
            reference = sum_frame([result[0] for result in results], 0.0)
            observation = flow_map([sum_frame([result[-1] for result in results], 0.0)], reference, grid=SMALL.grid)
            decision = Decision.of(
                observation,
                insertion=insertion,
                attempt=attempt,
                tracked=tuple(map(tuple, tracked)),
                reference=(tracked[0][0], tracked[1][0]),
                frames=((tracked[0][-1], tracked[1][-1]),),
                action=policy.act(observation),
                correction=np.zeros(3),
            )
            recorder.decision(change(decision).to_json())
            recorder.attempt_end({"insertion": insertion, "attempt": attempt})


def replayed(
    path: Path, *, policy: Policy | None = None, perception: PerceptionPipeline = PERCEPTION
) -> list[Comparison]:
    with SessionReader(path) as session:
        return list(replay(session, perception=perception, policy=policy or EchoPolicy(), task=SMALL))


def test_a_replay_is_identical(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder)
    comparisons = replayed(tmp_path / "a.mcap")
    assert len(comparisons) == 6
    assert all(made.identical and made.action_difference == made.flow_difference == 0 for made in comparisons)
    assert len({made.action.tobytes() for made in comparisons}) == 6


def test_a_change_of_an_action_by_one_bit_is_detected(tmp_path: Path) -> None:
    def nudge(decision: Decision) -> Decision:
        if (decision.insertion, decision.attempt) != (1, 1):
            return decision
        return dataclasses.replace(decision, action=np.nextafter(decision.action, np.inf))

    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder, change=nudge)
    assert [made.identical for made in replayed(tmp_path / "a.mcap")] == [True] * 4 + [False, True]


@pytest.mark.parametrize(
    "change",
    [
        lambda d: dataclasses.replace(d, divisor=d.divisor * 1.001),
        lambda d: dataclasses.replace(d, unit="mm"),
        lambda d: dataclasses.replace(d, flow=d.flow[:, :1]),
        lambda d: dataclasses.replace(d, action=np.full(3, np.nan)),
        lambda d: dataclasses.replace(d, tracked=(d.tracked[0][:1] + d.tracked[0][2:], d.tracked[1])),
    ],
)
def test_every_other_change_is_detected(tmp_path: Path, change: Change) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder, change=change)
    assert not any(made.identical for made in replayed(tmp_path / "a.mcap"))


def test_another_policy_and_another_tracker_differ(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder)
    other = replayed(tmp_path / "a.mcap", policy=EchoPolicy(1.5))
    assert all(made.flow_difference == 0 and made.action_difference > 0 for made in other)
    swapped = PerceptionPipeline(lambda sensor: SumTracker(1 - sensor), sum_frame)
    assert all(made.flow_difference > 0 for made in replayed(tmp_path / "a.mcap", perception=swapped))


def test_a_decision_with_a_missing_image_is_skipped_and_the_next_ones_are_identical(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder, lose=23)
    comparisons = replayed(tmp_path / "a.mcap")
    assert [made.skipped for made in comparisons] == ["", "", "", "image 23 of the left camera is missing", "", ""]
    # The policy has a memory: it continues from the recorded flow map of the skipped decision.
    assert [made.identical for made in comparisons] == [True, True, True, False, True, True]
    assert not any(made.differs for made in comparisons)


def test_a_replay_goes_on_past_damaged_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with SessionRecorder(path, CLOCK) as recorder:
        run_live(recorder)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    decisions = [key for key, channel in summary.channels.items() if channel.topic == "/decision"]
    # The chunk of the third decision, the last of the first insertion.
    chunk = [index for index in summary.chunk_indexes if set(decisions) & set(index.message_index_offsets)][2]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(PeerError, match="is damaged"):
        replayed(path)
    damage = Damage()
    with SessionReader(path) as session:
        found = list(replay(session, perception=PERCEPTION, policy=EchoPolicy(), task=SMALL, damage=damage))
    assert [(made.recorded.insertion, made.recorded.attempt) for made in found] == [
        (0, 0),
        (0, 1),
        (1, 0),
        (1, 1),
        (1, 2),
    ]
    assert all(made.identical for made in found)
    assert damage.chunks == 1 and damage.records >= 2


class RejectingTracker(SumTracker):
    """Rejects one image and keeps its state."""

    refused = b""

    def track(self, data: bytes) -> NDArray[np.float64]:
        if data == self.refused:
            raise PeerError("no markers")
        return super().track(data)


def test_an_image_that_the_tracker_rejects_skips_the_decision_only_if_required(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder)
    with SessionReader(tmp_path / "a.mcap") as session:
        data = {record.value.sequence: record.value.data for record in session.records(["/left/image"])}
        first = next(session.decisions())
    rejecting = PerceptionPipeline(RejectingTracker, sum_frame)
    RejectingTracker.refused = data[first.tracked[0][1]]
    made = replayed(tmp_path / "a.mcap", perception=rejecting)[0]
    assert made.differs and not made.skipped
    RejectingTracker.refused = data[first.frames[0][0]]
    made, *others = replayed(tmp_path / "a.mcap", perception=rejecting)
    assert "left camera is unreadable: no markers" in made.skipped and not made.identical
    assert all(other.identical for other in others)


def test_difference_of_arrays() -> None:
    assert difference(np.array([1.0, 2.0]), np.array([1.0, 2.5])) == 0.5
    assert difference(np.array([np.nan]), np.array([np.nan])) == np.inf
    assert difference(np.zeros(2), np.zeros(3)) == np.inf
