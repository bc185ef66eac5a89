"""Training runs: one folder, resumed after a kill at any moment, on analytic tasks."""

import dataclasses
import errno
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.policies.toy_tasks import PointTask, ToyDescription

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import load_checkpoint, load_network
from gelflow.policies.episodes import evaluate_task
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.ppo import PPO, PPOSettings
from gelflow.policies.training.folder import try_lock
from gelflow.policies.training.progress_log import read_table
from gelflow.policies.training.run import Progress, RunSettings, TrainingRun, locked
from gelflow.policies.training.state import load_state

PPO_SETTINGS = PPOSettings(rollout=16, batch=128, epochs=5, learning_rate=2e-3, discount=0.95, entropy=0.0)
SHORT = RunSettings(steps=2048, evaluate_every=512, evaluate_episodes=16)


class Killed(Exception):
    """Ends a run as a kill would: nothing after it is executed."""


def make_run(
    folder: Path, *, settings: RunSettings = SHORT, recurrent: int = 0, report: Callable[[Progress], None] | None = None
) -> TrainingRun:
    task, validation = PointTask(16), PointTask(16)
    architecture = MLP(observation_shape=(4,), actions=2, hidden=(16,), recurrent=recurrent)
    learner = PPO(task, architecture, PPO_SETTINGS, seed=settings.seed, steps=settings.steps)
    return TrainingRun(learner, validation, folder, settings, {"algorithm": "ppo"}, ["gelflow", "train"], report)


def killed_after(steps: int) -> Callable[[Progress], None]:
    def report(progress: Progress) -> None:
        if progress.steps >= steps:
            raise Killed

    return report


@pytest.mark.parametrize(("steps", "recurrent"), [(300, 0), (1024, 4), (1300, 0)])
def test_a_resumed_run_continues_bit_for_bit(tmp_path: Path, steps: int, recurrent: int) -> None:
    whole = make_run(tmp_path / "whole", recurrent=recurrent).train()
    with pytest.raises(Killed):
        make_run(tmp_path / "killed", recurrent=recurrent, report=killed_after(steps)).train()
    resumed = make_run(tmp_path / "killed", recurrent=recurrent).train()
    first, second = load_checkpoint(whole.checkpoint), load_checkpoint(resumed.checkpoint)
    assert first.training == second.training
    assert all((first.tensors[name] == second.tensors[name]).all() for name in first.tensors)
    tables = [read_table(result.folder / "progress.csv") for result in (whole, resumed)]
    kept = [[{k: v for k, v in row.items() if k != "minutes" and not k.endswith("_s")} for row in t] for t in tables]
    assert kept[0] == kept[1]


def test_at_most_the_last_interval_is_lost(tmp_path: Path) -> None:
    with pytest.raises(Killed):
        make_run(tmp_path, report=killed_after(1500)).train()
    assert load_state(tmp_path / "state.safetensors").values["steps"] >= 1024
    seen: list[int] = []
    make_run(tmp_path, report=lambda progress: seen.append(progress.steps)).train()
    assert seen[0] > 1024


def test_a_run_learns_and_its_folder_holds_everything(tmp_path: Path) -> None:
    settings = RunSettings(steps=12_288, seed=3, evaluate_every=4_096, evaluate_episodes=64)
    result = make_run(tmp_path, settings=settings).train()
    names = {path.name for path in tmp_path.iterdir()}
    assert {"run.json", "progress.csv", "policy.safetensors", "learning_curve.png"} <= names
    assert "state.safetensors" not in names
    assert result.best.success > 0.9 and set(result.shares) == {"simulation", "learning", "evaluation"}
    assert sum(result.shares.values()) == pytest.approx(1)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["finished"] and run["configuration"]["run"]["seed"] == 3 and "torch" in run["versions"]
    task = PointTask(32)
    policy = load_network(result.checkpoint, task=task.description).batch_policy(32)
    assert evaluate_task("policy", policy, task, episodes=128, seed=9).success > 0.9
    with pytest.raises(UsageError, match=r"trained for another task: steps 8 \(here 9\)"):
        load_network(result.checkpoint, task=ToyDescription(steps=9))


def test_a_missing_tensorboard_is_said_and_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.warns(
        UserWarning, match=r"no TensorBoard logs: install tensorboardX; progress.csv has the same"
    ) as seen:
        make_run(tmp_path, settings=RunSettings(steps=256, evaluate_episodes=4)).train()
    assert len(seen) == 1 and "\n" not in str(seen[0].message)


def test_success_is_logged_once_every_environment_has_ended_an_episode(tmp_path: Path) -> None:
    # An episode may last 24 steps, an update 16: the first episodes to end after a restart are all successes.
    task = PointTask(16, steps=24)
    learner = PPO(task, MLP(observation_shape=(4,), actions=2, hidden=(16,)), PPO_SETTINGS, seed=0, steps=2048)
    rates = [learner.update()["success"] for _ in range(4)]
    learner.restart_episodes()
    rates += [learner.update()["success"] for _ in range(2)]
    assert [np.isnan(rate) for rate in rates] == [True, False, False, False, True, False]
    assert rates[1] < 1 and rates[5] < 1
    TrainingRun(learner, task, tmp_path, SHORT, {}).train()
    assert "nan" not in (tmp_path / "progress.csv").read_text()


def test_tensorboard_logs_hold_every_finite_number(tmp_path: Path) -> None:
    from tensorboardX.proto.event_pb2 import Event

    make_run(tmp_path, settings=RunSettings(steps=256, evaluate_episodes=4)).train()
    (path,) = (tmp_path / "tensorboard").iterdir()
    data, events = path.read_bytes(), []
    while data:  # length, its checksum, event, its checksum
        size = int.from_bytes(data[:8], "little")
        events.append(Event.FromString(data[12 : 12 + size]))
        data = data[16 + size :]
    logged = {value.tag: value.simple_value for event in events for value in event.summary.value}
    (row,) = read_table(tmp_path / "progress.csv")
    assert logged["training/reward"] == pytest.approx(float(row["reward"]), rel=1e-5)
    assert logged["evaluation/evaluated_success"] == pytest.approx(float(row["evaluated_success"]), rel=1e-5)
    assert events[-1].step == int(row["steps"]) and all(np.isfinite(value) for value in logged.values())


def test_a_full_disk_ends_a_run_whose_logs_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tensorboardX.record_writer import RecordWriter

    def full(self: RecordWriter, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    run = make_run(tmp_path, report=lambda progress: monkeypatch.setattr(RecordWriter, "write", full))
    with pytest.raises(OSError, match="No space left"):
        run.train()


def test_a_full_disk_does_not_empty_the_table_of_a_resumed_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Killed):
        make_run(tmp_path, report=killed_after(1100)).train()
    before = read_table(tmp_path / "progress.csv")

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched, pytest.raises(OSError, match="No space left"):
        patched.setattr("os.fsync", full)
        make_run(tmp_path).train()
    assert read_table(tmp_path / "progress.csv") == before and len(before) >= 4


def test_a_folder_belongs_to_one_run(tmp_path: Path) -> None:
    make_run(tmp_path / "done", settings=RunSettings(steps=256, evaluate_episodes=4)).train()
    with pytest.raises(UsageError, match=r"holds a finished run with other settings: run.steps 256 \(here 2048\)"):
        make_run(tmp_path / "done").train()
    with pytest.raises(Killed):
        make_run(tmp_path / "other", report=killed_after(600)).train()
    with pytest.raises(UsageError, match=r"other settings: run.seed 0 \(here 1\)"):
        make_run(
            tmp_path / "other", settings=RunSettings(steps=2048, seed=1, evaluate_every=512, evaluate_episodes=16)
        ).train()
    with locked(tmp_path / "used"), pytest.raises(UsageError, match="in use"):
        make_run(tmp_path / "used").train()
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot write into"):
        make_run(tmp_path / "file").train()


@pytest.mark.parametrize("name", ["progress.csv", "state.safetensors", "learning_curve.png", "tensorboard"])
def test_files_of_another_origin_are_not_continued_or_replaced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    (tmp_path / "lock").write_text("mine")
    with pytest.raises(UsageError, match=rf"{name} is not of a run; choose another folder or delete it"):
        make_run(tmp_path).train()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "mine", "lock": "mine"}


def test_a_run_does_not_finish_without_its_best_policy(tmp_path: Path) -> None:
    policy, kept = tmp_path / "policy.safetensors", tmp_path / "kept.safetensors"
    with pytest.raises(Killed):
        make_run(tmp_path, report=killed_after(600)).train()
    policy.rename(kept)
    with pytest.raises(UsageError, match=r"policy.safetensors, the best .* is missing: put it back, or delete"):
        make_run(tmp_path).train()
    kept.rename(policy)

    def moved_at_the_end(progress: Progress) -> None:
        if progress.steps >= SHORT.steps:
            policy.rename(kept)

    with pytest.raises(UsageError, match="is missing: put it back"):
        make_run(tmp_path, report=moved_at_the_end).train()
    assert not json.loads((tmp_path / "run.json").read_text())["finished"]
    kept.rename(policy)
    assert make_run(tmp_path).train().checkpoint.exists()


def test_a_repeated_finished_run_returns_its_stored_result(tmp_path: Path) -> None:
    def run() -> TrainingRun:
        return make_run(tmp_path, settings=RunSettings(steps=256, evaluate_episodes=4))

    first = run().train()
    files = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.name != "lock"}
    again = run().train()
    assert again.stored and not first.stored
    assert repr(dataclasses.replace(again, stored=False)) == repr(first)  # the mean length may be nan
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.name != "lock"} == files
    values = json.loads((tmp_path / "run.json").read_text())
    del values["result"]  # as an earlier version wrote it
    (tmp_path / "run.json").write_text(json.dumps(values))
    with pytest.raises(UsageError, match="already holds a trained policy"):
        run().train()
    (tmp_path / "run.json").write_text(json.dumps({**values, "finished": False}))
    assert not run().train().stored


def test_a_damaged_state_gives_a_message_of_one_line(tmp_path: Path) -> None:
    with pytest.raises(Killed):
        make_run(tmp_path, report=killed_after(600)).train()
    state = tmp_path / "state.safetensors"
    data = state.read_bytes()
    for bad in (data[:100], b"", b"no tensors at all"):
        state.write_bytes(bad)
        with pytest.raises(UsageError, match="is damaged") as error_info:
            make_run(tmp_path).train()
        assert "\n" not in str(error_info.value)


def test_a_recurrent_policy_remembers_what_it_saw_first() -> None:
    settings = PPOSettings(rollout=8, batch=256, epochs=10, learning_rate=3e-3, discount=0.9, entropy=0.0)
    steps = 16_384

    def success(recurrent: int) -> float:
        task = PointTask(64, remember=True)
        architecture = MLP(observation_shape=(4,), actions=2, hidden=(16,), recurrent=recurrent)
        learner = PPO(task, architecture, settings, seed=0, steps=steps)
        while learner.steps < steps:
            learner.update()
        policy = architecture.network(task.description, learner.tensors()).batch_policy(64)
        return evaluate_task("policy", policy, PointTask(64, remember=True), episodes=128, seed=5).success

    assert success(16) > 0.8 > success(0) + 0.3


def test_a_privileged_critic_and_images_are_supported() -> None:
    task = PointTask(16, image=True)
    settings = PPOSettings(rollout=16, batch=128, epochs=4, learning_rate=2e-3, entropy=0.0, privileged_critic=True)
    learner = PPO(task, CNN(observation_shape=(2, 8, 8), actions=2), settings, seed=0, steps=6_000)
    rewards = []
    while learner.steps < 6_000:
        rewards.append(learner.update()["reward"])
    assert np.mean(rewards[-3:]) > np.mean(rewards[:3]) + 0.2


def test_impossible_settings_are_rejected() -> None:
    with pytest.raises(UsageError, match="above 0"):
        RunSettings(steps=0)


def test_a_locked_file_is_not_locked_again_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    path.touch()
    with path.open("r+b") as first, path.open("r+b") as second:
        assert try_lock(first) and not try_lock(second)
        first.close()
        assert try_lock(second)
