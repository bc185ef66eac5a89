"""`gelflow soak` and the options of `gelflow mock` that it uses: results, resumption, errors."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

import gelflow.mock_lab.soak.case as soak_case
from gelflow.cli.main import main
from gelflow.errors import PeerError, PeerRefused
from gelflow.hardware_mocks.faults.random_plan import random_plan
from gelflow.hardware_mocks.simulated_cell.random_world import random_world
from gelflow.mock_lab.robot_process import mock_robot
from gelflow.mock_lab.soak.case import REFUSED_WORLD, SoakCase, _outcome, _Watch


def row(seed: int, violations: list[str]) -> dict[str, Any]:
    truth = {"inserted": True, "largest_push": 2e-4}
    plan = str(random_plan(seed))
    return {"outcome": "inserted", "kinds": ["drop"], "violations": violations, "truth": truth, "plan": plan, "wall": 1}


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds that were run; seed 3 violates a rule, and no mock robot is started."""
    seeds: list[int] = []

    def run(case: SoakCase, keep: Path | None = None) -> dict[str, Any]:
        seeds.append(case.seed)
        assert (case.plan, case.world) == (random_plan(case.seed), random_world(case.seed))
        return row(case.seed, ["hang"] if case.seed == 3 else [])

    monkeypatch.setattr(SoakCase, "run", run)
    return seeds


def test_a_soak_test_continues_where_it_ended(
    tmp_path: Path, cases: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["soak", "--plans", "2", "--out", str(tmp_path)]) == 0
    assert cases == [0, 1]
    capsys.readouterr()
    assert main(["soak", "--plans", "5", "--out", str(tmp_path), "--json"]) == 1
    assert cases == [0, 1, 2, 3, 4]
    result = json.loads(capsys.readouterr().out)
    assert result["plans"] == 5 and result["failing"] == [3]
    assert result["outcomes"] == {"inserted": 5} and result["violations"] == {"hang": 1}


def test_one_plan_runs_again_alone(tmp_path: Path, cases: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["soak", "--only", "3", "--out", str(tmp_path)]) == 1
    capsys.readouterr()
    assert main(["soak", "--only", "3", "--out", str(tmp_path), "--json"]) == 1
    assert cases == [3, 3]
    assert json.loads(capsys.readouterr().out)["rows"][0]["violations"] == ["hang"]


def test_a_mock_robot_that_never_starts_ends_the_soak_test(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(case: SoakCase, keep: Path | None = None) -> dict[str, Any]:
        raise PeerError("the mock robot did not start")

    monkeypatch.setattr(SoakCase, "run", run)
    assert main(["soak", "--plans", "9", "--out", str(tmp_path)]) == 2
    assert "3 plans in sequence did not run" in capsys.readouterr().err


@pytest.fixture
def failing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """No mock robot starts."""

    def run(case: SoakCase, keep: Path | None = None) -> dict[str, Any]:
        raise PeerError("the mock robot did not start")

    monkeypatch.setattr(SoakCase, "run", run)


@pytest.mark.usefixtures("failing_starts")
def test_plans_that_did_not_run_are_named_and_are_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["soak", "--plans", "2", "--out", str(tmp_path), "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["plans"] == 0 and result["not_run"] == [0, 1]
    assert main(["soak", "--plans", "2", "--out", str(tmp_path)]) == 1
    assert "not run: 0 1" in capsys.readouterr().out


def test_one_plan_that_does_not_run_is_an_error(
    tmp_path: Path, cases: list[int], request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a new folder, and where the folder contains an earlier result of the plan."""
    assert main(["soak", "--only", "1", "--out", str(tmp_path / "used")]) == 0
    request.getfixturevalue("failing_starts")
    for folder in ("new", "used"):
        capsys.readouterr()
        assert main(["soak", "--only", "1", "--out", str(tmp_path / folder)]) == 2
        assert "plan 1 did not run: the mock robot did not start" in capsys.readouterr().err
    assert cases == [1]


@pytest.mark.parametrize(
    ("options", "changed"),
    [
        (["--factor", "4"], "factor 2.0, not 4.0"),
        (["--jitter", "0.3"], "jitter 0.1, not 0.3"),
        (["--preset", "fast"], "preset None, not fast"),
    ],
)
def test_a_soak_test_with_other_settings_needs_another_folder(
    tmp_path: Path, cases: list[int], options: list[str], changed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["soak", "--plans", "1", "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    assert main(["soak", "--plans", "2", "--out", str(tmp_path), *options]) == 2
    error = capsys.readouterr().err
    assert f"has plans with --{changed}; name another --out" in error and error.count("\n") == 1
    assert cases == [0]


def test_a_refused_world_is_a_row_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(case: SoakCase, keep: Path | None = None) -> dict[str, Any]:
        raise PeerRefused("the mock robot did not start: gelflow mock: the markers are uneven")

    monkeypatch.setattr(SoakCase, "run", run)
    assert main(["soak", "--plans", "4", "--out", str(tmp_path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["plans"] == 4 and result["outcomes"] == {REFUSED_WORLD: 4} and not result["kinds"]
    assert main(["soak", "--plans", "4", "--out", str(tmp_path)]) == 0, "the rows are known; nothing is run again"
    capsys.readouterr()
    assert main(["soak", "--only", "1", "--out", str(tmp_path), "--json"]) == 0
    assert "markers are uneven" in json.loads(capsys.readouterr().out)["rows"][0]["message"]


def test_a_mock_robot_that_refuses_its_options_says_why(tmp_path: Path) -> None:
    missing = tmp_path / "missing.toml"
    with pytest.raises(PeerRefused, match=re.escape(str(missing))), mock_robot(factor=1.0, seed=0, world=missing):
        pass


@pytest.mark.parametrize("arguments", [["--plans", "0"], ["--jobs", "0"], ["--seed", "-1"]])
def test_options_out_of_range_are_refused(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["soak", "--out", str(tmp_path), *arguments]) == 2
    assert "must be at least" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--world", "--faults"])
def test_mock_refuses_a_wrong_file_in_one_line(tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text("unknown = 1\n")
    for name in (path, tmp_path / "missing.toml"):
        assert main(["mock", option, str(name)]) == 2
        message = capsys.readouterr().err
        assert str(name) in message and message.count("\n") == 1


def test_outcomes_are_those_of_the_part_without_numbers() -> None:
    inserted = json.dumps({"insertions": [{"outcome": "inserted"}]})
    assert _outcome(inserted, "") == "inserted"
    assert _outcome(json.dumps({"insertions": [{"outcome": "part slipped 1.25 mm"}]}), "") == "part slipped N mm"
    assert _outcome("", "gelflow run: preflight failed: gripper") == "refused at preflight"
    assert _outcome("", "gelflow run: the arm stopped") == "stopped by an error"


def test_idle_time_counts_from_the_first_motion() -> None:
    watch = _Watch(allowed_idle=10.0)
    for time, z, width in [(0, 0.5, 0.06), (5, 0.5, 0.06), (6, 0.5, 0.05), (7, 0.4, 0.05), (9, 0.4, 0.05)]:
        watch.see({"time": float(time), "tool": [0.0, 0.0, z], "width": width})
    assert watch.idle == 2.0


def test_a_runner_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak_case, "_END_LIMIT", 0.5)
    process = subprocess.Popen(["sh", "-c", "trap '' TERM; sleep 60 & wait; sleep 60"])
    soak_case._end(process)
    assert process.returncode is not None and process.returncode < 0
