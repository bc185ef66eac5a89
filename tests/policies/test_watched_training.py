"""A training that is watched: its curve, episodes of its newest policy, and the page that shows them."""

from pathlib import Path

import numpy as np
import pytest
from tests.policies.training_page import check_page
from tests.real.runner.harness import untrained_checkpoint
from tests.view.browser import needs_browser

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.reports.watched_training import WatchedTraining
from gelflow.view.page import below_controls

HEADER = "steps,minutes,evaluated_success,success_low,success_high,evaluated_length,evaluated_reward\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "some training"
    made.mkdir()
    (made / "run.json").write_text("{}")
    (made / "progress.csv").write_text(HEADER + "1000,0.1,0.5,0.4,0.6,3.0,-2.0\n")
    return made


def test_curve_is_drawn_again_when_the_table_has_grown(folder: Path) -> None:
    training = WatchedTraining(folder, episodes=4)
    first = training.curve()
    assert first is not None and first.ndim == 3
    assert training.curve() is None
    with (folder / "progress.csv").open("a") as table:
        table.write("2000,0.2,0.9,0.8,0.95,2.0,-1.0\n")
    second = training.curve()
    assert second is not None and not np.array_equal(first, second)


def test_a_training_without_rows_and_policies_shows_nothing(folder: Path) -> None:
    training = WatchedTraining(folder, episodes=4)
    (folder / "progress.csv").write_text("")
    assert training.curve() is None and training.evaluate() is None
    (folder / "progress.csv").unlink()
    assert training.curve() is None


def test_newest_policy_is_evaluated_once(folder: Path) -> None:
    training = WatchedTraining(folder, episodes=40)
    untrained_checkpoint(folder)
    episodes = training.evaluate()
    assert episodes is not None
    assert "of 40 episodes succeed" in episodes.text and episodes.failures is not None
    assert set(episodes.films) <= {"success", "failure"} and "failure" in episodes.films
    for film in episodes.films.values():
        assert len(film) >= 2 and film[0].shape == film[-1].shape
    assert training.evaluate() is None


@pytest.mark.parametrize("aspect", [0.5, 1.37, 3.0])
def test_films_keep_their_shape_in_every_window(aspect: float) -> None:
    film = np.zeros((48, 64, 3), dtype=np.uint8)
    shown = below_controls(film, aspect)
    assert shown.shape[1] / shown.shape[0] == pytest.approx(aspect, rel=0.03)
    assert (shown == 0).sum() == film.size and (shown[-48:] == 0).sum() == film.size


def test_other_folders_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match=r"not the folder of a training: it has no run\.json"):
        WatchedTraining(tmp_path)
    assert main(["view", str(tmp_path), "--port", "0"]) == 2
    error = capsys.readouterr().err
    assert "not the folder of a training" in error and error.count("\n") == 1


@needs_browser
def test_page_shows_curve_results_and_films(folder: Path) -> None:
    untrained_checkpoint(folder)
    check_page(WatchedTraining(folder, episodes=8), texts=("some training", "of 8 episodes succeed"), film="failure")
