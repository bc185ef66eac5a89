"""Sweeps through submitit, whose local executor runs the jobs as processes of this machine."""

import os
import signal
import time
from pathlib import Path

import pytest
from tests.policies.sweep.harness import LINUX, TWO_SEEDS, assert_resumed, held, kill, make_runs, signal_worker, sweep

from gelflow.errors import UsageError
from gelflow.policies.sweep.engines.slurm import SlurmEngine, SlurmSettings
from gelflow.policies.sweep.run import Run, read_record
from gelflow.toml_tables import TomlTable

pytest.importorskip("submitit", reason="submitit is not installed (pip install 'gelflow[slurm]')")


@pytest.fixture(autouse=True)
def jobs_import_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """As installed packages are imported on a cluster."""
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
    )


def local(runs: list[Run]) -> SlurmEngine:
    return SlurmEngine(runs[0].folder, SlurmSettings(cluster="local"), cpus=1)


def test_a_killed_run_is_submitted_again_and_continues(tmp_path: Path) -> None:
    first, second = runs = make_runs(tmp_path)
    with held(runs, lambda: kill(first)):
        ended = sweep(runs, lambda: local(runs))
    assert (first.name, "failed", True) in ended
    assert_resumed(first)
    assert read_record(second).starts == 1


@LINUX
def test_a_run_survives_the_death_of_its_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("submitit.core.core.Job._results_timeout_s", 0)  # the results are on a disk of this machine
    runs = make_runs(tmp_path)[:1]
    with held(runs, lambda: signal_worker(runs[0], signal.SIGKILL)):
        ended = sweep(runs, lambda: local(runs))
    assert ended == [(runs[0].name, "failed", True), (runs[0].name, "complete", False)]
    assert_resumed(runs[0])


@LINUX
def test_a_run_continues_after_the_time_limit_of_its_job(tmp_path: Path) -> None:
    """Before its limit a job is sent SIGUSR2; the job is queued again and is no failed run."""
    runs = make_runs(tmp_path)[:1]
    with held(runs, lambda: signal_worker(runs[0], signal.SIGUSR2)):
        ended = sweep(runs, lambda: local(runs))
    assert ended == [(runs[0].name, "complete", False)]
    assert_resumed(runs[0])


def slurm_scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, states: str) -> Path:
    """Scripts as the commands of SLURM, with these lines of states; the file with a line for each submitted job."""
    scripts, submitted = tmp_path / "bin", tmp_path / "submitted"
    scripts.mkdir()
    for name, text in (
        ("srun", ""),
        ("sbatch", f"echo job >> '{submitted}'\necho Submitted batch job 7\n"),
        ("sacct", f"echo 'JobID|State|NodeList'\n{states}"),
    ):
        (scripts / name).write_text(f"#!/bin/sh\n{text}")
        (scripts / name).chmod(0o755)
    monkeypatch.setenv("PATH", os.pathsep.join([str(scripts), os.environ["PATH"]]))
    return submitted


def submit(run: Run) -> None:
    with SlurmEngine(run.folder, SlurmSettings(), cpus=1) as engine:
        engine.submit([run])


def test_a_job_that_slurm_does_not_know_yet_is_not_submitted_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitted, run = slurm_scripts(tmp_path, monkeypatch, states=""), make_runs(tmp_path)[0]
    submit(run)
    submit(run)
    assert submitted.read_text() == "job\n"
    os.utime(run.folder / "jobs" / f"{run.name}.id", (time.time() - 900, time.time() - 900))
    submit(run)  # after a quarter of an hour it is forgotten
    assert submitted.read_text() == "job\njob\n"


def test_a_pending_job_is_not_submitted_twice_and_its_options_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands of SLURM are scripts: each job stays in the queue."""
    submitted = slurm_scripts(tmp_path, monkeypatch, states="echo '7|PENDING|None assigned'\n")
    run = make_runs(tmp_path)[0]
    submit(run)
    submit(run)
    with pytest.raises(UsageError, match=r"with other options: 2\.0, now 3\.0; choose another --out"):
        submit(make_runs(tmp_path, TWO_SEEDS.replace("2.0", "3.0"))[0])
    assert submitted.read_text() == "job\n"


def test_settings_become_options_of_sbatch() -> None:
    data = {"partition": "cpu", "minutes": 90, "memory_gb": 2.5, "parallel": 8, "setup": "module load gcc"}
    settings = SlurmSettings.from_table(TomlTable({**data, "sbatch": {"constraint": "avx2"}}, "grid.toml, slurm"))
    assert settings.parameters(cpus=2) == {
        "name": "gelflow",
        "timeout_min": 90,
        "mem_gb": 2.5,
        "cpus_per_task": 2,
        "slurm_partition": "cpu",
        "slurm_array_parallelism": 8,
        "slurm_setup": ["module load gcc"],
        "slurm_additional_parameters": {"constraint": "avx2"},
    }
    with pytest.raises(UsageError, match="unknown key 'partitoin'; did you mean 'partition'"):
        SlurmSettings.from_table(TomlTable({"partitoin": "cpu"}, "grid.toml, slurm"))


def test_a_machine_without_slurm_is_an_error_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="this machine has no SLURM"):
        SlurmEngine(tmp_path, SlurmSettings(), cpus=1)
