"""Recipes, the evaluation report, and the commands `gelflow train` and `gelflow eval` of tasks other than insertion."""

import dataclasses
import errno
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.policies.toy_tasks import PointTask

from gelflow.cli.commands.training.task_training import TASKS
from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.checkpoint import load_network
from gelflow.policies.episodes import Episodes, Film, OraclePolicy, RandomPolicy, record_films, run_episodes
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.torch_actor import TorchActor
from gelflow.policies.recipes import RECIPES, recipe_for, training_run
from gelflow.policies.reports.evaluation_report import evaluate_all
from gelflow.policies.reports.failures import failure_ranges, worst_ranges
from gelflow.policies.training.progress_log import table_columns
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.insertion_environments import Insertion
from gelflow.sim.tasks.parts import load_part
from gelflow.sim.tasks.randomization import Uniform
from gelflow.sim.tasks.registry import make_task, task_names
from gelflow.task import INSERTION, InsertionTask


class Direct(OraclePolicy):
    """Moves to the target that it observes."""

    def act(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        return np.asarray(np.clip(2 * observations[:, :2], -1, 1))


def test_the_help_of_train_states_the_default_steps(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "1000")  # no line breaks in names of recipes
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    steps = {task: recipe_for(task).steps for task in RECIPES}
    assert all(f"{task} {count}" in text for task, count in steps.items())
    assert f"with --start {recipe_for('insertion', 'fine-tuning').steps}, " in text
    assert f"with --algorithm ppo {recipe_for('insertion', 'ppo').steps};" in text
    for task in steps.keys() - {"insertion"}:
        others: dict[int, list[str]] = {}
        for name in RECIPES[task]:
            if (count := recipe_for(task, name).steps) != steps[task]:
                others.setdefault(count, []).append(name)
        listed = "".join(f", with --recipe {' or '.join(names)} {count}" for count, names in others.items())
        assert re.search(re.escape(f"{task} {steps[task]}{listed}") + "[;)]", text)


@pytest.mark.parametrize(
    ("misalignment", "wider"),
    [((6e-3, 5e-3, 0.1), (6e-3, 5e-3, 0.13)), ((6e-3, 6e-3, 0.25), (6e-3, 6e-3, np.pi / 12)), ((1e-3, 0, 0),) * 2],
)
def test_a_fine_tuning_starts_with_more_yaw_than_the_task(
    misalignment: tuple[float, float, float], wider: tuple[float, float, float]
) -> None:
    """Within the workspace."""
    task = dataclasses.replace(INSERTION, misalignment=misalignment)
    recipe = recipe_for("insertion", "fine-tuning")
    trained = recipe.make_training_task(2, task=task).description
    assert isinstance(trained, InsertionTask) and trained.misalignment == pytest.approx(wider)
    assert dataclasses.replace(trained, misalignment=misalignment) == task
    assert recipe.make_task(2, task=task).description == task
    for name in ("default", "ppo"):
        assert recipe_for("insertion", name).make_training_task(2, task=task).description == task


@pytest.mark.parametrize("task", task_names())
def test_every_task_reports_its_randomized_quantities_with_units(task: str) -> None:
    batch = make_task(task, 2, randomization="full", threads=1)
    batch.reset(batch.all, np.random.default_rng(0))
    assert {"noise", "crosstalk", "dead_markers"} < set(batch.quantities) == set(batch.quantity_units)
    assert all(values.shape == (2,) and np.isfinite(values).all() for values in batch.quantities.values())
    assert any(values[0] != values[1] for values in batch.quantities.values())


def test_attempts_include_the_first_and_corrections_do_not() -> None:
    grasp = make_task("grasp", 4, threads=1)
    found = run_episodes(OraclePolicy(grasp), grasp, episodes=8, seed=0).result("oracle").to_json()
    assert found["success"] == 1 and 1 <= found["attempts"] < 4
    insertion = make_task("insertion", 4, threads=1, randomization="nominal")
    found = run_episodes(OraclePolicy(insertion), insertion, episodes=8, seed=0).result("oracle").to_json()
    assert found["success"] == 1 and found["corrections"] == 1


def test_the_named_tables_of_the_insertion_have_the_grasp_height_of_the_part() -> None:
    peg = load_part("peg")
    batch = make_task("insertion", 1, task=peg, randomization="full", threads=1)
    assert isinstance(batch, Insertion)
    low, high = peg.part.grasp_height
    assert batch.attempts.randomization["grasp_height"].distribution == Uniform(low, high)


def test_noise_on_flow_maps_is_an_option_of_the_insertion() -> None:
    def observed(noise: FlowMapNoise | None) -> NDArray[np.float32]:
        batch = make_task("insertion", 3, noise=noise, randomization="nominal", threads=1)
        batch.reset(batch.all, np.random.default_rng(0), options={"misalignment": [2e-3, 1e-3, 0.05]})
        return batch.observation.copy()

    plain, noisy = observed(None), observed(FlowMapNoise())
    assert (noisy == observed(FlowMapNoise())).all() and np.abs(noisy - plain).max() > 0.01
    before, after = (np.sqrt((maps.reshape(3, 2, 2, 130) ** 2).sum(2)).max((1, 2)) for maps in (plain, noisy))
    assert np.allclose(before, after, rtol=1e-5)


def test_the_commands_know_the_tasks_of_the_recipes() -> None:
    assert set(RECIPES) == set(TASKS)


def test_unknown_tasks_and_recipes_are_rejected() -> None:
    with pytest.raises(UsageError, match="no recipe trains 'juggling'"):
        recipe_for("juggling")
    with pytest.raises(UsageError, match=r"grasp has no recipe 'best'; there are default, paper"):
        recipe_for("grasp", "best")


def test_a_task_is_trained_and_evaluated_by_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    options = ["--steps", "8", "--envs", "8", "--recipe", "paper", "--seed", "3", "--out", str(folder), "--json"]
    assert main(["train", "cap", *options]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["steps"] >= 8 and set(made["shares"]) == {"simulation", "learning", "evaluation"}
    assert main(["train", "cap", *options]) == 0
    again = capsys.readouterr()
    assert json.loads(again.out) == made and "holds this training already" in again.err
    arguments = ["--checkpoint", made["checkpoint"], "--episodes", "2", "--envs", "2", "--json"]
    assert main(["eval", "cap", *arguments]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in printed["results"]] == ["policy", "oracle", "random"]
    assert all("steps" in row and "attempts" not in row for row in printed["results"])
    batch, rng = recipe_for("cap", "paper").make_task(4), np.random.default_rng(0)
    policy = load_network(made["checkpoint"], task=batch.description).batch_policy(4)
    batch.reset(batch.all, rng)
    policy.reset(batch.all)
    assert policy.act(batch.observation).shape == (4, 9)
    assert main(["eval", "cap", *arguments, "--randomization", "fall"]) == 2
    assert "no randomization 'fall'" in capsys.readouterr().err


def test_an_evaluation_has_the_randomization_of_the_training_or_the_given_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--steps", "8", "--envs", "2", "--preset", "fast", "--randomization", "full", "--out", str(tmp_path)]
    assert main(["train", "grasp", *options]) == 0
    arguments = ["--checkpoint", str(tmp_path / "policy.safetensors"), "--episodes", "8", "--envs", "8", "--json"]
    for given, has_pad in (([], True), (["--randomization", "default"], False)):
        capsys.readouterr()
        assert main(["eval", "grasp", *arguments, *given]) == 0
        quantities = {row["quantity"] for row in json.loads(capsys.readouterr().out)["failures"]}
        assert "mass" in quantities and ("pad_kn" in quantities) == has_pad


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "grasp", "--recipe", "none"], "no recipe 'none'"),
        (["train", "rolling"], "no recipe trains 'rolling': the paper measures in this scene"),
        (["train", "cap", "--part", "peg.toml"], "--part is for the insertion"),
        (["train", "grasp", "--steps", "0"], "above 0"),
        (["train", "insertion", "--recipe", "paper"], "--recipe"),
        (["eval", "grasp"], "requires --checkpoint"),
        (["eval", "cap", "--part", "peg.toml"], "--part is for the insertion"),
    ],
)
def test_an_invalid_option_gives_a_message_of_one_line(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert message in error and "\n" not in error


def test_a_report_has_tables_and_videos(tmp_path: Path) -> None:
    task = PointTask(4)
    architecture = MLP(observation_shape=(4,), actions=2, hidden=(8,))
    network = architecture.network(task.description, TorchActor(architecture).tensors())
    report = evaluate_all(network, task, episodes=40, seed=1, out=tmp_path)
    assert [result.name for result in report.results] == ["policy", "random"]
    names = {path.name for path in report.files}
    assert {"results.json", "episodes.csv", "failures.csv", "failures.png", "failure.gif", "failure.png"} <= names
    assert all(path.stat().st_size > 0 for path in report.files)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["format"] == 1 and results["results"][0]["name"] == "policy"
    assert (tmp_path / "episodes.csv").read_text().splitlines()[0].endswith("steps,return,target_x [m],target_y [m]")
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot write into"):
        evaluate_all(network, task, episodes=1, seed=1, out=tmp_path / "file")


def test_an_evaluation_replaces_only_files_of_an_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = PointTask(4)
    architecture = MLP(observation_shape=(4,), actions=2, hidden=(8,))
    network = architecture.network(task.description, TorchActor(architecture).tensors())
    (tmp_path / "failure.gif").write_text("mine")
    with pytest.raises(UsageError, match=r"failure\.gif would be replaced, and is not of an evaluation"):
        evaluate_all(network, task, episodes=4, seed=1, out=tmp_path)
    assert (tmp_path / "failure.gif").read_text() == "mine"
    (tmp_path / "failure.gif").unlink()
    assert evaluate_all(network, task, episodes=4, seed=1, out=tmp_path).error is None

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gelflow.policies.reports.evaluation_report._write_tables", full)
    report = evaluate_all(network, task, episodes=4, seed=1, out=tmp_path)
    assert len(report.results) == 2 and isinstance(report.error, OSError)


@pytest.mark.parametrize("target", ["os.fsync", "gelflow.policies.reports.evaluation_report._write_tables"])
def test_a_full_disk_leaves_the_results_of_an_evaluation(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = PointTask(4)
    architecture = MLP(observation_shape=(4,), actions=2, hidden=(8,))
    network = architecture.network(task.description, TorchActor(architecture).tensors())
    assert evaluate_all(network, task, episodes=4, seed=1, out=tmp_path).error is None
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(target, full)
        report = evaluate_all(network, task, episodes=4, seed=2, out=tmp_path)
    assert isinstance(report.error, OSError)
    if target == "os.fsync":
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    else:
        assert [path.name for path in tmp_path.iterdir()] == ["results.json"] == [p.name for p in report.files]
    assert evaluate_all(network, task, episodes=4, seed=2, out=tmp_path).error is None


def test_films_show_the_evaluated_episodes() -> None:
    def policy(task: PointTask) -> Direct:
        return Direct(task)

    task = PointTask(3)
    episodes = run_episodes(policy(task), task, episodes=10, seed=4)
    films = [Film(0), Film(5), Film(9)]
    record_films(policy(task), task, films, episodes=10, seed=4, max_frames=100)
    assert [len(film.frames) for film in films] == [1 + episodes.length[film.episode] for film in films]
    row, col = np.round(16 + 12 * np.array([episodes.quantities[f"target_{axis}"][5] for axis in "xy"])).astype(int)
    assert (films[1].frames[0][row, col] == (0, 160, 0)).all()


def test_failures_are_counted_in_ranges_of_equally_many_episodes() -> None:
    values = np.linspace(0, 1, 100)
    success = values < 0.7
    table = {"mass": values, "fixed": np.ones(100)}
    episodes = Episodes(success, ~success, np.ones(100, int), np.zeros(100), table, {"mass": "kg", "fixed": ""})
    ranges = failure_ranges(episodes)
    assert [entry.quantity for entry in ranges] == ["mass"] * 5
    assert [entry.episodes for entry in ranges] == [20] * 5
    assert [entry.failures for entry in ranges] == [0, 0, 0, 10, 20]
    assert worst_ranges(ranges) == ["most failures by mass: 20 of 20 between 800 and 1000 g"]


@pytest.mark.parametrize("count", [10, 200, 1000, 4096])
def test_an_evaluation_without_failures_names_no_quantity(count: int) -> None:
    table = {"mass": np.linspace(0, 1, count), "friction": np.linspace(1, 0, count)}
    episodes = Episodes(np.ones(count, bool), np.zeros(count, bool), np.ones(count, int), np.zeros(count), table)
    ranges = failure_ranges(episodes)
    assert {entry.confidence_interval()[0] for entry in ranges} == {0.0}
    assert worst_ranges(ranges) == []


@pytest.mark.parametrize(("count", "rate"), [(200, 0.9), (1000, 0.6)])
def test_failures_that_depend_on_nothing_are_seldom_ascribed_to_a_quantity(count: int, rate: float) -> None:
    rng, named, evaluations = np.random.default_rng(0), 0, 100
    for _ in range(evaluations):
        success = rng.random(count) < rate
        table = {f"quantity {i}": rng.random(count) for i in range(15)}
        episodes = Episodes(success, ~success, np.ones(count, int), np.zeros(count), table)
        named += bool(worst_ranges(failure_ranges(episodes)))
    assert named <= 0.1 * evaluations  # with the interval of one range about 70


def test_a_training_without_environments_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="num_envs must be at least 1, got 0"):
        training_run("grasp", tmp_path, envs=0)


@pytest.mark.parametrize(("task", "name"), [(task, name) for task in RECIPES for name in RECIPES[task]])
def test_a_recipe_makes_a_learner_and_knows_the_columns_of_its_learning_curve(task: str, name: str) -> None:
    recipe = recipe_for(task, name)
    learner = recipe.make_learner(recipe.make_task(2), seed=0, steps=recipe.steps)
    assert learner.steps == 0
    assert recipe.curve_columns == table_columns(learner.columns)[1:]
    json.dumps(recipe.configuration())
    trained_with = "accurate" if "preset" in recipe.options else None  # otherwise it stands in the options of the run
    assert recipe.configuration(preset="accurate").get("preset") == trained_with


def test_every_episode_counts_once_whatever_its_length() -> None:
    one, many = (run_episodes(Direct(t), t, episodes=50, seed=2) for t in (PointTask(1), PointTask(7)))
    for episodes in (one, many):
        assert len(episodes.success) == 50 and episodes.success.all()
        assert set(episodes.quantities) == {"target_x", "target_y"}
        assert (episodes.length <= 4).all()
    again = run_episodes(Direct(PointTask(7)), PointTask(7), episodes=50, seed=2)
    assert (again.reward == many.reward).all()


def test_the_mean_return_is_that_of_the_episodes_with_an_action() -> None:
    success, reward = np.array([True, True, True, False]), np.array([0.0, 100.0, 98.0, -3.0])
    attempts = Episodes(success, ~success, np.array([1, 2, 3, 10]), reward, length_unit="attempts")
    assert attempts.result("policy").reward == 65 and attempts.result("policy").length == 2
    steps = dataclasses.replace(attempts, length_unit="steps")
    assert steps.result("policy").reward == 48.75
    first = Episodes(success[:1], ~success[:1], np.array([1]), reward[:1], length_unit="attempts")
    assert first.result("policy").reward == 0


def test_the_metrics_of_a_task_are_means_over_the_ends_of_the_episodes() -> None:
    class Measured(PointTask):
        def _observe(self, which: NDArray[np.bool_]) -> None:
            super()._observe(which)
            self.metrics.setdefault("distance [m]", np.zeros(self.num_envs))[which] = np.linalg.norm(
                self._target - self._point, axis=1
            )[which]

    task = Measured(5)
    episodes = run_episodes(RandomPolicy(5, np.ones(2), 0), task, episodes=20, seed=2)
    distance = episodes.metrics["distance [m]"]
    assert len(distance) == 20 and (distance[episodes.success] < 0.15).all() and (distance[~episodes.success] > 0).all()
    result = episodes.result("random")
    assert result.metrics == {"distance [m]": pytest.approx(distance.mean())}
    assert result.to_json()["metrics"] == dict(result.metrics)
