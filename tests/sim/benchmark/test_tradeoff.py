"""`gelflow tradeoff`: comparable runs, meaningful errors, and settings."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gelflow.cli.commands.tradeoff import short, show
from gelflow.cli.main import main
from gelflow.cli.output import Output
from gelflow.errors import UsageError
from gelflow.sim.benchmark.tradeoff.picture import front
from gelflow.sim.benchmark.tradeoff.preset_bounds import bounds
from gelflow.sim.benchmark.tradeoff.run import FRAME, WINDOW, Errors, MotionBenchmark, compare, randomized
from gelflow.sim.benchmark.tradeoff.sweep import (
    GROUPS,
    Measurement,
    Setting,
    Tradeoff,
    contact_density,
    dominated,
    reference,
    settings,
    simulated,
)
from gelflow.sim.scene import PRESET_NAMES, load_scene, scene_names


def test_quick_measurement_prints_its_results(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "new" / "pushing.png"
    assert main(["tradeoff", "pushing", "--quick", "--repeats", "1", "--json", "--out", str(picture)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert picture.stat().st_size > 10_000
    measurements = {measurement["setting"]["name"]: measurement for measurement in found["measurements"]}
    assert set(measurements) | set(found["failed"]) >= {s.name for s in settings("pushing", quick=True)}
    assert {name for measurement in measurements.values() for name in measurement["presets"]} == set(PRESET_NAMES)
    assert all(measurement["dominated_by"] in (None, *measurements) for measurement in measurements.values())
    assert any(measurement["dominated_by"] for measurement in measurements.values())
    # Finer steps are closer to the reference, which moved much less than they are off.
    errors = [measurements[f"BDF2 {step} ms 1e-3"]["errors"] for step in ("10", "2.5", "0.625")]
    for figure in ("position", "rotation", "markers", "gradient"):
        assert errors[0][figure] > errors[1][figure] > errors[2][figure] > 3 * found["changes"]["scene"][figure]
    # The table is printed from the same numbers.
    rows = tuple(
        Measurement(**{**p, "setting": Setting(**p["setting"]), "errors": Errors(**p["errors"])})
        for p in found["measurements"]
    )
    changes = {name: Errors(**change) for name, change in found["changes"].items()}
    del found["processor"]
    show(Tradeoff(**{**found, "measurements": rows, "changes": changes}), "pushing", Output())
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out and all(name in out for name in measurements)
    assert "The reference changed by" in out


def test_scene_without_reference_motion_raises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ball.xml").write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    path = tmp_path / "ball.toml"
    path.write_text('format = 1\nmodel = "ball.xml"\nstep = 1e-3\n')
    assert main(["tradeoff", str(path)]) == 2
    assert "scene 'ball' has no reference motion" in capsys.readouterr().err


def test_step_must_divide_a_frame() -> None:
    with pytest.raises(UsageError, match=r"must divide 0\.01 s"):
        MotionBenchmark(load_scene("pushing", overrides={"step": 3e-3}))
    with pytest.raises(UsageError, match=r"must divide 0\.01 s"):
        MotionBenchmark(load_scene("pushing", overrides={"step": 30e-3}))


@pytest.mark.parametrize("name", scene_names())
def test_settings_load_and_differ(name: str) -> None:
    found = settings(name)
    assert len({s.name for s in found}) == len(found) > 40
    assert {s.group for s in found} <= set(GROUPS)
    assert {"default", "step", "tolerance", "combined", "single", "reads", "contacts"} <= {s.group for s in found}
    own = load_scene(name)
    scenes = [load_scene(name, overrides=s.overrides) for s in found]
    assert [s for s, scene in zip(found, scenes, strict=True) if scene.num_markers != own.num_markers] == [
        s for s in found if s.group == "markers"
    ]
    for scene in scenes:
        assert (FRAME / scene.step) % 1 == pytest.approx(0)


@pytest.mark.parametrize("name", scene_names())
def test_contact_densities_keep_the_total_stiffness(name: str) -> None:
    own = load_scene(name)
    total = {p.name: p.weights.sum() for p in own.points}
    for density in (1, 2):
        scene = load_scene(name, overrides=contact_density(own, density))
        for points, old in zip(scene.points, own.points, strict=True):
            if old.radius == 0 and len(old.points) > 8:
                assert points.per_area
                assert len(points.points) > len(old.points) or density == 1
        weights = {p.name: p.weights.sum() for p in scene.points}
        for contact, before in zip(scene.contacts, own.contacts, strict=True):
            for number in ("kn", "kt", "kd", "ks"):
                stiffness = contact.params[number] * weights[contact.points]
                assert stiffness == pytest.approx(before.params[number] * total[before.points])
            assert contact.params["mu"] == before.params["mu"]


def test_coarser_marker_grids_keep_their_extent() -> None:
    for name in ("pushing", "rolling"):
        own = load_scene(name).grids[0]
        for setting in settings(name):
            if setting.group == "markers":
                grid = load_scene(name, overrides=setting.overrides).grids[0]
                if name == "pushing":  # the outermost markers stay
                    assert (grid.rows - 1) * grid.pitch == pytest.approx((own.rows - 1) * own.pitch)
                    assert (grid.cols - 1) * grid.pitch == pytest.approx((own.cols - 1) * own.pitch)
                else:  # the area stays
                    assert grid.rows * grid.pitch == pytest.approx(own.rows * own.pitch)


def test_run_equals_a_loop_of_steps() -> None:
    scene = load_scene("pushing", preset="balanced")
    run, task = MotionBenchmark(scene).run(gradient=False), MotionBenchmark(scene, every=4)
    rare = task.run(gradient=False)
    sim = task.sim
    sim.reset()
    sim.q[0] = task.motion.q0
    for frame, u in enumerate(task.motion.step_controls(FRAME), 1):
        for _ in range(task.steps):
            sim.step(u)
        np.testing.assert_array_equal(run.poses[frame], sim.poses()[0])
        np.testing.assert_array_equal(run.field[frame], sim.tactile()[0])
        np.testing.assert_array_equal(rare.field[frame], run.field[frame - frame % 4])
    assert task.seconds() > 0


@pytest.mark.parametrize(("name", "every"), [("pushing", 1), ("insertion", 1), ("dclaw", 1), ("pushing", 4)])
def test_gradient_equals_finite_differences_of_the_loss(name: str, every: int) -> None:
    """Central differences of runs, in the middle of contact, so that no point makes contact within a stencil."""
    task = MotionBenchmark(load_scene(name, overrides={"tolerance": 1e-12}), every=every)
    gradient = task.run().gradient
    assert gradient is not None and gradient.shape[0] == WINDOW
    spread = task.motion.step_controls(FRAME).std(0)
    chosen = np.flatnonzero(spread > 0)

    def loss() -> float:
        field = task.run(gradient=False).field[task.evaluation_frame - WINDOW + 1 : task.evaluation_frame + 1]
        return float((field**2).sum() / (WINDOW * field.shape[1]))

    original = task.controls.copy()
    rng = np.random.default_rng(0)
    for frame in rng.choice(WINDOW, 2, replace=False):
        column = int(rng.integers(len(chosen)))
        at, delta = (task.evaluation_frame - WINDOW + frame, 0, chosen[column]), 1e-6 * spread[chosen[column]]
        values = []
        for sign in (1, -1):
            task.controls[:] = original
            task.controls[at] += sign * delta
            values.append(loss())
        slope = (values[0] - values[1]) / 2e-6
        assert gradient[frame, column] == pytest.approx(slope, rel=1e-3, abs=1e-5 * np.abs(gradient).max())


def test_errors_of_known_deviations() -> None:
    truth = simulated("insertion", {})
    assert truth.gradient is not None
    assert replace(compare(truth, truth), cosine=1) == Errors(0, 0, 0, 0, 1, 0)
    poses = truth.poses.copy()
    poses[5, 0, :3] += [3e-4, 0, 4e-4]
    half = np.array([np.cos(0.05), 0, 0, np.sin(0.05)])
    w, x, y, z = poses[7, 1, 3:].copy()
    poses[7, 1, 3:] = -(half[0] * np.array([w, x, y, z]) + half[3] * np.array([-z, -y, x, w]))
    other = replace(truth, poses=poses, field=1.1 * truth.field, gradient=2 * truth.gradient)
    errors = compare(other, truth)
    assert errors.position == pytest.approx(5e-4) and errors.rotation == pytest.approx(0.1)
    assert errors.markers == pytest.approx(0.1)
    assert errors.flow == pytest.approx(0, abs=1e-12)  # it is normalized
    assert errors.cosine == pytest.approx(1) and errors.gradient == pytest.approx(1)


def test_marker_forces_are_compared_on_the_markers_of_the_scene() -> None:
    own = load_scene("pushing")
    finer = load_scene("pushing", overrides={"pads.pad.rows": 25, "pads.pad.cols": 19, "pads.pad.pitch": 0.75e-3})
    plain, fine = MotionBenchmark(own).run(gradient=False), MotionBenchmark(finer).run(onto=own, gradient=False)
    np.testing.assert_allclose(fine.field, plain.field, rtol=1e-9, atol=1e-12)  # every second marker is the same one
    np.testing.assert_array_equal(fine.poses, plain.poses)


def test_sampled_physics_is_independent_of_the_step() -> None:
    first, again, other = (randomized(load_scene("grasp"), np.random.default_rng(seed)) for seed in (1, 1, 2))
    fine = randomized(load_scene("grasp", preset="accurate"), np.random.default_rng(1))
    own = load_scene("grasp")
    for scene in (again, fine):
        assert [c.params for c in scene.contacts] == [c.params for c in first.contacts]
        assert [b.mass for b in scene.bodies] == [b.mass for b in first.bodies]
    assert first.contacts[0].params != other.contacts[0].params
    for body, before in zip(first.bodies, own.bodies, strict=True):
        assert body.name.startswith("finger") == (body.mass == before.mass)
        np.testing.assert_allclose(body.inertia / before.mass, before.inertia * body.mass / before.mass**2)
    for contact, before_contact in zip(first.contacts, own.contacts, strict=True):
        ratio = contact.params["kn"] / before_contact.params["kn"]
        assert 1 / 1.5 <= ratio <= 1.5
        assert contact.params["ks"] == pytest.approx(ratio * before_contact.params["ks"])


def test_bar_of_the_grasp_motion_starts_at_rest() -> None:
    """Without static penetration the bar vibrates, and the time of contact does not converge with the step."""
    own = load_scene("grasp")
    for overrides in ({}, contact_density(own, 2)):
        task = MotionBenchmark(load_scene("grasp", overrides=overrides))
        bar, sim = own.q("bar"), task.sim
        sim.q[0] = task.motion.q0
        u = task.controls[0].copy()
        u[0, [own.u("finger_left"), own.u("finger_right")]] = -0.1  # open
        sim.step(u, 100)
        np.testing.assert_allclose(sim.q[0, bar], task.motion.q0[bar], rtol=0, atol=1e-9)
    errors = compare(reference("grasp", 6), reference("grasp", 7))
    assert errors.markers < 0.02 and errors.gradient < 0.02


def test_dominated_settings() -> None:
    figures = {"a": (1.0, 1.0), "b": (1.01, 2.0), "c": (0.5, 3.0), "d": (1.01, 0.99), "e": (0.4, 0.4), "f": (0.6, 3.5)}
    groups = dict.fromkeys(figures, "step") | {"e": "single"}
    found = dominated(figures, groups)
    assert found == {"a": None, "b": "a", "c": None, "d": None, "e": None, "f": "c"}
    assert front([(1, 1), (2, 0.5), (1.5, 2), (3, 0.5)]) == [(1, 1), (2, 0.5)]


def test_bounds_are_rounded_up() -> None:
    worst = {"fast": Errors(1.01e-4, 0.0, 0.2, 3e-3, 0.9, 0.41)}
    found = bounds(worst, 4)["fast"]
    assert found.bound == Errors(1.6e-4, 0.0, 0.3, 4.5e-3, 0.85, 0.62)
    assert found.draws == 4


def test_numbers_fit_into_their_columns() -> None:
    assert [short(x) for x in (0, 123.4, 9.96, 0.0332, 0.00332, 1e-7)] == ["0", "123", "10", "0.033", "3e-3", "1e-7"]
