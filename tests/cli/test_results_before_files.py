"""A result that took long is not lost when its file cannot be written: checks before it, output before the file."""

import json
from pathlib import Path
from typing import Any

import pytest

from gelflow.cli.main import main
from gelflow.cli.promises.outcome import Outcome, Promise, Row
from gelflow.errors import UsageError
from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff

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
    replace("gelflow.cli.promises.outcome.measure", row)
    replace("gelflow.cli.promises.endurance.measure_endurance", Endurance())
    return made


@pytest.mark.parametrize(
    ("command", "file", "key"),
    [
        (TRADEOFF, "a.png", "scene"),
        (BENCH, "bench.json", "format"),
        (PROMISES, "promises.json", "promises"),
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


@pytest.mark.parametrize("command", [TRADEOFF, BENCH, PROMISES, EGM])
def test_a_folder_that_cannot_be_written_is_refused_before_the_measurement(
    command: list[str], tmp_path: Path, measured: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main([*command, str(tmp_path / "file" / "a.png")]) == 2
    assert "cannot write into" in capsys.readouterr().err
    assert measured == []
