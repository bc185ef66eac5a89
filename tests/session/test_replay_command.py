"""The replay command with the marker tracker and a checkpoint."""

import dataclasses
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from gelflow.cli.commands import replay
from gelflow.cli.main import main
from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.observation import FlowMap, flow_map
from gelflow.perception.frames import CameraMount, decode_image, tactile_frame
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import MarkerTracker
from gelflow.policies import checkpoint
from gelflow.policies.networks.flow_map_policy import NetworkPolicy
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.protocols import CameraImage, GripperState
from gelflow.session import records
from gelflow.session.decision_picture import draw_comparisons
from gelflow.session.decision_replay import Comparison
from gelflow.session.reader import SessionReader
from gelflow.session.recorder import SessionRecorder
from gelflow.session.records import TRACKER_VERSION, Decision, describe_session
from gelflow.task import INSERTION

CLOCK = ScaledClock(1.0)
LOOK = GelAppearance()
MOUNT = CameraMount(pixels_per_mm=LOOK.pixels_per_mm)


def untrained(path: Path, seed: int) -> Path:
    """A checkpoint with random weights."""
    rng = np.random.default_rng(seed)
    shape = PolynomialMLP(hidden=(8,))
    tensors = {name: 0.1 * rng.normal(size=size) for name, size in shape.tensor_shapes(INSERTION).items()}
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
    assert "…" not in out  # the table fits into 80 columns
    drawn = cv2.imread(str(picture))
    assert drawn is not None and drawn.min() < 100 and drawn.shape[0] > 300


def test_decisions_are_shown_where_the_picture_cannot_be_written(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise UsageError("cannot write the picture: No space left on device")

    monkeypatch.setattr("gelflow.session.decision_picture.draw_comparisons", full)
    assert main(["replay", str(real_session), "--out", str(tmp_path / "maps.png")]) == 2
    printed = capsys.readouterr()
    assert "all 3 decisions identical" in printed.out and "No space left" in printed.err


def test_a_narrow_terminal_shortens_no_number(
    real_session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["replay", str(real_session)]) == 0
    wide = capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "50")
    assert main(["replay", str(real_session)]) == 0
    assert re.findall(r"[+-]\d+\.\d{3}", capsys.readouterr().out) == re.findall(r"[+-]\d+\.\d{3}", wide) != []


def test_the_command_prints_json(real_session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(real_session), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["identical"] and printed["notes"] == [] and printed["picture"] is None
    assert [decision["action_difference"] for decision in printed["decisions"]] == [0, 0, 0]


def test_the_command_detects_another_policy(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    other, picture = untrained(tmp_path / "other.safetensors", 2), tmp_path / "both.png"
    assert main(["replay", str(real_session), "--checkpoint", str(other), "--out", str(picture)]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "3 of 3 decisions differ" in out and "is not the policy that the session ran" in out
    assert "difference" in out and "Δ" not in out
    assert reddish(picture) > 100  # the corrections of the other policy
    assert main(["replay", str(real_session), "--out", str(tmp_path / "same.png")]) == 0
    assert reddish(tmp_path / "same.png") == 0


def test_a_session_of_a_former_tracker_is_named(
    real_session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "TRACKER_VERSION", "99")
    assert main(["replay", str(real_session)]) == 0
    assert f"recorded with tracker {TRACKER_VERSION}, installed is 99" in capsys.readouterr().out
    assert "recorded with tracker 1, installed is 99" in replay._notes({"versions": {}}, None)


def test_a_session_of_another_processor_is_named(
    real_session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with SessionReader(real_session) as session:
        recorded = session.description()["versions"]["blas"]
    assert recorded
    monkeypatch.setattr(replay, "software_versions", lambda: records.software_versions() | {"blas": "openblas Z80"})
    assert main(["replay", str(real_session)]) == 0
    assert f"recorded with blas {recorded}, installed is openblas Z80" in " ".join(capsys.readouterr().out.split())


def test_a_session_finds_its_policy_among_those_shipped(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = real_session.parent / "policy.safetensors"
    (tmp_path / "former.safetensors").write_bytes(recorded.read_bytes())
    untrained(tmp_path / "insertion.safetensors", 2)
    monkeypatch.setattr(checkpoint, "_SHIPPED", tmp_path)
    away = recorded.rename(recorded.with_suffix(".away"))
    try:
        assert main(["replay", str(real_session)]) == 0
    finally:
        away.rename(recorded)
    out = capsys.readouterr().out
    assert "all 3 decisions identical" in out and "note:" not in out


def with_grasp(source: Path, target: Path, *, delay: float) -> Path:
    """A session with the first image of each camera and a grasp whose images arrive `delay` [s] late."""
    rng = np.random.default_rng(4)
    with SessionReader(source) as session, SessionRecorder(target, CLOCK) as recorder:
        recorder.metadata({key: value for key, value in session.description().items() if key != "epoch"})
        renderer, state = FastGelRenderer(LOOK), GripperState(0.05, 0.0, 0.0, True, "grasping", "", 0.0)
        for grasp in range(3):
            start, contact = 100.0 + 10 * grasp, 100.6 + 10 * grasp + rng.uniform(0, 0.05)
            recorder.gripper_command(start, "grasp", {"force": 12.0})
            for number in range(60):
                stamp = start + 0.02 * number
                force = 0.5 if stamp < contact else 12.0
                held = "holding" if stamp > contact + 0.1 else "grasping"
                recorder.gripper_state(dataclasses.replace(state, stamp=stamp, force=force, grasp=held))
            for number in range(30):
                exposed = start + number / 30 + 0.01
                moved = np.full((LOOK.grid.rows * LOOK.grid.cols, 2), 0.2 if exposed > contact else 0.0)
                data = renderer.encode(renderer.render(moved, sequence=number))
                recorder.image(0, CameraImage(data, exposed + delay, 100 * grasp + number))
    return target


@pytest.mark.parametrize("delay", [0.0, 0.08])
def test_the_command_shows_the_latency_of_the_cameras(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, delay: float
) -> None:
    path = with_grasp(real_session, tmp_path / "grasps.mcap", delay=delay)
    assert main(["replay", str(path), "--json"]) == 1  # no decision
    printed = json.loads(capsys.readouterr().out)["latency"]
    assert printed["right"] is None and printed["left"]["low"] - 1e-3 <= delay <= printed["left"]["high"] + 1e-3
    assert printed["left"]["high"] - printed["left"]["low"] < 0.06
    main(["replay", str(path)])
    out = capsys.readouterr().out
    assert "left camera: latency beyond that of the lab file" in out and "from 3 grasps" in out
    assert ("correct cameras.left.latency" in out) == (delay > 0.0)


def reddish(path: Path) -> int:
    """Number of pixels in the colour of the recomputed decisions."""
    picture = cv2.imread(str(path))
    assert picture is not None
    blue, green, red = cv2.split(picture.astype(int))
    return int(((red > 150) & (blue < 100) & (green < 150)).sum())


def without(source: Path, target: Path, *, topic: str, sequences: set[int]) -> Path:
    """A copy of a session that lacks some messages."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start()
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            if channel.topic == topic and message.sequence in sequences:
                continue
            key = channels[channel.id]
            writer.add_message(key, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return target


def test_the_command_counts_decisions_without_images(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cut = without(real_session, tmp_path / "cut.mcap", topic="/right/image", sequences={5, 6})  # of the second attempt
    assert main(["replay", str(cut), "--out", str(tmp_path / "maps.png")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "2 of 3 decisions identical" in out and "1 of 3 decisions could not be recomputed: images missing" in out
    assert "image 5 of the right camera is missing" in out and "skipped" in out
    assert main(["replay", str(cut), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert not printed["identical"] and printed["skipped"] == 1 and printed["lost_decisions"] == 0
    assert [bool(decision["skipped"]) for decision in printed["decisions"]] == [False, True, False]
    assert [decision["action_difference"] for decision in printed["decisions"]] == [0, 0, 0]


def test_both_flow_maps_are_drawn_where_they_differ(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    grid = INSERTION.grid
    image = rng.normal(0, 0.3, (4, grid.rows, grid.cols)).astype(np.float32)
    flow = FlowMap(image, 0.4, "mm", np.zeros((2, grid.rows, grid.cols), dtype=bool))
    recorded = Decision.of(
        flow,
        insertion=0,
        attempt=0,
        tracked=((1, 2), (1, 2)),
        reference=(1, 1),
        frames=((2, 2),),
        action=np.zeros(3),
        correction=np.zeros(3),
    )
    for shift, different in [(1e-4, False), (0.2, True)]:
        moved = FlowMap(image + np.float32(shift), 0.4, "mm", flow.filled)
        draw_comparisons([Comparison(recorded, moved, np.zeros(3))], grid, tmp_path / f"{shift}.png")
        assert (reddish(tmp_path / f"{shift}.png") > 0) == different


def test_the_command_counts_damaged_records(
    real_session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    data = bytearray(real_session.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    assert main(["replay", str(tmp_path / "damaged.mcap")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert re.search(r"passed over: \d+ damaged records, 1 damaged chunks", out)
    assert re.search(r"[12] of 3 decisions (could not be recomputed|are lost)", out)
    assert main(["recover", str(tmp_path / "damaged.mcap")]) == 0
    capsys.readouterr()
    # All decisions that are left may be identical.
    assert main(["replay", str(tmp_path / "damaged.recovered.mcap"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["lost_chunks"] == 1
    assert main(["replay", str(tmp_path / "damaged.recovered.mcap")]) == 1
    assert "the session was recovered without 1 damaged chunks" in " ".join(capsys.readouterr().out.split())


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
    with SessionRecorder(tmp_path / "one.mcap", CLOCK) as recorder:
        described = describe_session(task=INSERTION, trackers=[{}] * 2, mounts=[{}] * 2, checkpoint=None)
        recorder.metadata({**described, "trackers": [{}]})
    for key in ("task", "mounts", "trackers"):
        with SessionRecorder(tmp_path / f"no-{key}.mcap", CLOCK) as recorder:
            described = describe_session(task=INSERTION, trackers=[{}] * 2, mounts=[{}] * 2, checkpoint=None)
            recorder.metadata({**described, key: None})
    mine = tmp_path / "mine.png"
    mine.write_bytes(b"mine")
    for arguments, message in [
        ([str(tmp_path / "none.mcap")], "No such file"),
        ([str(cut)], f"recover it with: gelflow recover {cut}"),
        ([str(tmp_path / "text.mcap")], "is not an MCAP file"),
        ([str(tmp_path / "moved.mcap")], "name the file with --checkpoint"),
        ([str(tmp_path / "bare.mcap")], "lacks 'task'"),
        ([str(tmp_path / "one.mcap")], "2 camera mounts and 1 trackers; its task has 2 sensors"),
        ([str(tmp_path / "odd.mcap")], "unknown keys ['lens']"),
        ([str(tmp_path / "no-task.mcap")], "the session's description is invalid"),
        ([str(tmp_path / "no-mounts.mcap")], "mounts must be a list, got None"),
        ([str(tmp_path / "no-trackers.mcap")], "trackers must be a list, got None"),
        ([str(real_session), "--checkpoint", str(cut)], "checkpoint"),
        ([str(real_session), "--out", str(tmp_path / "no folder" / "a.png")], "no folder does not exist"),
        ([str(real_session), "--out", str(tmp_path / "a.foo")], "a.foo: the suffix must be one of .png"),
        ([str(real_session), "--simulate", "--out", str(tmp_path / "a.foo")], "a.foo: the suffix must be one of"),
        ([str(real_session), "--out", str(mine)], "mine.png exists; name a new file"),
    ]:
        assert main(["replay", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1, error
    assert mine.read_bytes() == b"mine"
