"""Replay: the same images in the same order give the same decisions; every difference is detected."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.cli.main import main
from gelflow.clock import ScaledClock
from gelflow.errors import PeerError
from gelflow.observation import FlowMap, Grid, TactileFrame, flow_map
from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import MarkerTracker
from gelflow.policies import checkpoint
from gelflow.policies.networks import Architecture, NetworkPolicy, tensor_shapes
from gelflow.protocols import CameraImage, Policy
from gelflow.session.decision_replay import Comparison, PerceptionPipeline, difference, replay
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import Decision, describe_session
from gelflow.task import INSERTION, InsertionTask

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


def test_a_missing_image_is_an_error(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder, lose=23)
    with pytest.raises(PeerError, match="image 23 of sensor"):
        replayed(tmp_path / "a.mcap")


class RejectingTracker(SumTracker):
    """Rejects one image and keeps its state."""

    refused = b""

    def track(self, data: bytes) -> NDArray[np.float64]:
        if data == self.refused:
            raise PeerError("no markers")
        return super().track(data)


def test_an_image_that_the_tracker_rejects_is_an_error_only_if_required(tmp_path: Path) -> None:
    with SessionRecorder(tmp_path / "a.mcap", CLOCK) as recorder:
        run_live(recorder)
    with SessionReader(tmp_path / "a.mcap") as session:
        data = {record.value.sequence: record.value.data for record in session.records(["/left/image"])}
        first = next(session.decisions())
    rejecting = PerceptionPipeline(RejectingTracker, sum_frame)
    RejectingTracker.refused = data[first.tracked[0][1]]
    assert not replayed(tmp_path / "a.mcap", perception=rejecting)[0].identical
    RejectingTracker.refused = data[first.frames[0][0]]
    with pytest.raises(PeerError, match="no markers"):
        replayed(tmp_path / "a.mcap", perception=rejecting)


def test_difference_of_arrays() -> None:
    assert difference(np.array([1.0, 2.0]), np.array([1.0, 2.5])) == 0.5
    assert difference(np.array([np.nan]), np.array([np.nan])) == np.inf
    assert difference(np.zeros(2), np.zeros(3)) == np.inf


# The replay command with the marker tracker and a checkpoint

LOOK = GelAppearance()
MOUNT = CameraMount(pixels_per_mm=LOOK.pixels_per_mm)


def untrained(path: Path, seed: int) -> Path:
    """A checkpoint with random weights."""
    rng = np.random.default_rng(seed)
    shape = Architecture(hidden=(8,))
    tensors = {name: 0.1 * rng.normal(size=size) for name, size in tensor_shapes(shape, INSERTION).items()}
    tensors["scale"] = np.ones_like(tensors["scale"])
    checkpoint.save_checkpoint(path, task=INSERTION, architecture=shape, tensors=tensors, training={})
    return path


@pytest.fixture(scope="module")
def real_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    policy_file = untrained(folder / "policy.safetensors", 1)
    policy: NetworkPolicy = checkpoint.load_policy(policy_file)
    renderer = [FastGelRenderer(dataclasses.replace(LOOK, seed=sensor)) for sensor in (0, 1)]
    rng = np.random.default_rng(3)
    config = MOUNT.tracker_config()
    with SessionRecorder(folder / "session.mcap", CLOCK) as recorder:
        recorder.metadata(
            describe_session(task=INSERTION, trackers=[config, config], mounts=[MOUNT, MOUNT], checkpoint=policy_file)
        )
        sequence = 0
        for insertion, attempt in [(0, 0), (0, 1), (1, 0)]:
            if attempt == 0:
                policy.reset()
            push = rng.normal(size=(2, 1, 2)) * 0.15
            trackers = [MarkerTracker(config), MarkerTracker(config)]
            frames = []
            first = sequence
            for step in range(4):
                tracked = []
                for sensor in (0, 1):
                    moved = push[sensor] * step / 3 * np.ones((LOOK.grid.rows * LOOK.grid.cols, 1))
                    picture = renderer[sensor].render(moved, sequence=sequence)
                    image = CameraImage(renderer[sensor].encode(picture), CLOCK.now(), sequence)
                    recorder.image(sensor, image)
                    pixels = decode_image(image.data)
                    tracked.append(trackers[sensor].track(pixels) if step else trackers[sensor].start(pixels))
                frames.append(tactile_frame(tracked, [MOUNT, MOUNT], CLOCK.now()))
                sequence += 1
            observation = flow_map(frames[-1:], frames[0], grid=INSERTION.grid)
            images = tuple(range(first, sequence))
            decision = Decision.of(
                observation,
                insertion=insertion,
                attempt=attempt,
                tracked=(images, images),
                reference=(first, first),
                frames=((sequence - 1, sequence - 1),),
                action=policy.act(observation),
                correction=np.zeros(3),
            )
            recorder.decision(decision.to_json())
            recorder.attempt_end({"insertion": insertion, "attempt": attempt})
    return folder / "session.mcap"


def test_the_command_reports_identical_decisions(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    picture = tmp_path / "maps.png"
    assert main(["replay", str(real_session), "--out", str(picture)]) == 0
    out = capsys.readouterr().out
    with SessionReader(real_session) as session:
        actions = {tuple(decision.action) for decision in session.decisions()}
    assert len(actions) == 3 and all(0 < abs(x) < 8e-3 for x, _, _ in actions)  # not zero: the policy was evaluated
    assert "all 3 decisions identical" in out and "note:" not in out
    drawn = cv2.imread(str(picture))
    assert drawn is not None and drawn.min() < 100 and drawn.shape[0] > 300


def test_the_command_prints_json(real_session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(real_session), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["identical"] and printed["notes"] == [] and printed["picture"] is None
    assert [decision["action_difference"] for decision in printed["decisions"]] == [0, 0, 0]


def test_the_command_detects_another_policy(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    other = untrained(tmp_path / "other.safetensors", 2)
    assert main(["replay", str(real_session), "--checkpoint", str(other)]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "3 of 3 decisions differ" in out and "is not the policy that the session ran" in out


def test_the_command_rejects_wrong_input_with_one_line(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(real_session.read_bytes()[:-100])
    (tmp_path / "text.mcap").write_text("no session")
    with SessionRecorder(tmp_path / "moved.mcap", CLOCK) as recorder:
        gone = {"path": "/gone/policy.safetensors", "digest": "0" * 64}
        recorder.metadata({**describe_session(task=INSERTION, trackers=[{}] * 2, mounts=[{}] * 2), "checkpoint": gone})
    with SessionRecorder(tmp_path / "bare.mcap", CLOCK) as recorder:
        recorder.metadata({})
    with SessionRecorder(tmp_path / "odd.mcap", CLOCK) as recorder:
        recorder.metadata(describe_session(task=INSERTION, trackers=[{}] * 2, mounts=[{"lens": 1}] * 2))
    for arguments, message in [
        ([str(tmp_path / "none.mcap")], "No such file"),
        ([str(cut)], f"recover it with: gelflow recover {cut}"),
        ([str(tmp_path / "text.mcap")], "is not an MCAP file"),
        ([str(tmp_path / "moved.mcap")], "name the file with --checkpoint"),
        ([str(tmp_path / "bare.mcap")], "lacks 'task'"),
        ([str(tmp_path / "odd.mcap")], "unknown keys ['lens']"),
        ([str(real_session), "--checkpoint", str(cut)], "checkpoint"),
        ([str(real_session), "--out", str(tmp_path / "no folder" / "a.png")], "cannot write the picture"),
    ]:
        assert main(["replay", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1, error
