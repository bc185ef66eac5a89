"""The scripts in benchmarks/: options, and the records that they write."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from gelflow.policies.calibration.experiment import transfer

SCRIPTS = Path(__file__).resolve().parents[3] / "benchmarks"
NAMES = sorted(path.stem for path in SCRIPTS.glob("*.py") if path.stem != "script")


def run(name: str, *arguments: str, monkeypatch: pytest.MonkeyPatch) -> int | str | None:
    """The exit status of a script."""
    monkeypatch.syspath_prepend(SCRIPTS)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(SCRIPTS / f"{name}.py"), run_name="__main__")
    return end.value.code


@pytest.mark.parametrize("name", NAMES)
def test_script_describes_its_options(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(name, "--help", monkeypatch=monkeypatch) == 0
    assert f"usage: {name}" in capsys.readouterr().out


def test_script_writes_a_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "mesh.json", tmp_path / "mesh.png"
    arguments = ("--quick", "--repeats", "1", "--json", "--out", str(out), "--picture", str(picture))
    assert run("mesh_distance", *arguments, monkeypatch=monkeypatch) == 0
    record = json.loads(out.read_text("utf-8"))
    assert json.loads(capsys.readouterr().out) == record
    assert record["format"] == 1 and record["processor"] and record["versions"]["gelflow"]
    assert {r["solid"] for r in record["results"]} == {"sphere", "box", "cylinder", "bracket"}
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_pictures_are_drawn_from_the_committed_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("scaling", "tracking", "mesh_distance", "convergence", "tradeoff_pushing")
    assert run("pictures", *names, "--out", str(tmp_path), monkeypatch=monkeypatch) == 0
    assert {path.stem for path in tmp_path.iterdir()} == set(names)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in tmp_path.iterdir())


def test_missing_file_gives_status_2(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("compare_pushing", "missing.npz", monkeypatch=monkeypatch) == 2
    assert capsys.readouterr().err == "missing.npz: no such file\n"


def test_only_an_unfinished_transfer_matrix_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [transfer.World("first", {"hole_mu": 0.5}), transfer.World("second", {"hole_mu": 1.0})]
    monkeypatch.setattr(transfer, "worlds", lambda: rows)
    out, unfinished = tmp_path / "transfer.json", tmp_path / "transfer.quick.part"
    arguments = ("transfer", "--quick", "--json", "--out", str(out))

    def corrections() -> list[float]:
        return [row["before"]["corrections"] for row in json.loads(out.read_text())["results"]]

    assert run("calibration", *arguments, monkeypatch=monkeypatch) == 0
    measured = corrections()
    assert len(measured) == 2 and not unfinished.exists()
    record = json.loads(out.read_text())
    record["results"] = record["results"][:1]
    record["results"][0]["before"]["corrections"] = 99.0  # neither run measures this
    out.write_text(json.dumps(record))
    assert run("calibration", *arguments, monkeypatch=monkeypatch) == 0
    assert corrections() == measured
    unfinished.write_text(json.dumps(record))
    assert run("calibration", *arguments, monkeypatch=monkeypatch) == 0
    assert corrections() == [99.0, measured[1]] and not unfinished.exists()
