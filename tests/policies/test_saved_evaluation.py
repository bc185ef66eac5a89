"""The folder of an evaluation, read again and shown on a page."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.policies.training_page import check_page
from tests.view.browser import needs_browser

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.reports.saved_evaluation import SavedEvaluation, is_evaluation


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("evaluation") / "some report"
    assert main(["eval", "insertion", "--episodes", "8", "--envs", "4", "--out", str(made)]) == 0
    return made


def test_results_failures_and_films_are_those_of_the_files(folder: Path) -> None:
    evaluation = SavedEvaluation(folder)
    assert evaluation.name == "some report" and evaluation.curve() is None
    shown = evaluation.evaluate()
    assert shown is not None and evaluation.evaluate() is None
    rows = json.loads((folder / "results.json").read_text())["results"]
    assert "| corrections |" in shown.text
    for row in rows:
        assert f"| {row['name']} of 8 episodes | {row['success']:.1%} |" in shown.text
    assert shown.failures is not None and shown.failures.ndim == 3
    assert set(shown.films) == {path.stem for path in folder.glob("*.gif")}
    for film in shown.films.values():
        assert len(film) >= 2 and film[0].dtype == np.uint8 and film[0].shape == film[-1].shape
    assert 0.1 < shown.frames_per_second <= 25


def test_an_evaluation_that_is_written_again_is_read_again(folder: Path) -> None:
    evaluation = SavedEvaluation(folder)
    assert evaluation.evaluate() is not None
    results = folder / "results.json"
    results.write_text(results.read_text().replace('"policy"', '"another policy"'))
    shown = evaluation.evaluate()
    assert shown is not None and "another policy of 8" in shown.text


@pytest.mark.parametrize("results", ["{", "{}", '{"results": [], "failures": []}', '{"results": [{"name": "x"}]}'])
def test_damaged_results_are_refused(tmp_path: Path, results: str) -> None:
    with pytest.raises(UsageError, match="not the folder of an evaluation"):
        SavedEvaluation(tmp_path)
    (tmp_path / "results.json").write_text(results)
    (tmp_path / "episodes.csv").write_text("")
    assert is_evaluation(tmp_path)
    with pytest.raises(UsageError, match=r"cannot be read: .*; run gelflow eval again"):
        SavedEvaluation(tmp_path).evaluate()


def test_results_of_a_newer_format_are_refused_and_those_without_a_number_are_read(tmp_path: Path) -> None:
    row = {"name": "policy", "episodes": 4, "success": 0.5, "success_95": [0.1, 0.9], "reward": 1.0}
    values = {"results": [row], "failures": []}
    (tmp_path / "episodes.csv").write_text("")
    (tmp_path / "results.json").write_text(json.dumps(values))
    shown = SavedEvaluation(tmp_path).evaluate()
    assert shown is not None and "policy of 4 episodes" in shown.text
    (tmp_path / "results.json").write_text(json.dumps({"format": 2, **values}))
    with pytest.raises(UsageError, match=r"results\.json has format 2; this gelflow reads format 1: update gelflow$"):
        SavedEvaluation(tmp_path).evaluate()


@needs_browser
def test_page_shows_the_evaluation(folder: Path) -> None:
    check_page(SavedEvaluation(folder), texts=("some report", "oracle of 8 episodes"), film="success")


def test_a_report_without_failures_has_no_film_of_an_earlier_one(tmp_path: Path) -> None:
    for name in ("success.gif", "failure.gif", "failure.png", "of a user.gif"):
        (tmp_path / name).touch()
    (tmp_path / "results.json").write_text('{"results": []}')
    arguments = ["--randomization", "nominal", "--preset", "fast", "--episodes", "2", "--envs", "2"]
    assert main(["eval", "insertion", *arguments, "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.glob("*.gif")} == {"success.gif", "of a user.gif"}
    assert (tmp_path / "success.gif").stat().st_size > 0
