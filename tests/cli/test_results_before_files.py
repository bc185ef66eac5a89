"""A result that took long is not lost when its file cannot be written: checks before it, output before the file."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.mock_lab.promises.outcome import Outcome, Promise, Row
from gelflow.policies.calibration.planning.motions import Plan
from gelflow.policies.calibration.session_recordings import nothing_recorded
from gelflow.session.motion_plan import PlannedMotion
from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff
from gelflow.task import INSERTION

TRADEOFF = ["tradeoff", "pushing", "--json", "--out"]
BENCH = ["bench", "scenes", "--quick", "--json", "--out"]
PROMISES = ["soak", "--promises", "--only", "contact", "--json", "--out"]
EGM = ["soak", "--egm", "1", "--json", "--out"]


def row(promise: Promise) -> Row:
    return Row(promise, Outcome(0.0), 0.0)


def refuse(tradeoff: Tradeoff, path: Path) -> None:
    raise UsageError(f"cannot write the picture {path}")


class Endurance:
    """A result of `measure_endurance`."""

    missed, stops = 0.0, ()

    def lines(self) -> list[str]:
        return []

    def to_json(self) -> dict[str, Any]:
        return {"missed": self.missed}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the measurements that were made; none takes time."""
    made: list[str] = []

    def replace(target: str, result: Any) -> None:
        def measure(*arguments: Any, **options: Any) -> Any:
            made.append(target)
            return result(*arguments) if callable(result) else result

        monkeypatch.setattr(target, measure)

    replace("gelflow.sim.benchmark.tradeoff.sweep.measure", Tradeoff("pushing", (), {}, 1e-3, {}, 1))
    replace("gelflow.cli.commands.bench._measure", [])
    replace("gelflow.mock_lab.promises.outcome.measure", row)
    replace("gelflow.mock_lab.promises.endurance.measure_endurance", Endurance())
    return made


@pytest.mark.parametrize(
    ("command", "file", "key"),
    [
        (TRADEOFF, "a.png", "scene"),
        (BENCH, "bench.json", "format"),
        (PROMISES, "promises-contact.json", "promises"),
        (EGM, "egm.json", "missed"),
    ],
)
def test_the_result_is_printed_before_its_file_is_written(
    command: list[str],
    file: str,
    key: str,
    tmp_path: Path,
    measured: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("gelflow.sim.benchmark.tradeoff.picture.draw", refuse)
    (tmp_path / file).mkdir()  # in place of the file
    assert main([*command, str(tmp_path / file if command is TRADEOFF else tmp_path)]) == 2
    printed = capsys.readouterr()
    assert key in json.loads(printed.out) and file in printed.err
    assert len(measured) == 1


@pytest.mark.parametrize("target", ["_write_new", "plan_motions", "save_motion_plan"])
def test_a_fit_is_printed_where_the_report_or_the_plan_fails(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = nothing_recorded(INSERTION, grasp_force=None, grasp_height=None)
    plan = Plan((PlannedMotion(3e-3, 0.0, 0.0, 1e-3),), (1.5,), {})
    replaced: dict[str, Any] = {
        **{"read_attempts": recordings, "plan_motions": plan, "plain_report": {"attempts": {}}, "page": ""},
        **{"calibrate": SimpleNamespace(known=None, recordings=recordings), "write_scene": [], target: None},
    }

    def replace(name: str) -> Any:
        def function(*arguments: Any, **options: Any) -> Any:
            if name == target:
                raise UsageError("No space left on device")
            return replaced[name]

        return function

    for name in replaced:
        monkeypatch.setattr(f"gelflow.cli.commands.calibrate.{name}", replace(name))
    files = ["--out", str(tmp_path / "out"), "--plan", str(tmp_path / "plan.toml")]
    assert main(["calibrate", "a.mcap", *files, "--json"]) == 2
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    assert values["attempts"] == {} and "No space left on device" in printed.err
    assert [motion["gain"] for motion in values.get("plan", [])] == ([1.5] if target == "save_motion_plan" else [])
    if target == "save_motion_plan":
        assert main(["calibrate", *files[2:], "--json"]) == 2  # without a session
        assert json.loads(capsys.readouterr().out)["plan"] == values["plan"]


@pytest.mark.parametrize("command", [TRADEOFF, BENCH, PROMISES, EGM])
def test_a_folder_that_cannot_be_written_is_refused_before_the_measurement(
    command: list[str], tmp_path: Path, measured: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main([*command, str(tmp_path / "file" / "a.png")]) == 2
    assert "cannot write into" in capsys.readouterr().err
    assert measured == []
