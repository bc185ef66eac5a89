"""The global search: its update against the Kalman filter's, and the unknowns that it finds in a recorded world."""

import dataclasses

import numpy as np
import pytest

from gelflow.errors import SimulationError
from gelflow.policies.calibration import ensemble
from gelflow.policies.calibration.experiment.worlds import RecordedWorld
from gelflow.policies.calibration.model.fidelity import ROUGH
from gelflow.policies.calibration.pose_search import better_poses
from gelflow.policies.calibration.poses import costs_of_insertions, draw_poses
from gelflow.policies.calibration.problem import Array, Problem


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_an_update_is_that_of_a_kalman_filter(share: float) -> None:
    rng = np.random.default_rng(0)
    slopes, data = rng.normal(size=(5, 3)), rng.normal(size=5)
    members = rng.normal(size=(1500, 3))
    updated = ensemble._updated(members, members @ slopes.T - data, share, rng)
    covariance = np.linalg.inv(np.eye(3) + share * slopes.T @ slopes)
    np.testing.assert_allclose(updated.mean(0), share * covariance @ slopes.T @ data, atol=0.06)
    np.testing.assert_allclose(np.cov(updated.T), covariance, atol=0.06)


def test_two_updates_with_half_of_the_recordings_equal_one_with_all() -> None:
    rng = np.random.default_rng(1)
    slopes, data = rng.normal(size=(4, 2)), rng.normal(size=4)
    members = rng.normal(size=(1500, 2))
    once = ensemble._updated(members, members @ slopes.T - data, 1.0, rng)
    twice = members
    for _ in range(2):
        twice = ensemble._updated(twice, twice @ slopes.T - data, 0.5, rng)
    np.testing.assert_allclose(twice.mean(0), once.mean(0), atol=0.06)
    np.testing.assert_allclose(np.cov(twice.T), np.cov(once.T), atol=0.06)


def test_the_search_finds_unknowns_that_no_random_guess_comes_near(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.arange(2)), fidelity=ROUGH)
    problem.allow_for(model_error=0.04)
    point, poses = ensemble.search_globally(problem, 96, np.random.default_rng(0))
    found = ensemble._simulated(problem, point[None], poses[None])
    rng = np.random.default_rng(1)
    points = np.clip(rng.normal(size=(200, problem.size)), -1.7, 1.7)
    guessed = np.stack([draw_poses(problem, i, 200, rng) for i in range(2)], axis=1)
    guesses = ensemble._simulated(problem, points, guessed)
    assert found.ok.all()
    assert ensemble._costs(problem, found)[0] < 0.1 * ensemble._costs(problem, guesses).min()


def test_wrong_poses_are_replaced_and_right_ones_kept(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.arange(2)), threads=1)
    point = np.zeros(problem.size)
    point[: len(problem.fitted)] = [float(p.whitened(np.array(world.truth[p.name]))) for p in problem.fitted]
    point[len(problem.fitted) :] = world.heights[: len(problem.recordings)] / problem.recordings.height_spread
    poses = world.misalignment[:2] + np.array([[0.0, 0.0, 0.0], [3e-3, -3e-3, np.radians(6.0)]])
    before = costs_of_insertions(problem, point, poses)
    found = better_poses(problem, point, poses, np.random.default_rng(0), members=48, count=16)
    after = costs_of_insertions(problem, *found)
    assert after[0] <= before[0] and after[1] < 0.1 * before[1]
    moved = np.abs(found[1] - world.misalignment[:2])
    assert (moved < [0.5e-3, 0.5e-3, np.radians(1.5)]).all()


def test_guesses_that_cannot_be_simulated_end_the_search(world: RecordedWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Problem(world.recordings.of(np.arange(1)), fidelity=ROUGH)
    predicted = problem.predicted
    monkeypatch.setattr(problem, "predicted", lambda *given: (predicted(*given)[0], np.zeros(len(given[1]), np.bool_)))
    with pytest.raises(SimulationError, match="most guesses"):
        ensemble.search_globally(problem, 8, np.random.default_rng(0))


def _near_truth(world: RecordedWorld) -> tuple[Problem, ensemble._Ensemble]:
    """One recorded insertion, and eight guesses with its pose."""
    problem = Problem(world.recordings.of(np.arange(1)), threads=1, fidelity=ROUGH)
    points = 0.1 * np.random.default_rng(0).normal(size=(8, problem.size))
    return problem, ensemble._simulated(problem, points, np.repeat(world.misalignment[None, :1], 8, axis=0))


def test_an_update_that_goes_too_far_is_repeated_with_a_smaller_share(
    world: RecordedWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, start = _near_truth(world)
    limit = problem.readings.forces.scene.max_step_iterations
    changes, simulated = [], ensemble._simulated

    def only_small_changes(problem: Problem, points: Array, poses: Array) -> ensemble._Ensemble:
        changes.append(float(np.abs(points - start.points).mean()))
        return dataclasses.replace(simulated(problem, points, poses), ok=np.full(8, changes[-1] < 0.5 * changes[0]))

    monkeypatch.setattr(ensemble, "_simulated", only_small_changes)
    moved, share = ensemble._moved(problem, start, 1.0, np.random.default_rng(1))
    assert moved.ok.all() and len(changes) > 1
    assert share == 0.25 ** (len(changes) - 1)
    assert problem.readings.forces.scene.max_step_iterations == limit


def test_the_iteration_limit_is_lifted_where_a_smaller_share_does_not_help(world: RecordedWorld) -> None:
    problem, start = _near_truth(world)
    limited = Problem(problem.recordings, threads=1, fidelity=dataclasses.replace(ROUGH, iteration_limit=1))
    moved, share = ensemble._moved(limited, start, 1.0, np.random.default_rng(1))
    assert moved.ok.all()
    assert share == 0.25**3


def test_an_iteration_limit_that_most_guesses_exceed_is_lifted(world: RecordedWorld) -> None:
    limited, found = dataclasses.replace(ROUGH, iteration_limit=1), []
    for lifted in (True, False):
        problem = Problem(world.recordings.of(np.arange(1)), threads=1, fidelity=limited)
        if lifted:
            problem.readings.forces.lift_iteration_limit()
        poses = world.misalignment[:1]
        found.append(ensemble.search_nearby(problem, np.zeros(problem.size), poses, 0.1, 8, np.random.default_rng(0)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
