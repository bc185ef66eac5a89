"""Rows, summary and learning curves of a sweep."""

import csv
import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from gelflow.cli.commands.training.sweep.table import summary_table
from gelflow.errors import UsageError
from gelflow.policies.sweep import curves, results
from gelflow.policies.sweep.run import Run, RunRecord


def sweep_of(
    folder: Path, tables: dict[tuple[str, int], list[tuple[Any, ...]]]
) -> tuple[list[Run], dict[str, RunRecord]]:
    """Runs by preset and seed that wrote these learning curves, and their records."""
    runs, records = [], {}
    for (preset, seed), table in tables.items():
        run = Run(f"{preset},{seed}", folder, folder, (), {"preset": preset}, seed)
        path = folder / f"{run.name}.csv"
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([("steps", "success", "note"), *table])
        result = {"learning_curve": str(path), "validation": {"success": float(table[-1][1] or 0), "goals": [1, 2]}}
        runs.append(run)
        records[run.name] = RunRecord(run.name, (), "complete", 1, "host", 2.0, 0, "", result)
    return runs, records


def test_a_row_has_options_state_and_results(tmp_path: Path) -> None:
    runs, records = sweep_of(tmp_path, {("fast", 0): [(0, 0.0, ""), (1, 0.5, "")]})
    (row,) = results.rows(runs, records)
    assert row | {"name": "fast,0", "preset": "fast", "seed": 0, "state": "complete", "starts": 1} == row
    assert row["validation.success"] == 0.5 and row["validation.goals"] == "[1, 2]"
    results.write_csv(tmp_path / "rows.csv", [row])
    with (tmp_path / "rows.csv").open() as file:
        (read,) = csv.DictReader(file)
    assert read["validation.success"] == "0.5"


def test_an_option_with_the_name_of_another_column_has_a_column_of_its_own(tmp_path: Path) -> None:
    runs, records = sweep_of(tmp_path, {("fast", 0): [(0, 0.0, ""), (1, 0.5, "")]})
    options = {"steps": 10_000, "minutes": 5.0, "preset": "fast"}
    runs = [dataclasses.replace(run, values=options) for run in runs]
    for record in records.values():
        record.result.update({"steps": 10_240, "minutes": 0.5})
    (row,), found = results.rows(runs, records), results.configurations(runs, records)
    assert (row["option.steps"], row["option.minutes"], row["preset"]) == (10_000, 5.0, "fast")
    assert (row["steps"], row["minutes"]) == (10_240, 0.5)
    (summary,) = results.summary_rows(found)
    assert summary["option.steps"] == 10_000 and summary["steps median"] == 10_240
    drawn = curves.read_curves(runs, records)
    assert drawn is not None
    assert [(point["option.steps"], point["steps"]) for point in drawn.rows()] == [(10_000, 0), (10_000, 1)]
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(summary_table(found, console))
    assert "option.steps" in console.export_text()


def test_a_configuration_has_median_and_range_of_its_complete_runs(tmp_path: Path) -> None:
    ends: dict[tuple[str, int], float] = {
        ("fast", 0): 0.5,
        ("fast", 1): 0.9,
        ("fast", 2): 0.6,
        ("fast", 3): 0.0,
        ("balanced", 0): 1.0,
    }
    tables: dict[tuple[str, int], list[tuple[Any, ...]]] = {key: [(0, value, "")] for key, value in ends.items()}
    runs, records = sweep_of(tmp_path, tables)
    records["fast,3"] = RunRecord("fast,3", (), "failed")
    fast, balanced = results.configurations(runs, records)
    assert (fast.runs, fast.complete, balanced.complete) == (4, 3, 1)
    assert fast.results["validation.success"] == results.Range(0.6, 0.5, 0.9)
    assert "validation.goals" not in fast.results and "learning_curve" not in fast.results
    summary = results.summary_rows([fast, balanced])
    assert summary[0]["validation.success median"] == 0.6 and summary[1]["validation.success smallest"] == 1.0


def test_curves_are_interpolated_to_the_common_points_of_the_seeds(tmp_path: Path) -> None:
    tables: dict[tuple[str, int], list[tuple[Any, ...]]] = {
        ("fast", 0): [(0, 0.0, "a"), (10, "", ""), (20, 1.0, "")],
        ("fast", 1): [(0, 0.2, "b"), (10, 0.4, ""), (30, 0.6, "")],
    }
    found = curves.read_curves(*sweep_of(tmp_path, tables))
    assert found is not None and (found.x_name, found.y_name) == ("steps", "success")
    (curve,) = found.curves
    np.testing.assert_allclose(curve.x, [0, 10, 20])
    np.testing.assert_allclose(curve.low, [0.0, 0.4, 0.5])
    np.testing.assert_allclose(curve.high, [0.2, 0.5, 1.0])
    np.testing.assert_allclose(curve.median, [0.1, 0.45, 0.75])
    assert found.rows()[0] | {"preset": "fast", "steps": 0.0, "smallest": 0.0, "seeds": 2} == found.rows()[0]


def test_many_configurations_are_drawn_in_one_picture(tmp_path: Path) -> None:
    tables: dict[tuple[str, int], list[tuple[Any, ...]]] = {
        (f"p{i}", seed): [(step, i + seed * step, "") for step in range(5)] for i in range(9) for seed in range(2)
    }
    found = curves.read_curves(*sweep_of(tmp_path, tables))
    assert found is not None and len(found.curves) == 9
    curves.draw(tmp_path / "curves.png", found, "fake")
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_an_unknown_column_is_an_error_that_names_the_nearest(tmp_path: Path) -> None:
    runs, records = sweep_of(tmp_path, {("fast", 0): [(0, 0.0, "")]})
    with pytest.raises(UsageError, match="no column 'sucess'; did you mean 'success'"):
        curves.read_curves(runs, records, "sucess")


def test_runs_without_learning_curves_have_none(tmp_path: Path) -> None:
    runs, records = sweep_of(tmp_path, {("fast", 0): [(0, 1.0, "")]})
    Path(str(records["fast,0"].result["learning_curve"])).unlink()
    assert curves.read_curves(runs, records) is None


def test_a_narrow_table_shows_success_before_other_results() -> None:
    numbers = {"steps": 4096.0, "minutes": 0.2426, "validation.success": 0.75, "validation.reward": -3.0}
    ranges = {name: results.Range.of([value]) for name, value in numbers.items()}
    found = results.Configuration({"envs": 32}, 1, 1, ranges)
    console = Console(width=32, record=True, file=io.StringIO())
    console.print(summary_table([found], console))
    text = console.export_text()
    assert "success" in text and "0.75" in text and "minutes" not in text
