"""The command `gelflow sweep` with tiny trainings."""

import json
from pathlib import Path

import pytest

from gelflow.cli.commands.training.sweep import train_options
from gelflow.cli.main import main
from gelflow.policies.checkpoint import load_checkpoint
from gelflow.policies.sweep.grid import read_grid
from gelflow.policies.sweep.run import RunRecord, write_record

GRID = 'task = "insertion"\nseeds = [0, 1]\n[options]\nattempts = 16\nenvs = 4\n'


@pytest.mark.slow
def test_a_sweep_of_real_trainings_collects_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid, out = tmp_path / "tiny.toml", tmp_path / "sweep"
    grid.write_text(GRID)
    assert main(["sweep", str(grid), "--out", str(out), "--jobs", "1", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["complete"] == 2 and printed["failed"] == 0
    assert [row["seed"] for row in printed["runs"]] == [0, 1]
    for row in printed["runs"]:
        checkpoint = load_checkpoint(Path(row["checkpoint"]))
        assert checkpoint.training["run"]["seed"] == row["seed"]
    assert all(Path(path).stat().st_size > 0 for path in printed["files"].values())
    assert set(printed["files"]) == {"runs", "summary", "curves", "picture"}
    (configuration,) = printed["configurations"]
    assert configuration["complete"] == 2 and "validation.success" in configuration["results"]

    before = sorted((path, path.stat().st_mtime_ns) for path in (out / "runs").rglob("*"))
    assert main(["sweep", str(grid), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "2 runs in" in text and "2 of them complete" in text and "success" in text
    assert max(map(len, text.splitlines()[1:-1])) <= 100
    assert sorted((path, path.stat().st_mtime_ns) for path in (out / "runs").rglob("*")) == before


def test_a_failed_run_gives_exit_code_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = tmp_path / "wrong.toml"
    grid.write_text('task = "insertion"\n[options]\npreset = "fas"\n')
    assert main(["sweep", str(grid), "--out", str(tmp_path / "sweep"), "--tries", "1"]) == 1
    text = capsys.readouterr().out
    assert "failed: seed=0: exit code 2: gelflow train: " in text and "no preset 'fas'" in text


def test_a_refused_sweep_keeps_the_stored_grid_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid, out = tmp_path / "grid.toml", tmp_path / "sweep"
    grid.write_text(GRID)
    for run in read_grid(grid, train_options()).runs(out):
        run.record.parent.mkdir(parents=True, exist_ok=True)
        write_record(run, RunRecord(run.name, run.arguments, "complete"))
    (out / "grid.toml").write_text(GRID)
    grid.write_text(GRID.replace("16", "32"))
    assert main(["sweep", str(grid), "--out", str(out)]) == 2
    assert "with other options: 16, now 32; choose another --out" in capsys.readouterr().err
    assert (out / "grid.toml").read_text() == GRID


def complete_sweep(tmp_path: Path, text: str) -> list[str]:
    """The command of a sweep with one run, which is complete already."""
    grid, out = tmp_path / "grid.toml", tmp_path / "sweep"
    grid.write_text(text)
    (run,) = read_grid(grid, train_options()).runs(out)
    (tmp_path / "progress.csv").write_text("steps,success\n0,0.5\n")
    run.record.parent.mkdir(parents=True)
    result = {"learning_curve": str(tmp_path / "progress.csv"), "validation": {"success": 0.5}}
    write_record(run, RunRecord(run.name, run.arguments, "complete", 1, "host", 60.0, 0, "", result))
    return ["sweep", str(grid), "--out", str(out), "--json"]


def test_results_are_printed_before_the_error_of_a_wrong_curve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = complete_sweep(tmp_path, 'task = "insertion"\ncurve = "exploration"\n')  # missing in this table
    assert main(command) == 2
    printed = capsys.readouterr()
    assert json.loads(printed.out)["runs"][0]["validation.success"] == 0.5
    assert "learning curves have no column 'exploration'; valid names: success" in printed.err
    assert set(json.loads(printed.out)["files"]) == {"runs", "summary"}


def test_results_are_printed_where_a_table_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = complete_sweep(tmp_path, 'task = "insertion"\n')
    (tmp_path / "sweep" / "runs.csv").mkdir()
    assert main(command) == 2
    printed = capsys.readouterr()
    assert json.loads(printed.out)["complete"] == 1 and "runs.csv" in printed.err


def test_a_grid_file_of_something_else_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tiny.toml").write_text(GRID)
    (tmp_path / "grid.toml").write_text("mine = 1\n")
    assert main(["sweep", str(tmp_path / "tiny.toml"), "--out", str(tmp_path)]) == 2
    assert "grid.toml is not of these runs; choose another folder or delete it" in capsys.readouterr().err
    assert (tmp_path / "grid.toml").read_text() == "mine = 1\n"


@pytest.mark.parametrize("name", ["runs.csv", "summary.csv", "curves.csv", "curves.png"])
def test_results_of_something_else_are_not_replaced(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny.toml").write_text(GRID)
    (tmp_path / name).write_text("mine")
    assert main(["sweep", str(tmp_path / "tiny.toml"), "--out", str(tmp_path)]) == 2
    assert f"{name} is not of these runs; choose another folder or delete it" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "mine" and not (tmp_path / "grid.toml").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[options]\natempts = 1", "unknown key 'atempts'; did you mean 'attempts'?"),
        ("[options]\nout = 'x'", "every run has a folder of its own"),
        ("[options]\nattempts = 'many'", "argument --steps/--attempts: invalid int value: 'many'"),
        ("[grid]\npresets = ['fast']", "grid: unknown key 'presets'; did you mean 'preset'?"),
        ("[options]\nattempts = 0", "--attempts must be above 0, got 0"),
        ("[options]\nrecipe = 'paper'", "--recipe is for other tasks than the insertion"),
        ("curve = 'sucess'", "learning curves have no column 'sucess'; did you mean 'success'?"),
        ("curve = 'exploration'\n[grid]\nalgorithm = ['imitation', 'ppo']", "have no column 'exploration'"),
        ("[options]\nsteps = 16\n[grid]\nattempts = [32]", "'steps' and 'attempts' are one option; keep one of them"),
        ("[options]\nsteps = 16\nattempts = 32", "'steps' and 'attempts' are one option; keep one of them"),
    ],
)
def test_a_wrong_grid_file_is_an_error_in_one_line(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = tmp_path / "grid.toml"
    grid.write_text(f'task = "insertion"\n{text}\n')
    assert main(["sweep", str(grid), "--out", str(tmp_path / "sweep")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gelflow sweep: {grid}") and message in error and error.count("\n") == 1
    assert not (tmp_path / "sweep").exists()
