"""Training, checkpoints and use of the insertion policy, on an analytic environment that replaces the simulator."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from numpy.typing import NDArray
from tests.policies.checkpoint_files import rewrite
from tests.policies.toy_insertion import ToyInsertion, images, mirrored

from gelflow.errors import UsageError
from gelflow.observation import FlowMap
from gelflow.policies.checkpoint import load_checkpoint, load_policy, save_checkpoint
from gelflow.policies.episodes import RandomPolicy, evaluate_task
from gelflow.policies.insertion_ppo import HistoryTask, InsertionPPO
from gelflow.policies.networks.polynomial_features import polynomial_basis, reduce_maps
from gelflow.policies.networks.polynomial_mlp import History, PolynomialMLP, PolynomialNetwork
from gelflow.policies.ppo import PPO, PPOSettings
from gelflow.policies.training.progress_log import read_table
from gelflow.policies.training.run import STATE, Progress, RunSettings, TrainingRun
from gelflow.policies.training.state import load_state
from gelflow.protocols import Policy
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.task import INSERTION

SMALL = PolynomialMLP(hidden=(16, 16))


def tensors(architecture: PolynomialMLP = SMALL, seed: int = 0) -> dict[str, NDArray[Any]]:
    """A network with random weights."""
    rng = np.random.default_rng(seed)
    values = {name: rng.normal(0, 0.3, shape) for name, shape in architecture.tensor_shapes(INSERTION).items()}
    return values | {
        "basis": polynomial_basis(INSERTION.grid, architecture.degree),
        "scale": np.ones(architecture.features(INSERTION)),
    }


def flow(image: NDArray[Any]) -> FlowMap:
    return FlowMap(image.astype(np.float32), 1.0, "N", np.zeros((2, 13, 10), dtype=bool))


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "policy.safetensors"
    save_checkpoint(
        path, task=INSERTION, architecture=SMALL, tensors=tensors(), training={"command": ["made", "by a test"]}
    )
    return path


def test_a_saved_policy_acts_identically_after_loading_and_reset(stored: Path) -> None:
    before = PolynomialNetwork(SMALL, INSERTION, {k: v.astype(np.float32) for k, v in tensors().items()}).batch_policy(
        1
    )
    expected = [before.corrections(image[None])[0] for image in images(5)]
    policy = load_policy(stored)
    assert isinstance(load_checkpoint(stored).digest, str) and load_checkpoint(stored).training["command"] == [
        "made",
        "by a test",
    ]
    assert stored.stat().st_size < 2_000_000
    for _ in range(2):
        policy.reset()
        assert all((policy.act(flow(image)) == want).all() for image, want in zip(images(5), expected, strict=True))


def test_the_policy_implements_the_protocol_and_uses_its_history(stored: Path) -> None:
    policy: Policy = load_policy(stored)
    first = policy.act(flow(images(1)[0]))
    assert first.shape == (3,) and first.dtype == float
    assert (np.abs(first) <= SMALL.reach).all()
    assert (policy.act(flow(images(1)[0])) != first).any()
    policy.reset()
    assert (policy.act(flow(images(1)[0])) == first).all()


def test_an_invalid_flow_map_is_rejected(stored: Path) -> None:
    policy = load_policy(stored)
    with pytest.raises(UsageError, match=r"shape \(4, 10, 13\).*takes \(4, 13, 10\)"):
        policy.act(flow(images(1)[0].transpose(0, 2, 1)))
    with pytest.raises(UsageError, match="not finite"):
        policy.act(flow(images(1)[0] * np.nan))
    with pytest.raises(UsageError, match="takes a FlowMap, got ndarray; for observations of environments use load_net"):
        policy.act(images(1)[0])


def test_a_checkpoint_of_another_task_is_rejected_with_the_differing_fields(stored: Path) -> None:
    other = dataclasses.replace(INSERTION, attempts=7, frame_depths=(1.0e-3,))
    with pytest.raises(UsageError) as error_info:
        load_policy(stored, task=other)
    line = str(error_info.value)
    assert "attempts 15 (here 7)" in line and "frame_depths [0.0041] (here [0.001])" in line
    assert "workspace" not in line and "\n" not in line
    assert "observation" not in INSERTION.to_json()  # as in checkpoints of earlier versions
    with pytest.raises(UsageError, match="observation"):
        load_policy(stored, task=dataclasses.replace(INSERTION, observation="forces"))


def test_a_newer_format_is_rejected(stored: Path) -> None:
    rewrite(stored, lambda header: header.update(format=2))
    with pytest.raises(UsageError, match="has format 2; this gelflow reads format 1"):
        load_policy(stored)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header: header["architecture"].update(kind="transformer"), "kind 'transformer'"),
        (lambda header: header["architecture"].update(depth=3), "unknown keys"),
        (lambda header: header["architecture"].update(hidden=[8, 8]), "tensor 0.weight has shape"),
        (lambda header: header["architecture"].update(hidden="wide"), "damaged"),
        (lambda header: header.pop("training"), "damaged"),
    ],
)
def test_an_inconsistent_header_gives_a_message_of_one_line(
    stored: Path, change: Callable[[Any], None], message: str
) -> None:
    rewrite(stored, change)
    with pytest.raises(UsageError, match=message) as error_info:
        load_policy(stored)
    assert "\n" not in str(error_info.value) and str(stored) in str(error_info.value)


def test_truncated_and_corrupted_files_give_a_message_of_one_line(stored: Path, tmp_path: Path) -> None:
    data = stored.read_bytes()
    damaged = tmp_path / "damaged.safetensors"
    rng = np.random.default_rng(0)
    header = 8 + int.from_bytes(data[:8], "little")
    for position in [*range(0, 64, 7), *rng.integers(0, header, 20), *rng.integers(header, len(data), 20)]:
        for bad in (data[:position], data[:position] + bytes([data[position] ^ 0x15]) + data[position + 1 :]):
            damaged.write_bytes(bad)
            try:
                load_policy(damaged)
            except UsageError as error:
                assert "\n" not in str(error)
            else:  # a flipped byte in the name of the header's checksum, see test_checkpoint.py
                assert position < header and len(bad) == len(data)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 a zip", b"\x80\x04\x95 a pickle", b"{}" * 40, b"\x00" * 100])
def test_a_foreign_file_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="not a gelflow checkpoint"):
        load_policy(path)
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(3)}))
    with pytest.raises(UsageError, match="not a gelflow checkpoint"):
        load_policy(path)


def test_missing_files_folders_and_too_large_files_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no checkpoint at"):
        load_policy(tmp_path / "none.safetensors")
    with pytest.raises(UsageError, match="cannot read"):
        load_policy(tmp_path)
    with pytest.raises(UsageError, match="more than 2000000"):
        wide = PolynomialMLP(hidden=(800, 800))
        save_checkpoint(tmp_path / "giant", task=INSERTION, architecture=wide, tensors=tensors(wide), training={})
    (tmp_path / "giant").write_bytes(b"\0" * 2_000_001)
    with pytest.raises(UsageError, match="the limit of a gelflow checkpoint"):
        load_checkpoint(tmp_path / "giant")


def test_features_reproduce_low_polynomials_and_average_noise() -> None:
    basis = polynomial_basis(INSERTION.grid, 2)
    assert np.allclose(basis.T @ basis * 130, np.eye(6))
    x, y = (INSERTION.grid.positions() - INSERTION.grid.positions().mean(0)).T
    smooth = (0.3 + 0.02 * x - 0.01 * x * y).reshape(1, 1, 13, 10)
    back = reduce_maps(smooth, basis).reshape(6) @ basis.T * 130
    assert np.allclose(back, smooth.ravel())
    noise = np.random.default_rng(0).normal(size=(2000, 1, 13, 10))
    assert np.allclose(reduce_maps(noise, basis).std(0), 1 / np.sqrt(130), rtol=0.1)


def test_history_layout_and_displacement_in_the_gripper_frame() -> None:
    one = PolynomialMLP(degree=0, history=2, reach=(1e-3, 1e-3, 0.1))
    history = History(one, INSERTION)
    first = history.observe(np.array([[1.0, 2, 3, 4]]))[0]
    assert first.tolist() == [1, 2, 3, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1 / 15]
    history.record(np.array([[1e-3, 0, np.pi / 2]]))
    second = history.observe(np.array([[5.0, 6, 7, 8]]))[0]
    assert second[:8].tolist() == [5, 6, 7, 8, 1, 2, 3, 4]
    assert np.allclose(second[8:12], [1, 0, np.pi / 0.2, 1])
    assert np.allclose(
        second[12:], [0, -1, np.pi / 0.2, 2 / 15]
    )  # after a rotation by +90°, +x of the start frame is -y of the gripper frame
    assert len(second) == one.inputs(INSERTION)


def test_parallel_histories_are_independent() -> None:
    network = PolynomialNetwork(SMALL, INSERTION, tensors())
    together, alone = network.batch_policy(3), network.batch_policy(1)
    for i in range(6):
        if i == 2:
            together.reset(np.array([True, False, True]))
        stack = images(3, seed=i)
        both = together.corrections(stack)
        assert np.allclose(both[1], alone.corrections(stack[1:2])[0], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("in_x", "in_y"), [(False, True), (True, False), (True, True)])
def test_mirrored_flow_maps_give_mirrored_corrections(in_x: bool, in_y: bool) -> None:
    network = PolynomialNetwork(SMALL, INSERTION, tensors())
    one, other = network.batch_policy(8), network.batch_policy(8)
    signs = np.array([-1 if in_x else 1, -1 if in_y else 1, -1 if in_x != in_y else 1])
    for i in range(5):
        stack = images(8, seed=i)
        reflected = np.stack([mirrored(image, in_x, in_y) for image in stack])
        assert np.allclose(other.corrections(reflected), one.corrections(stack) * signs, atol=1e-9)


def test_evaluation_counts_complete_episodes_and_is_repeatable() -> None:
    task, reach = ToyInsertion(16), np.array([8e-3, 8e-3, 0.2]) / INSERTION.action_scale
    result, again = (
        evaluate_task("random", RandomPolicy(16, np.minimum(reach, 1), 0), task, episodes=50, seed=3) for _ in range(2)
    )
    assert result == again
    assert result.episodes == 50 and 0 < result.successes < 50
    assert 1 <= result.length <= INSERTION.attempts
    low, high = result.confidence_interval()
    assert low < result.success < high


def test_noise_preserves_the_length_of_the_longest_vector() -> None:
    rng = np.random.default_rng(0)
    maps = images(50)
    noise = FlowMapNoise()
    noisy = noise.apply(maps, noise.sample(50, 2, rng), rng)
    length = np.sqrt((noisy.reshape(50, 2, 2, 130) ** 2).sum(2)).max(axis=(1, 2))
    assert np.allclose(length, np.sqrt((maps.reshape(50, 2, 2, 130) ** 2).sum(2)).max(axis=(1, 2)), rtol=1e-5)
    assert 0.02 < np.std(noisy - maps) < 0.2
    none = FlowMapNoise(marker=0, offset=0, gain=0, turn=0)
    assert np.allclose(none.apply(maps, none.sample(50, 2, rng), rng), maps, atol=1e-6)
    zero = np.zeros_like(maps)
    assert not np.abs(noise.apply(zero, noise.sample(50, 2, rng), rng)).max() > 0


SETTINGS = PPOSettings(rollout=16, learning_rate=2e-3, last_learning_rate=0.1, discount=0.5, entropy=0.0, deviation=0.4)
SHORT = RunSettings(steps=20_480, evaluate_every=5_000, evaluate_episodes=128)


def make_run(folder: Path, run: RunSettings = SHORT, report: Callable[[Progress], None] | None = None) -> TrainingRun:
    learner = InsertionPPO(ToyInsertion(32), SMALL, SETTINGS, seed=run.seed, steps=run.steps)
    return TrainingRun(learner, ToyInsertion(32), folder, run, {"algorithm": "ppo"}, ["gelflow", "train"], report)


def test_a_short_training_beats_random_actions_and_writes_its_files(tmp_path: Path) -> None:
    points: list[Progress] = []
    result = make_run(tmp_path / "run", report=points.append).train()
    task, reach = ToyInsertion(32), np.asarray(SMALL.reach) / INSERTION.action_scale
    random = evaluate_task("random", RandomPolicy(32, reach, 0), task, episodes=256, seed=1)
    checkpoint = load_checkpoint(result.checkpoint)
    assert checkpoint.architecture == SMALL
    trained = load_policy(result.checkpoint).network.batch_policy(32)
    policy = evaluate_task("policy", trained, task, episodes=256, seed=1)
    assert policy.success > 0.9 and policy.success > random.success + 0.2
    assert policy.length < random.length
    assert checkpoint.training["command"] == ["gelflow", "train"]
    assert checkpoint.training["validation"]["success"] == result.best.success
    lines = result.curve.read_text().splitlines()
    assert lines[0].startswith("steps,minutes") and len(lines) == 1 + len(points)
    assert result.picture.read_bytes().startswith(b"\x89PNG")


def test_training_is_repeatable_and_stops_at_the_time_limit(tmp_path: Path) -> None:
    def run(name: str, **changes: Any) -> Any:
        settings = dataclasses.replace(SHORT, steps=2048, evaluate_episodes=32, **changes)
        return load_checkpoint(make_run(tmp_path / name, settings).train().checkpoint)

    first, second, other = run("a"), run("b"), run("c", seed=1)
    assert all((first.tensors[name] == second.tensors[name]).all() for name in first.tensors)
    assert any((first.tensors[name] != other.tensors[name]).any() for name in first.tensors)
    assert run("d", minutes=1e-9).training["steps"] <= 1024  # the first update, with the calibration before it


class Killed(Exception):
    pass


def test_a_killed_training_continues_to_the_result_of_an_uninterrupted_one(tmp_path: Path) -> None:
    run = RunSettings(steps=4096, evaluate_every=1000, evaluate_episodes=32)

    def kill(progress: Progress) -> None:
        if progress.steps > 3000:
            raise Killed

    whole = make_run(tmp_path / "whole", run).train()
    with pytest.raises(Killed):
        make_run(tmp_path / "killed", run, kill).train()
    assert load_state(tmp_path / "killed" / STATE).values["steps"] >= 2000
    continued = make_run(tmp_path / "killed", run).train()
    first, second = load_checkpoint(whole.checkpoint), load_checkpoint(continued.checkpoint)
    assert all((first.tensors[name] == second.tensors[name]).all() for name in first.tensors)
    rewards = [[row["reward"] for row in read_table(result.curve)] for result in (whole, continued)]
    assert rewards[0] == rewards[1]


@pytest.mark.parametrize("deviations", [0, 30])
def test_the_exported_perceptron_acts_as_the_trained_one(deviations: int) -> None:
    learner = InsertionPPO(ToyInsertion(32), SMALL, SETTINGS, seed=0, steps=4096)
    for _ in range(2):
        learner.update()
    observed = learner.task.observation.astype(float)
    if deviations:  # a flag that is seldom true is far from its mean
        flag = SMALL.history * SMALL.features(INSERTION) + (SMALL.history - 1) * 3
        mean, variance = (PPO.tensors(learner)[f"encoder.{name}"][flag] for name in ("mean", "variance"))
        observed[:, flag] = mean + deviations * np.sqrt(variance)
    with torch.no_grad():
        expected = learner._actor(torch.from_numpy(observed).float(), torch.zeros(32, 0))[0].clamp(-1, 1).numpy()
    network = SMALL.network(INSERTION, learner.tensors())
    values, signs = network.canonical(observed)
    assert np.allclose(network.corrections(observed) / SMALL.reach * signs, expected, atol=1e-4)
    assert np.allclose(values, observed)  # the learner sees canonical inputs


def test_the_reward_of_the_training_is_the_improvement() -> None:
    toy = ToyInsertion(8)
    task, rng = HistoryTask(toy, SMALL), np.random.default_rng(0)
    task.reset(task.all, rng)
    for _ in range(3):
        before = INSERTION.reward(toy.error)
        task.step(rng.uniform(-0.3, 0.3, (8, 3)), rng)
        assert np.allclose(task.reward, INSERTION.reward(toy.error) - before)
        done = task.terminated | task.truncated
        kept = task.observation[~done].copy()
        task.reset(done, rng)
        assert (task.observation[~done] == kept).all()
        assert not (task.terminated | task.truncated).any()


def test_parts_are_recorded_apart_in_a_history() -> None:
    rng = np.random.default_rng(0)
    together, alone = History(SMALL, INSERTION, count=3), History(SMALL, INSERTION)
    which = np.array([True, False, True])
    for i in range(4):
        features, corrections = rng.normal(size=(3, SMALL.features(INSERTION))), rng.normal(0, 1e-3, (3, 3))
        every = which if i % 2 else np.ones(3, dtype=bool)
        inputs = together.observe(features[every], every)
        assert (inputs[0] == alone.observe(features[:1])[0]).all() and len(inputs) == every.sum()
        together.record(corrections, every)
        alone.record(corrections[:1])
