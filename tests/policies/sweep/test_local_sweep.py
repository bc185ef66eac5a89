"""Sweeps on this machine: killed runs continue, complete runs are not repeated, failures are reported."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.common.processes import is_running
from tests.policies.sweep.harness import (
    LINUX,
    TWO_SEEDS,
    Worker,
    assert_resumed,
    held,
    is_held,
    kill,
    make_runs,
    steps,
    sweep,
    wait_until,
)

from gelflow.errors import UsageError
from gelflow.policies.sweep.engines.local import LocalEngine
from gelflow.policies.sweep.run import read_record, write_record
from gelflow.policies.sweep.run_process import RunProcess, execute
from gelflow.policies.sweep.sweep import incomplete, sweep_folder

ROOT = Path(__file__).resolve().parents[3]


def two() -> LocalEngine:
    return LocalEngine(2)


def test_a_killed_run_is_started_again_and_continues(tmp_path: Path) -> None:
    first, second = runs = make_runs(tmp_path)
    with held(runs, lambda: kill(first)):
        ended = sweep(runs, two)
    assert sorted(ended) == sorted(
        [(first.name, "failed", True), (first.name, "complete", False), (second.name, "complete", False)]
    )
    assert_resumed(first)
    assert read_record(second).starts == 1
    assert read_record(first).result["validation"] == {"success": 18.0}
    assert first.log.read_text().count("=== start ") == 2


def test_complete_runs_are_not_started_again(tmp_path: Path) -> None:
    runs = make_runs(tmp_path)
    sweep(runs, two)
    before = [read_record(run) for run in runs]
    more = make_runs(tmp_path, TWO_SEEDS.replace("[0, 1]", "[0, 1, 2]"))
    assert [name for name, _, _ in sweep(more, two)] == ["seed=2"]
    assert [read_record(run) for run in runs] == before


def test_other_options_in_the_same_folder_are_refused(tmp_path: Path) -> None:
    sweep(make_runs(tmp_path), two)
    with pytest.raises(UsageError, match=r"with other options: 2\.0, now 3\.0; choose another --out"):
        incomplete(make_runs(tmp_path, TWO_SEEDS.replace("2.0", "3.0")))


def test_a_failing_run_is_tried_a_few_times_and_others_go_on(tmp_path: Path) -> None:
    runs = make_runs(tmp_path)
    sweep(runs[:1], two)
    (runs[0].folder / "fail").touch()
    ended = sweep(runs, two, tries=2)
    assert ended == [(runs[1].name, "failed", True), (runs[1].name, "failed", False)]
    record = read_record(runs[1])
    assert record.error == "exit code 3: asked to fail" and record.starts == 2
    (runs[0].folder / "fail").unlink()
    assert sweep(runs, two) == [(runs[1].name, "complete", False)]


def test_exit_code_2_is_tried_again(tmp_path: Path) -> None:
    """It is that of a full disk too, not only of wrong input."""
    (run,) = make_runs(tmp_path)[:1]
    run.folder.mkdir()
    (run.folder / "refuse").touch()
    assert sweep([run], two, tries=2) == [(run.name, "failed", True), (run.name, "failed", False)]
    assert read_record(run).error == "exit code 2: asked to refuse"


@pytest.mark.parametrize(("hook", "starts"), [("crash", 1), ("full", 2)])
def test_a_finished_run_with_a_lost_exit_code_or_result_completes(tmp_path: Path, hook: str, starts: int) -> None:
    (run,) = make_runs(tmp_path)[:1]
    run.folder.mkdir()
    (run.folder / hook).touch()
    ended = sweep([run], two, tries=2)
    assert ended == [*[(run.name, "failed", True)] * (starts - 1), (run.name, "complete", False)]
    record = read_record(run)
    assert record.starts == starts and record.result["validation"] == {"success": 18.0}


def test_at_most_one_process_executes_a_run(tmp_path: Path) -> None:
    (run,) = make_runs(tmp_path)[:1]
    with sweep_folder(run.folder):
        (run.folder / "hold").touch()
        with RunProcess(run) as first, RunProcess(run) as second:
            assert first.poll() is None
            wait_until(lambda: is_held(run))
            assert second.poll() is None
            (run.folder / "hold").unlink()
            wait_until(lambda: first.poll() is not None)
            first.close()
            record = second.poll()  # the result of the first; nothing is started
        assert record is not None and record.state == "complete" and record.starts == 1


def test_the_result_of_a_run_that_ended_after_its_worker_was_lost_is_kept(tmp_path: Path) -> None:
    (run,) = make_runs(tmp_path)[:1]
    sweep([run], two)
    complete = read_record(run)
    write_record(run, dataclasses.replace(complete, state="failed", exit_code=None, error="lost", result={}))
    assert sweep([run], two) == [(run.name, "complete", False)]
    assert read_record(run) == complete


def test_a_complete_run_whose_result_does_not_arrive_is_complete(tmp_path: Path) -> None:
    (run,) = make_runs(tmp_path)[:1]
    assert sweep([run], lambda: Worker(loses_results=True)) == [(run.name, "complete", False)]
    record = read_record(run)
    assert (record.state, record.exit_code, record.error, record.starts) == ("complete", 0, "", 1)
    assert record.result["validation"] == {"success": 18.0}


def test_a_run_without_its_record_and_folder_is_started_again(tmp_path: Path) -> None:
    """Its former output, which remains, is not taken as its result."""
    (run,) = make_runs(tmp_path)[:1]
    sweep([run], two)
    run.record.unlink()
    shutil.rmtree(run.folder / "runs" / run.name)
    assert sweep([run], two) == [(run.name, "complete", False)]
    assert read_record(run).starts == 1 and run.log.read_text().count("=== start ") == 2


def test_a_machine_without_the_folder_reports_it(tmp_path: Path) -> None:
    (run,) = make_runs(tmp_path)[:1]
    record = execute(run, "node7")
    assert record.state == "failed"
    assert "node7 has no folder" in record.error and "all machines of a sweep must share it" in record.error


def test_the_reason_why_a_machine_could_not_start_a_run_is_stored(tmp_path: Path) -> None:
    run = dataclasses.replace(make_runs(tmp_path)[0], working_folder=tmp_path / "elsewhere")
    assert sweep([run], Worker, tries=2) == [(run.name, "failed", True), (run.name, "failed", False)]
    record = read_record(run)
    assert record.state == "failed" and record.starts == 0
    assert "node7 has no folder" in record.error


def test_two_sweeps_cannot_use_one_folder(tmp_path: Path) -> None:
    run = make_runs(tmp_path)[0]
    with (
        sweep_folder(run.folder),
        pytest.raises(UsageError, match=f"another sweep uses .* process {os.getpid()}"),
        sweep_folder(run.folder),
    ):
        pass


@LINUX
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_runs_end_with_their_sweep_and_the_next_sweep_continues_them(tmp_path: Path, number: signal.Signals) -> None:
    runs = make_runs(tmp_path)
    code = (
        "import sys; from pathlib import Path\n"
        "from gelflow.interrupts import interruptible\n"
        "from tests.policies.sweep.harness import make_runs, sweep\n"
        "from tests.policies.sweep.test_local_sweep import two\n"
        "with interruptible(): sweep(make_runs(Path(sys.argv[1])), two)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with held(runs, lambda: os.kill(process.pid, number), release=False):
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
        process.wait()
    wait_until(lambda: not any(is_running(steps(run)[-1][1]) for run in runs))
    (runs[0].folder / "hold").unlink()
    sweep(runs, two)
    for run in runs:
        assert_resumed(run)
