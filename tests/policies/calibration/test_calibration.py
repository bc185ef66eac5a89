"""Calibration: exact derivatives, the training environment as a world with known truth, transfer matrix, reports."""

import contextlib
import dataclasses
import json
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.policies.calibration.recorded_world import LITTLE, WORLD

from gelflow.errors import SimulationError
from gelflow.observation import Grid
from gelflow.perception.frames import CameraMount
from gelflow.policies.calibration.calibrated_scene import write_scene
from gelflow.policies.calibration.calibration import Calibration
from gelflow.policies.calibration.experiment.transfer import World, measure_world, worlds
from gelflow.policies.calibration.experiment.worlds import RecordedWorld, record_world
from gelflow.policies.calibration.fit import FitSettings, fit
from gelflow.policies.calibration.model.fidelity import COARSE, ROUGH, Fidelity
from gelflow.policies.calibration.model.shear_model import POSE, QUANTITIES, Descents, ShearModel
from gelflow.policies.calibration.pose_search import find_poses
from gelflow.policies.calibration.problem import Problem
from gelflow.policies.calibration.report import error_lines, page, plain_report
from gelflow.policies.checkpoint import default_checkpoint, load_checkpoint
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.gripper.pads import NOMINAL_PAD_VALUES
from gelflow.sim.tasks.insertion import InsertionAttempts
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.task import INSERTION, PUBLISHED_INSERTION

VALUES = {
    **{name: value for name, value in NOMINAL_PAD_VALUES.items() if name in QUANTITIES},
    **{"hole_kn": 5e3, "hole_mu": 1.5, "arm_stiffness": 1e5, "grasp_force": 12.0, "grasp_height": 0.0},
}


def test_the_model_gives_the_forces_of_the_training_environment() -> None:
    environment = InsertionAttempts(2, randomization=NOMINAL.replace(noise=0.0), threads=1)
    pose = np.array([[3e-3, -1e-3, 0.05], [1e-3, 4e-3, -0.1]])
    environment.draw(np.random.default_rng(0), misalignment=pose)
    result = environment.attempt(np.random.default_rng(0))
    shear, ok = ShearModel(INSERTION, threads=1).shear(
        {name: np.full(2, value) for name, value in VALUES.items()}, Descents(pose, np.zeros(2), result.depth)
    )
    expected = (result.image * result.divisor[:, None, None, None]).reshape(2, 2, 2, -1)
    assert ok.all()
    assert np.abs(shear.reshape(2, 2, -1, 2).transpose(0, 1, 3, 2) - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("depth", [0.9e-3, 4.1e-3])
@pytest.mark.parametrize(("fidelity", "error"), [(COARSE, 0.02), (ROUGH, 0.05)])
def test_a_coarse_or_rough_descent_has_almost_the_forces_of_the_exact_one(
    depth: float, fidelity: Fidelity, error: float
) -> None:
    # A soft arm lets the gripper go on to its full depth.
    values = {name: np.full(2, value) for name, value in (VALUES | {"arm_stiffness": 2e3}).items()}
    descents = Descents(np.array([[3e-3, -1e-3, 0.05], [1e-3, 4e-3, -0.1]]), np.zeros(2), np.full(2, depth))
    exact, _ = ShearModel(INSERTION, threads=1).shear(values, descents)
    other, ok = ShearModel(INSERTION, threads=1, fidelity=fidelity).shear(values, descents)
    assert ok.all() and np.abs(other - exact).max() < error * np.abs(exact).max()


def test_a_descent_with_long_step_has_short_ones_at_the_rim_and_at_its_end() -> None:
    exact = ShearModel(INSERTION, threads=1)._depths(np.array([4.1e-3, 0.6e-3]))
    long = ShearModel(INSERTION, threads=1, fidelity=COARSE)._depths(np.array([4.1e-3, 0.6e-3]))
    assert len(long) < 0.7 * len(exact)
    step = exact[0, 0]
    np.testing.assert_allclose(np.diff(exact[:, 0]), step)
    steps = np.diff(long[:, 0], prepend=0.0)
    np.testing.assert_allclose(steps[long[:, 0] < 1e-3], step)
    np.testing.assert_allclose(steps[-8:], step)
    assert steps.max() == pytest.approx(COARSE.long_step * step)
    assert np.isin(long.round(9), exact.round(9)).all() and long[-1, 0] == pytest.approx(4.1e-3)
    # A short descent, which waits for the longer one, has all of its steps.
    shallow = exact[exact[:, 1] > 0, 1]
    np.testing.assert_array_equal(long[long[:, 1] > 0, 1], shallow)


def test_a_rough_descent_fails_where_a_step_needs_many_iterations() -> None:
    values = {name: np.full(2, value) for name, value in VALUES.items()}
    descents = Descents(np.array([[3e-3, -1e-3, 0.05], [1e-3, 4e-3, -0.1]]), np.zeros(2), np.full(2, 0.9e-3))
    rough, _ = ShearModel(INSERTION, threads=1, fidelity=ROUGH).shear(values, descents)
    model = ShearModel(INSERTION, threads=1, fidelity=dataclasses.replace(ROUGH, iteration_limit=1))
    assert not model.shear(values, descents)[1].any()
    assert model.lift_iteration_limit() and not model.lift_iteration_limit()
    np.testing.assert_array_equal(model.shear(values, descents)[0], rough)


def test_derivatives_of_the_forces_agree_with_finite_differences() -> None:
    model = ShearModel(INSERTION, threads=1)
    values = {**VALUES, "grasp_height": -1e-3, "arm_stiffness": 1e4}
    descents = Descents(np.array([[1e-3, 4e-3, -0.1]]), np.array([-3e-5]), np.array([0.9e-3]))
    names = [*QUANTITIES, *POSE]
    shear, slopes = model.derivatives(values, descents, names)
    largest = np.abs(shear).max()
    for k, name in enumerate(names):
        step = 1e-5 * abs(values.get(name, 1e-3)) if name in values else 1e-8
        sides = []
        for sign in (1, -1):
            moved, pose, z = dict(values), descents.pose.copy(), descents.z.copy()
            if name == "z":
                z += sign * step
            elif name in POSE:
                pose[:, POSE.index(name)] += sign * step
            else:
                moved[name] += sign * step
            rows = {key: np.array([value]) for key, value in moved.items()}
            sides.append(model.shear(rows, Descents(pose, z, descents.depth))[0])
        difference = (sides[0] - sides[1]) / (2 * step)
        floor = 1e-9 * largest / step  # of rounding errors in the difference
        assert np.abs(difference - slopes[:, k]).max() < 1e-5 * np.abs(slopes[:, k]).max() + floor, name


@pytest.mark.parametrize("printed", [None, CameraMount().grid])
def test_the_jacobian_of_the_whole_fit_agrees_with_finite_differences(
    world: RecordedWorld, printed: Grid | None
) -> None:
    recordings = dataclasses.replace(world.recordings.of(np.array([0])), printed=printed)
    problem = Problem(recordings, threads=1)
    point = np.random.default_rng(1).normal(size=problem.size) * 0.3
    poses = world.misalignment[:1]
    line = problem.linearize(point, poses)
    values, _ = problem.residuals(point, poses)
    assert np.abs(values - line.residuals).max() < 1e-6 * np.abs(values).max()
    for i in range(problem.size):
        exact = line.jacobian[:, :, i]

        def error(step: float, i: int = i, exact: np.ndarray = exact) -> float:
            shift = step * np.eye(problem.size)[i]
            up, down = (problem.residuals(point + sign * shift, poses)[0] for sign in (1, -1))
            return float(np.abs((up - down) / (2 * step) - exact).max())

        # With a small step where the forces jump nearby.
        assert any(error(step) < 1e-5 * np.abs(exact).max() + 1e-6 for step in (1e-4, 1e-5, 1e-6)), i


def test_the_noise_is_estimated_from_the_flow_maps(world: RecordedWorld) -> None:
    published = record_world(WORLD, task=PUBLISHED_INSERTION)
    assert published.noise < published.recordings.noise() < 2 * published.noise
    # Where a contact of a deep descent is not smooth, the estimate is larger, and the intervals are wider.
    ratios = np.array([w.recordings.noise() / w.noise for w in (world, *map(record_world, range(20, 32)))])
    assert 1.0 < np.median(ratios) < 1.3 and ratios.min() > 0.9 and ratios.max() < 2


def test_poses_of_a_known_world_reproduce_its_flow_maps(world: RecordedWorld) -> None:
    problem = Problem(world.recordings.of(np.array([0])), threads=1)
    truth = np.array([float(p.whitened(np.array(world.truth[p.name]))) for p in problem.fitted])
    found = find_poses(problem, truth, np.random.default_rng(0))
    recorded = problem.recorded_flow()
    assert np.sqrt(((problem.flow(*found) - recorded) ** 2).mean()) < 0.3 * np.sqrt((recorded**2).mean())


def test_a_calibration_reduces_the_error(calibrated: Calibration) -> None:
    maps = calibrated.fitted
    assert maps.error(maps.after) < 0.7 * maps.error(maps.before)
    assert calibrated.held_out is not None
    assert all(e.low <= e.value <= e.high for e in calibrated.estimates)
    assert {e.verdict for e in calibrated.estimates} <= {"known", "partly", "unknown"}
    assert calibrated.suggestions


def test_the_ratio_of_the_gains_is_known_better_than_each_gain(calibrated: Calibration) -> None:
    found = {e.parameter.name: e for e in calibrated.estimates}
    ratio, left, right = (found[name] for name in ("gain_ratio", "gain_left", "gain_right"))
    assert ratio.value == pytest.approx(right.value / left.value)
    assert ratio.low <= ratio.value <= ratio.high
    assert ratio.high / ratio.low < min(left.high / left.low, right.high / right.low)


def test_calibrated_scene_has_the_known_values_and_no_others(calibrated: Calibration, tmp_path: Path) -> None:
    known = ("pad_ks", "marker_mu", "hole_kn", "arm_stiffness")
    estimates = tuple(
        dataclasses.replace(e, relative_width=0.1 if e.parameter.name in known else 1.0, confirmed=True)
        for e in calibrated.estimates
    )
    value = {e.parameter.name: e.value for e in estimates}
    assert [path.name for path in write_scene(dataclasses.replace(calibrated, estimates=estimates), tmp_path)] == [
        "scene.toml",
        "insertion.xml",
    ]
    shipped = Simulator(load_scene("insertion"), threads=1)
    sim = Simulator(load_scene(tmp_path / "scene.toml"), threads=1)
    assert list(sim.param_index) == list(shipped.param_index)
    changed = {}
    for name, index in sim.param_index.items():
        if sim.params[0, index] != shipped.params[0, index]:
            changed[name] = float(sim.params[0, index])
    expected = {"left.mu": value["marker_mu"], "right.mu": value["marker_mu"]}
    for side in ("left", "right"):
        expected |= {f"pad_{side}.ks": value["pad_ks"], f"pad_{side}.kt": 10e-3 * value["pad_ks"]}
    for wall in ("left", "right", "front", "back"):
        expected |= {f"part_hole/wall_{wall}.kn": value["hole_kn"], f"part_hole/wall_{wall}.ks": value["hole_kn"] / 2}
    for joint, scale in (("arm_x", 1), ("arm_y", 1), ("arm_z", 1), ("arm_yaw", 0.05)):
        stiffness = scale * value["arm_stiffness"]
        expected |= {f"{joint}.kp": stiffness, f"{joint}.kd": stiffness / 200}
    assert changed == pytest.approx(expected)


def test_calibration_without_known_parameters_writes_no_scene(calibrated: Calibration, tmp_path: Path) -> None:
    estimates = tuple(dataclasses.replace(e, confirmed=False) for e in calibrated.estimates)
    assert write_scene(dataclasses.replace(calibrated, estimates=estimates), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_worlds_of_the_transfer_matrix_differ() -> None:
    rows = worlds()
    assert len({row.name for row in rows}) == len(rows) >= 30
    contents = [(dict(row.values), dict(row.part), row.friction) for row in rows]
    assert all(contents.count(row) == 1 for row in contents)


def test_a_row_of_the_transfer_matrix(tmp_path: Path) -> None:
    row = measure_world(World("low friction", {"hole_mu": 0.2}), tmp_path, episodes=8)
    assert row["before"]["success"] == 1 and "after" not in row and not list(tmp_path.iterdir())
    json.dumps(row, allow_nan=False)


@pytest.mark.slow
def test_a_row_that_is_calibrated_and_fine_tuned(tmp_path: Path) -> None:
    world = World("unequal pads", {"gain_ratio": 2.0})
    row = measure_world(world, tmp_path, episodes=32, below=1.1, settings=LITTLE, attempts=512)
    assert row["after"]["episodes"] == 32 and set(row["verdicts"].values()) <= {"known", "partly", "unknown"}
    stored = json.loads((tmp_path / "run.json").read_text())["configuration"]
    assert stored["start"] == load_checkpoint(default_checkpoint()).digest
    assert stored["options"]["ranges"] == row["ranges"] != {}
    drawn = {name: [min(values), max(values)] for name, values in stored["options"]["samples"].items()}
    assert drawn == row["drawn_between"] and {"gain_ratio", "turn_left"} <= set(drawn)


@pytest.mark.slow
def test_a_fit_is_reproducible(world: RecordedWorld) -> None:
    settings = FitSettings(starts=1, members=8, nearby=8, poses=4, steps=1)
    first, second = (fit(world.recordings.of(np.array([0])), seed=1, settings=settings) for _ in range(2))
    np.testing.assert_array_equal(first.best.point, second.best.point)


def test_a_killed_process_of_the_fit_is_an_error_in_one_line(
    world: RecordedWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    def submit(*arguments: Any) -> "Future[None]":
        future: Future[None] = Future()
        future.set_exception(BrokenProcessPool("terminated abruptly"))
        return future

    pool = SimpleNamespace(submit=submit)
    monkeypatch.setattr("gelflow.policies.calibration.fit.worker_pool", lambda count: contextlib.nullcontext(pool))
    with pytest.raises(SimulationError, match=r"a process of the fit was killed, .* close other programs"):
        fit(world.recordings.of(np.array([0])), processes=2)


def test_the_report_is_one_self_contained_page(calibrated: Calibration) -> None:
    text = page(calibrated, [Path("a<b>.mcap")], INSERTION.grid)
    assert "data:image/png;base64," in text
    assert "a&lt;b&gt;.mcap" in text
    assert 'src="http' not in text
    report = json.loads(json.dumps(plain_report(calibrated, [Path("a.mcap")]), allow_nan=False))
    assert set(report["parameters"]) == {e.parameter.name for e in calibrated.estimates}
    assert all(name in text for name in report["parameters"])


def test_a_fit_that_does_not_reproduce_the_recordings_knows_nothing(calibrated: Calibration) -> None:
    poor = dataclasses.replace(calibrated.fit.best, chi=2.0)
    estimates = tuple(dataclasses.replace(e, confirmed=False, relative_width=0.01) for e in calibrated.estimates)
    result = dataclasses.replace(
        calibrated, estimates=estimates, fit=dataclasses.replace(calibrated.fit, starts=(poor,))
    )
    assert {e.verdict for e in result.estimates} == {"unknown"}
    assert any("does not reproduce" in line for line in error_lines(result))


@pytest.mark.parametrize(("offset", "text"), [(0.4e-3, "0.4 mm higher than"), (-0.3e-3, "0.3 mm lower than")])
def test_a_common_offset_of_all_start_heights_is_reported(calibrated: Calibration, offset: float, text: str) -> None:
    """The prior of single attempts does not expect it; a hole taught too high causes it."""

    def lines(height: float) -> str:
        point = calibrated.fit.best.point.copy()
        point[calibrated.fit.count :] = height / calibrated.recordings.height_spread
        start = dataclasses.replace(calibrated.fit.best, point=point)
        fit = dataclasses.replace(calibrated.fit, starts=(start,))
        return "\n".join(error_lines(dataclasses.replace(calibrated, fit=fit)))

    assert text in lines(offset) and "the lab file" not in lines(0.1 * offset)
