"""Grid files: combinations, names of runs, errors."""

from pathlib import Path

import pytest
from tests.policies.sweep.harness import OPTIONS, make_runs

from gelflow.errors import UsageError
from gelflow.policies.sweep.grid import read_grid, run_name

BASE = 'task = "fake"\n'


def test_every_combination_is_run_with_every_seed(tmp_path: Path) -> None:
    runs = make_runs(tmp_path, f"{BASE}seeds = [3, 4]\ncpus = 2\n[grid]\nrate = [0.5, 1]\nfast = [true, false]\n")
    assert [run.name for run in runs[:3]] == [
        "rate=0.5,fast=True,seed=3",
        "rate=0.5,fast=True,seed=4",
        "rate=0.5,fast=False,seed=3",
    ]
    assert len({run.name for run in runs}) == 8
    out = str(tmp_path / "sweep" / "runs" / runs[0].name)
    assert runs[0].arguments == ("train", "fake", "--rate", "0.5", "--fast", "--seed", "3", "--out", out, "--json")
    assert "--fast" not in runs[2].arguments
    assert {run.cpus for run in runs} == {2} and {run.working_folder for run in runs} == {tmp_path}


def test_without_a_grid_there_is_one_configuration(tmp_path: Path) -> None:
    assert [run.name for run in make_runs(tmp_path, BASE)] == ["seed=0"]


def test_names_of_runs_are_file_names_and_differ() -> None:
    names = {run_name({"part": part}) for part in ("a/b.toml", "a_b.toml", "a b.toml", "../a", "x" * 300, "x" * 301)}
    assert len(names) == 6
    assert all("/" not in name and " " not in name and len(name.encode()) < 150 for name in names)
    assert run_name({"part": "a_b.toml"}) == "part=a_b.toml"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[gird]\nrate = [1]", "grid.toml: unknown key 'gird'; did you mean 'grid'?"),
        ("[options]\nrat = 1", "grid.toml, options: unknown key 'rat'; did you mean 'rate'?"),
        ("[grid]\nrte = [1]", "grid.toml, grid: unknown key 'rte'; did you mean 'rate'?"),
        ("[options]\nseed = 1", "'seed' does not belong here; list them as seeds = [0, 1, 2]"),
        ("[options]\nrate = 'much'", "grid.toml: argument --rate: invalid float value: 'much'"),
        ("[options]\nrate = true", "options: rate must be a number, a text, or a list of them, got True"),
        ("[options]\nfast = 1", "options: fast must be true or false, got 1"),
        ("[grid]\nrate = 1", "grid: rate must be a list of values to combine, got 1"),
        ("[grid]\nrate = [1, 1]", "grid: rate contains a value twice"),
        ("[options]\nrate = 1\n[grid]\nrate = [2]", "'rate' is in [options] and in [grid]"),
        ("seeds = [0, 0]", "seeds must be a list of different integers ≥ 0, got [0, 0]"),
        ("seeds = [-1]", "seeds must be a list of different integers"),
        ("seeds = 3", "seeds must be a list of different integers"),
        ("cpus = 0", "cpus must be an integer ≥ 1, got 0"),
        ("[slurm]\nminutes = 0.5", "grid.toml, slurm: minutes must be an integer"),
    ],
)
def test_errors_name_file_and_key(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "grid.toml"
    path.write_text(BASE + text)
    with pytest.raises(UsageError) as error:
        read_grid(path, OPTIONS)
    assert message in str(error.value) and str(path) in str(error.value)


def test_the_task_is_required(tmp_path: Path) -> None:
    (tmp_path / "grid.toml").write_text("seeds = [0]")
    with pytest.raises(UsageError, match=r"grid.toml: task is missing"):
        read_grid(tmp_path / "grid.toml", OPTIONS)
