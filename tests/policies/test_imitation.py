"""The recurrent network and its training by imitation, on an analytic environment that replaces the simulator."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tests.policies.toy_insertion import ToyInsertion, images, mirrored

from gelflow.errors import UsageError
from gelflow.observation import FlowMap
from gelflow.part import CUBOID
from gelflow.policies.checkpoint import load_checkpoint, load_policy, save_checkpoint
from gelflow.policies.episodes import RandomPolicy, evaluate_task
from gelflow.policies.imitation import Imitation, ImitationSettings, imitation_loss
from gelflow.policies.insertion_expert import expert_correction, part_tolerance
from gelflow.policies.networks.polynomial_features import polynomial_basis
from gelflow.policies.networks.polynomial_gru import PolynomialGRU, PolynomialGRUNetwork
from gelflow.policies.networks.polynomial_gru_torch import TorchPolynomialGRU
from gelflow.policies.training.progress_log import read_table
from gelflow.policies.training.run import STATE, Progress, RunSettings, TrainingRun
from gelflow.policies.training.state import load_state
from gelflow.task import INSERTION, insertion_task

SMALL = PolynomialGRU(degree=1, units=24, head=12)


def network(architecture: PolynomialGRU = SMALL, seed: int = 0) -> PolynomialGRUNetwork:
    """A network with random weights."""
    rng = np.random.default_rng(seed)
    values = {name: rng.normal(0, 0.3, shape) for name, shape in architecture.tensor_shapes(INSERTION).items()}
    values["basis"] = polynomial_basis(INSERTION.grid, architecture.degree)
    values["scale"] = np.ones(architecture.features(INSERTION))
    return architecture.network(INSERTION, values)


def test_numpy_and_torch_give_the_same_outputs_for_sequences_with_several_parts() -> None:
    layers = TorchPolynomialGRU(SMALL, INSERTION)
    fixed = {
        "basis": polynomial_basis(INSERTION.grid, SMALL.degree),
        "scale": np.full(SMALL.features(INSERTION), 0.7),
    }
    policy = SMALL.network(INSERTION, fixed | layers.tensors()).batch_policy(3)
    inputs, outputs, starts = [], [], []
    for i in range(7):
        policy.reset(np.array([i == 4, False, i == 2]))
        starts.append(policy.new.copy())
        inputs.append(policy.observe(images(3, seed=i)))
        outputs.append(policy.output(inputs[-1]))
        policy.correct(outputs[-1])
    with torch.no_grad():
        from_torch = layers(torch.from_numpy(np.array(inputs)).float(), torch.from_numpy(np.array(starts)))
    assert np.array(starts).sum() == 5  # three first parts and two more
    assert np.allclose(from_torch.numpy(), outputs, atol=1e-5)


@pytest.mark.parametrize(("in_x", "in_y"), [(False, True), (True, False), (True, True)])
def test_mirrored_flow_maps_give_mirrored_corrections(in_x: bool, in_y: bool) -> None:
    one, other = network().batch_policy(8), network().batch_policy(8)
    signs = np.array([-1 if in_x else 1, -1 if in_y else 1, -1 if in_x != in_y else 1])
    for i in range(5):
        stack = images(8, seed=i)
        reflected = np.stack([mirrored(image, in_x, in_y) for image in stack])
        assert np.allclose(other.corrections(reflected), one.corrections(stack) * signs, atol=1e-9)


def test_a_part_without_symmetry_is_not_mirrored() -> None:
    plain = network(dataclasses.replace(SMALL, mirror=()))
    one, other = plain.batch_policy(8), plain.batch_policy(8)
    stack = images(8)
    assert (one.signs == 1).all()
    assert not np.allclose(
        other.corrections(np.stack([mirrored(image, True, False) for image in stack])),
        one.corrections(stack) * [-1, 1, -1],
        atol=1e-4,
    )


def test_parts_are_independent_and_reset_clears_the_memory() -> None:
    together, alone = network().batch_policy(3), network().batch_policy(1)
    for i in range(6):
        if i == 2:
            together.reset(np.array([True, False, True]))
        stack = images(3, seed=i)
        both = together.corrections(stack)
        assert np.allclose(both[1], alone.corrections(stack[1:2])[0], rtol=1e-12, atol=1e-15)
    first = network().batch_policy(3).corrections(images(3))
    together.reset(np.ones(3, dtype=bool))
    assert (together.corrections(images(3)) == first).all()


def test_a_checkpoint_holds_the_network(tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    values = {name: tensor.astype(np.float32) for name, tensor in network()._tensors.items()}
    save_checkpoint(path, task=INSERTION, architecture=SMALL, tensors=values, training={})
    assert load_checkpoint(path).architecture == SMALL
    expected = SMALL.network(INSERTION, values).batch_policy(1)
    policy = load_policy(path)
    for image in images(4):
        observed = FlowMap(image, 1.0, "mm", np.zeros((2, 13, 10), dtype=bool))
        assert (policy.act(observed) == expected.corrections(image[None])[0]).all()


@pytest.mark.parametrize("changes", [{"units": 0}, {"reach": (1e-3, 0.0, 0.1)}, {"mirror": ("z",)}])
def test_an_impossible_architecture_is_rejected(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        dataclasses.replace(SMALL, **changes)


def test_the_centring_correction_centres_a_part() -> None:
    pose = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * INSERTION.misalignment
    assert np.allclose(INSERTION.corrected(pose, INSERTION.centring_correction(pose)), 0, atol=1e-15)
    hexagon = insertion_task(dataclasses.replace(CUBOID, symmetry=6))
    turned = pose + np.array([0, 0, np.pi / 3])
    assert np.allclose(hexagon.centring_correction(turned)[:, 2], -pose[:, 2])
    peg = insertion_task(dataclasses.replace(CUBOID, symmetry=0))
    assert (peg.centring_correction(pose)[:, 2] == 0).all()


def test_the_tolerance_is_the_gap_and_the_yaw_of_a_corner() -> None:
    x, y, yaw = part_tolerance(INSERTION)
    assert x == y == 2.25e-3 and np.hypot(17.5, 25) * yaw == pytest.approx(2.25)


def test_the_tolerance_in_a_narrow_hole_is_wider_than_its_gap() -> None:
    narrow = insertion_task(dataclasses.replace(CUBOID, clearance=(1e-3, 8e-3)))
    assert part_tolerance(narrow)[:2] == (1.5e-3, 4e-3)


def test_the_expert_turns_a_round_part_from_side_to_side_while_it_centres_it() -> None:
    peg = insertion_task(dataclasses.replace(CUBOID, symmetry=0))
    rng = np.random.default_rng(0)
    pose = rng.uniform(-1, 1, (20, 3)) * peg.workspace
    signs = np.where(rng.uniform(size=(20, 3)) < 0.5, -1.0, 1.0)
    moved = peg.corrected(pose, expert_correction(peg, pose, signs) * signs)
    assert np.allclose(moved[:, :2], 0, atol=1e-15)
    assert np.allclose(np.abs(moved[:, 2]), 0.8 * peg.workspace[2])
    assert (np.sign(moved[:, 2]) == -np.sign(pose[:, 2])).all()
    assert (expert_correction(peg, np.zeros((1, 3)), signs[:1])[:, 2] > 0).all()  # in the network's coordinates
    assert np.abs(expert_correction(peg, pose, signs)[:, 2]).max() < peg.action_scale[2]
    cuboid = pose[:, :3] * 0.1
    assert (expert_correction(INSERTION, cuboid, signs) == INSERTION.centring_correction(cuboid) * signs).all()


def test_the_bounded_loss_prefers_a_mode_and_the_other_one_the_mean() -> None:
    modes = torch.tensor([[-4.0, 0, 0], [-4.0, 0, 0], [4.0, 0, 0]])
    at_mode, at_mean = torch.tensor([-4.0, 0, 0]), modes.mean(0)
    assert imitation_loss(modes - at_mode, 1.0) < imitation_loss(modes - at_mean, 1.0)
    assert imitation_loss(torch.zeros(5, 3), 0.5) == 0


SETTINGS = ImitationSettings(updates=40)
SHORT = RunSettings(steps=8_192, evaluate_every=4_000, evaluate_episodes=128)


def make_run(
    folder: Path,
    *,
    settings: ImitationSettings = SETTINGS,
    run: RunSettings = SHORT,
    report: Callable[[Progress], None] | None = None,
) -> TrainingRun:
    learner = Imitation(ToyInsertion(32), SMALL, settings, seed=run.seed, steps=run.steps)
    configuration = {"algorithm": "imitation", "settings": dataclasses.asdict(settings)}
    command = ["gelflow", "train"]
    return TrainingRun(learner, ToyInsertion(32), folder, run, configuration, command, report, "insertion.safetensors")


def test_a_short_training_beats_random_actions_and_writes_its_files(tmp_path: Path) -> None:
    points: list[Progress] = []
    result = make_run(tmp_path, report=points.append).train()
    task = ToyInsertion(32)
    reach = np.asarray(SMALL.reach) / INSERTION.action_scale
    random = evaluate_task("random", RandomPolicy(32, reach, 0), task, episodes=256, seed=1)
    trained = load_policy(result.checkpoint).network.batch_policy(32)
    policy = evaluate_task("policy", trained, task, episodes=256, seed=1)
    assert policy.success > 0.95 and policy.length < random.length
    assert load_checkpoint(result.checkpoint).training["command"] == ["gelflow", "train"]
    assert result.checkpoint.name == "insertion.safetensors"
    assert len(result.curve.read_text().splitlines()) == 1 + len(points)
    assert result.picture.read_bytes().startswith(b"\x89PNG")
    assert result.seconds["simulation"] > 0 and result.seconds["learning"] > 0
    assert not (tmp_path / STATE).exists()
    assert make_run(tmp_path).train().best == result.best
    (tmp_path / "run.json").unlink()  # as a folder of an earlier version
    with pytest.raises(UsageError, match="already holds a trained policy"):
        make_run(tmp_path).train()


def test_a_fine_tuning_starts_with_the_weights_of_its_checkpoint(tmp_path: Path) -> None:
    trained = make_run(tmp_path).train().checkpoint
    checkpoint = load_checkpoint(trained)
    learner = Imitation(ToyInsertion(32), SMALL, SETTINGS, seed=5, steps=8_192)
    learner.start_from(checkpoint)
    tensors = learner.tensors()
    for name, values in checkpoint.tensors.items():
        np.testing.assert_array_equal(tensors[name], values)
    numbers = learner.update()
    assert numbers["success"] > 0.8
    np.testing.assert_array_equal(learner.tensors()["scale"], checkpoint.tensors["scale"])
    for changed in ({"architecture": dataclasses.replace(SMALL, units=7)}, {"task": {**checkpoint.task, "sensors": 1}}):
        with pytest.raises(UsageError, match=r"start from a policy with other (units|sensors) \d+ \(here \d+\)$"):
            learner.start_from(dataclasses.replace(checkpoint, **changed))
    other_part = {**checkpoint.task, "part": {"name": "mine"}, "misalignment": [0.0, 0.0, 0.0], "descent": 2e-3}
    learner.start_from(dataclasses.replace(checkpoint, task=other_part))


class Killed(Exception):
    pass


def test_a_killed_training_continues_to_the_result_of_an_uninterrupted_one(tmp_path: Path) -> None:
    settings = dataclasses.replace(SETTINGS, updates=5, memory=3)
    run = RunSettings(steps=3_072, evaluate_every=500, evaluate_episodes=128)

    def train(folder: Path, stop_at: float = np.inf, **changes: Any) -> dict[str, NDArray[Any]]:
        def report(progress: Progress) -> None:
            if progress.steps >= stop_at:
                raise Killed

        result = make_run(folder, **{"settings": settings, "run": run, "report": report, **changes}).train()
        return dict(load_checkpoint(result.checkpoint).tensors)

    whole = train(tmp_path / "whole")
    with pytest.raises(Killed):
        train(tmp_path / "killed", stop_at=2_000)
    state = load_state(tmp_path / "killed" / STATE)
    assert state.values["steps"] == 1_536 and state.values["memory"] == 3
    with pytest.raises(UsageError, match=r"unfinished run with other settings: settings.updates 5 \(here 6\)"):
        train(tmp_path / "killed", settings=dataclasses.replace(settings, updates=6))
    continued = train(tmp_path / "killed")
    assert all((continued[name] == whole[name]).all() for name in whole)
    tables = [
        [{name: value for name, value in row.items() if name != "minutes" and not name.endswith("_s")} for row in table]
        for table in (read_table(tmp_path / name / "progress.csv") for name in ("whole", "killed"))
    ]
    assert tables[0] == tables[1]
    other = train(tmp_path / "other", run=dataclasses.replace(run, seed=1))
    assert any((other[name] != whole[name]).any() for name in whole)


def test_a_training_stops_at_the_time_limit_after_one_iteration(tmp_path: Path) -> None:
    result = make_run(tmp_path, run=dataclasses.replace(SHORT, minutes=1e-9)).train()
    assert result.steps == 512 and load_policy(result.checkpoint)


def test_a_state_without_its_run_is_rejected(tmp_path: Path) -> None:
    (tmp_path / STATE).write_bytes(b"nothing")
    with pytest.raises(UsageError, match="is not of a run"):
        make_run(tmp_path).train()


def test_the_first_update_of_a_fine_tuning_has_the_bounded_loss() -> None:
    def first_update(bounded: float) -> dict[str, NDArray[Any]]:
        settings = ImitationSettings(rollout=4, updates=5, batch=8, bounded=bounded, bounded_after=0.0)
        learner = Imitation(ToyInsertion(4), SMALL, settings, seed=0, steps=1_000)
        learner.update()
        return learner.tensors()

    bounded, unbounded = first_update(0.9), first_update(0.0)
    assert any((bounded[name] != unbounded[name]).any() for name in bounded)
