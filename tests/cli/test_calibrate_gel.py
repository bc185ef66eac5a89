"""`gelflow calibrate-gel`: file, picture, summary, errors."""

import json
from pathlib import Path

import pytest

from gelflow.cli.main import main
from gelflow.gel.gel_file import load_gel

GEL = "format = 1\n[gel]\nyoungs_modulus = 1e5\npoisson_ratio = 0.48\nthickness = 0.003\n"
HEAD = "frame,image,stamp,contact,shear_right_n,shear_down_n,normal_n\n"


@pytest.fixture
def tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four presses; the measured forces are 1.5 times the estimates."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "guess.toml").write_text(GEL)
    rows, lines = [], []
    for number in range(40):
        force = (0.0, 1.0, 2.0, 2.0, 1.0)[number % 5] * (1 + number // 10)
        rows.append(f"{number},{number}.jpg,{number / 25},{int(force > 0)},0.1,{0.2 * force},{force}")
        lines.append(f"{number / 25},{1.5 * force}")
    (tmp_path / "a.forces.csv").write_text(HEAD + "\n".join(rows) + "\n")
    (tmp_path / "scale.csv").write_text("stamp,normal_n\n" + "\n".join(lines) + "\n")
    return tmp_path


def test_file_and_picture_are_written(tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["calibrate-gel", "a.forces.csv", "--measured", "scale.csv", "--gel", "guess.toml", "--out", "gel.toml"]
    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    gel = load_gel(tables / "gel.toml")
    assert gel.youngs_modulus == pytest.approx(1.5e5) == printed["gel"]["youngs_modulus"]
    assert printed["contacts"] == 8 and (tables / "gel.png").exists()
    assert main(command) == 2
    assert "exists" in capsys.readouterr().err


def test_the_summary_fits_a_terminal(
    tables: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["calibrate-gel", "a.forces.csv", "--measured", "scale.csv", "--gel", "guess.toml"]) == 0
    printed = capsys.readouterr().out
    assert "1.5e+05 Pa" in printed and "not measured" in printed and "at least" in printed
    assert max(map(len, printed.splitlines())) <= 80


def test_contacts_that_disagree_are_reported(tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tables / "scale.csv"
    lines = [line.split(",") for line in table.read_text().splitlines()[1:]]
    factors = (1.0, 1.3)  # of every second contact
    rows = [f"{stamp},{float(force) * factors[number // 5 % 2]}" for number, (stamp, force) in enumerate(lines)]
    table.write_text("\n".join(["stamp,normal_n", *rows]))
    command = ["calibrate-gel", "a.forces.csv", "--measured", "scale.csv", "--gel", "guess.toml"]
    assert main(command) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "contacts differ by 14 %" in printed and "doubtful" in printed
    assert main([*command, "--json", "--out", "again.toml"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["thickness_doubtful"] and result["gel"]["youngs_modulus_deviation"] > 0.2


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (["--gel", "none.toml"], "none.toml"),
        (["--measured", "a.forces.png"], "a.forces.png"),
        (["--out", "x/gel.toml"], "x"),
        (["--out", "gel.png"], "gel.png: the picture beside the result gets this name"),
        (["--out", "."], ". exists"),
    ],
)
def test_wrong_files_are_refused(
    changed: list[str], named: str, tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(tables.iterdir())
    command = ["calibrate-gel", "a.forces.csv", "--measured", "scale.csv", "--gel", "guess.toml"]
    assert main([*command, *changed]) == 2
    assert named in capsys.readouterr().err
    assert sorted(tables.iterdir()) == before
