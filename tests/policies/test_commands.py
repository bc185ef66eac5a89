"""The commands `gelflow train` and `gelflow eval`, and the included policy in simulation."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from gelflow.cli.commands.training.eval import result_table
from gelflow.cli.main import main
from gelflow.cli.options import checkpoint_for
from gelflow.errors import UsageError
from gelflow.policies.checkpoint import default_checkpoint, load_checkpoint, load_policy
from gelflow.policies.episodes import evaluate_task
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.recipes import recipe_for
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.insertion_environments import Insertion
from gelflow.sim.tasks.parts import load_part
from gelflow.task import INSERTION


def test_the_shipped_policy_inserts_in_simulation() -> None:
    path = default_checkpoint()
    assert path.stat().st_size < 2_000_000
    checkpoint = load_checkpoint(path)
    assert checkpoint.training["command"][:3] == ["gelflow", "train", "insertion"]
    assert checkpoint.training["validation"]["success"] > 0.8
    network = load_policy(path, task=INSERTION).network
    batch = Insertion(32, noise=FlowMapNoise())
    result = evaluate_task("policy", network.batch_policy(32), batch, episodes=48, seed=5)
    assert result.successes >= 36  # more than three standard deviations below 48 · 0.9
    assert result.length < 8


def test_the_shipped_policy_of_the_peg_inserts_it_in_simulation() -> None:
    task = load_part("peg")
    network = load_policy(checkpoint_for(task, None), task=task).network
    batch = Insertion(32, task=task, preset="fast", noise=FlowMapNoise())
    result = evaluate_task("policy", network.batch_policy(32), batch, episodes=48, seed=5)
    assert result.successes >= 42  # more than three standard deviations below 48 · 0.97
    assert result.length < 8


@pytest.mark.parametrize("algorithm", [[], ["--algorithm", "ppo"], ["--start"]])
def test_training_has_the_environments_of_its_recipe(
    algorithm: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = []

    def train(task: str, folder: Path, *, recipe: str, envs: int, **options: object) -> None:
        names.append(recipe)
        assert envs == recipe_for(task, recipe).envs
        raise UsageError("no training here")

    monkeypatch.setattr("gelflow.policies.recipes.train", train)
    assert main(["train", "insertion", *algorithm, "--out", str(tmp_path)]) == 2
    assert len(names) == 1


@pytest.mark.parametrize("algorithm", [[], ["--algorithm", "ppo"]])
def test_evaluation_loads_the_checkpoint_of_a_training(
    algorithm: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = ["--attempts", "64", "--envs", "4", "--seed", "3", "--out", str(tmp_path / "run")]
    arguments = ["train", "insertion", *algorithm, *limits]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "checkpoint" in out and "simulation" in out
    made = tmp_path / "run" / "insertion.safetensors"
    assert load_checkpoint(made).training["command"] == ["gelflow", *arguments]
    assert main(arguments) == 0
    again = capsys.readouterr().out
    assert again == f"{tmp_path / 'run'} holds this training already, finished; its result:\n{out}"
    assert main(["eval", "insertion", "--checkpoint", str(made), "--episodes", "4", "--envs", "4", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    rows = printed["results"]
    assert printed["task"] == "insertion" and printed["checkpoint"] == str(made)
    assert [row["name"].split(",")[0] for row in rows] == ["policy", "policy", "oracle", "random", "random"]
    assert all("corrections" in row and "attempts" not in row for row in rows)
    assert all(row["episodes"] == 4 and 0 <= row["success_95"][0] <= row["success_95"][1] <= 1 for row in rows)
    assert main(["eval", "insertion", "--checkpoint", str(made), "--episodes", "2"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_the_evaluation_of_the_insertion_writes_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["eval", "insertion", "--episodes", "6", "--envs", "3", "--out", str(tmp_path / "report"), "--json"]) == 0
    )
    printed = json.loads(capsys.readouterr().out)
    names = {Path(name).name for name in printed["files"]}
    assert {"results.json", "episodes.csv", "failures.csv", "failures.png", "success.gif", "success.png"} <= names
    quantities = {row["quantity"]: row["unit"] for row in printed["failures"]}
    assert quantities["yaw"] == "rad" and quantities["grasp_force"] == "N" and quantities["x"] == "m"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["eval", "insertion", "--checkpoint", "nowhere.safetensors"], "no checkpoint at nowhere.safetensors"),
        (["eval", "insertion", "--checkpoint", "pyproject.toml"], "is not a gelflow checkpoint"),
        (["eval", "insertion", "--episodes", "0"], "--episodes"),
        (["eval", "insertion", "--randomization", "none"], "one of nominal, default, full, got 'none'"),
        (["train", "insertion", "--randomization", "none"], "one of nominal, default, full, got 'none'"),
        (["eval", "insertion", "--seed", "-1"], "--seed"),
        (["train", "insertion", "--envs", "0"], "--envs"),
        (["train", "insertion", "--attempts", "0"], "above 0"),
        (["train", "insertion", "--minutes", "nan"], "above 0"),
        (["train", "insertion", "--seed", "-1"], "--seed"),
        (["train", "insertion", "--algorithm", "ppo", "--attempts", "0"], "above 0"),
        (["train", "grasp", "--steps", "0"], "--steps must be above 0, got 0"),
        (["train", "grasp", "--seed", str(2**64), "--envs", "1"], "seed of a training must be 0 to 2^64 - 1"),
        (
            ["train", "insertion", "--start", "nowhere.safetensors", "--out", "OUT"],
            "no checkpoint at nowhere.safetensors",
        ),
        (["train", "insertion", "--start", "x", "--algorithm", "ppo"], "--start is for --algorithm imitation"),
        (["train", "grasp", "--start", "x"], "--start is for the insertion, not for grasp"),
        (["train", "insertion", "--out", "pyproject.toml"], "pyproject.toml"),
    ],
)
def test_an_invalid_option_gives_a_message_of_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err.strip()
    assert message in error and error.startswith(f"gelflow {arguments[0]}: ") and "\n" not in error


def test_the_table_of_an_evaluation_cuts_no_number_in_a_terminal_of_60_columns() -> None:
    metrics = {"position error [mm]": 176.83, "yaw error [°]": 49.12}
    result = EvaluationResult("policy", 200, 0, float("nan"), -1343.64, "steps", metrics)
    console = Console(width=60, record=True, file=io.StringIO())
    console.print(result_table([result], "pushing", Path("policy.safetensors"), 200))
    text = console.export_text()
    assert all(number in text.split() for number in ("0.0%", "-1343.6", "176.83", "49.12"))


def test_a_checkpoint_of_another_task_or_part_is_refused_in_few_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part.toml"
    text = (Path(__file__).parents[2] / "sim/tasks/parts/shipped/peg.toml").read_text()
    part.write_text(text.replace("clearance = 0.001", "clearance = 0.002").replace("[part]", 'name = "a/b"\n[part]'))
    peg = str(default_checkpoint().with_name("peg.safetensors"))
    assert main(["eval", "insertion", "--part", str(part), "--checkpoint", peg]) == 2
    assert (
        "another task: part.name 'peg' (here 'a/b'), part.clearance [0.001, 0.001] (here [0.002, 0.002]); "
        in capsys.readouterr().err
    )
    assert main(["eval", "cap", "--checkpoint", peg]) == 2
    assert "another task: name 'insertion' (here 'cap'); " in capsys.readouterr().err
    assert main(["eval", "insertion", "--part", str(part)]) == 2
    assert "no policy for part 'a/b'" in capsys.readouterr().err
    assert main(["train", "insertion", "--part", str(part), "--out", str(tmp_path / "run"), "--start"]) == 2
    assert "give --start the checkpoint of another part" in capsys.readouterr().err


def test_a_training_without_success_has_no_mean_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limits = ["--envs", "2", "--preset", "fast", "--out", str(tmp_path)]
    assert main(["train", "cap", "--recipe", "no-touch", "--steps", "8", *limits]) == 0
    output = capsys.readouterr()
    assert "success 0.0%" in output.out and "nan" not in output.out + output.err


@pytest.mark.parametrize(("part", "name"), [([], "insertion"), (["--part", "peg"], "peg")])
def test_fine_tuning_starts_from_the_shipped_policy_of_the_part(part: list[str], name: str, tmp_path: Path) -> None:
    options = ["--attempts", "64", "--envs", "4", "--out", str(tmp_path / "run")]
    assert main(["train", "insertion", *part, *options, "--start"]) == 0
    stored = json.loads((tmp_path / "run" / "run.json").read_text())
    shipped = default_checkpoint().with_name(f"{name}.safetensors")
    assert stored["configuration"]["start"] == load_checkpoint(shipped).digest
    assert stored["configuration"]["recipe"] == "fine-tuning" and str(shipped) in stored["command"]
    trained, task = load_checkpoint(tmp_path / "run" / "insertion.safetensors").task, stored["configuration"]["task"]
    *_, start_yaw = task["misalignment"]
    *_, yaw = trained["misalignment"]
    assert start_yaw == pytest.approx(1.3 * yaw), "the policy is for the task, whatever the starts of its training"
