"""The grasp task: bars at rest, tilt against offset, tries of an oracle, and the options of the task."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.tasks.grasp import DEFAULT_RANDOMIZATION, FULL_RANDOMIZATION, Grasp, GraspTask
from gelflow.sim.tasks.gripper.bar import Bar
from gelflow.sim.tasks.registry import make_task, task_names

QUIET = DEFAULT_RANDOMIZATION.replace(noise=0.0)


def attempted(offset: Any, mass: Any, **options: Any) -> Grasp:
    """Bars gripped in the middle with their centre of mass at −offset."""
    batch = Grasp(len(offset), threads=1, **{"randomization": QUIET, **options})
    start = {"center_of_mass": -np.asarray(offset, dtype=float), "mass": mass, "start": 0.0}
    batch.reset(batch.all, np.random.default_rng(0), options=start)
    return batch


@pytest.mark.parametrize("blocks", [7, 11, 13])
def test_block_masses_give_mass_and_centre_of_mass(blocks: int) -> None:
    bar = Bar(blocks)
    center = np.linspace(-1, 1, 9) * bar.max_center_of_mass
    masses = bar.block_masses(np.full(9, 0.08), center)
    assert (masses > 0).all()
    np.testing.assert_allclose(masses.sum(1), 0.08)
    got, across, along = bar.inertia(masses)
    np.testing.assert_allclose(got, center, atol=1e-9)
    np.testing.assert_allclose(masses[4], 0.08 / blocks)  # in the middle: equal blocks
    length = blocks * 25e-3
    assert across[4] == pytest.approx(0.08 * (length**2 + 0.025**2) / 12)
    assert along[4] == pytest.approx(0.08 * 0.025**2 / 6)


@pytest.mark.parametrize("blocks", [7, 11, 13])
def test_bars_start_at_rest_on_their_tables(blocks: int) -> None:
    batch = Grasp(5, blocks=blocks, threads=1)
    center = np.linspace(-1, 1, 5) * batch.bar.max_center_of_mass
    batch.reset(batch.all, np.random.default_rng(0), options={"center_of_mass": center, "mass": 0.1})
    batch.sim.params[:] = batch._params
    start, _ = batch._start(np.arange(5))
    batch.sim.reset()
    batch.sim.q[:] = start
    u = np.zeros(batch.scene.nu)
    u[batch.scene.u("arm_z")] = 0.06
    bar = batch.scene.q("bar")
    batch.sim.step(u, 100)
    # The rest is computed for small rotations: points at the lower edge move by half a height times the rotation.
    np.testing.assert_allclose(batch.sim.q[:, bar][:, :3], start[:, bar][:, :3], atol=5e-5)
    np.testing.assert_allclose(batch.sim.q[:, bar][:, 3:], start[:, bar][:, 3:], atol=2e-4)


@pytest.mark.parametrize(("friction", "preset"), [("elastic", None), ("elastic", "fast"), ("viscous", "fast")])
def test_tilt_grows_with_the_offset_and_the_mass(friction: str, preset: str | None) -> None:
    """No stray tilt: a bar that does not start at rest may pass through its table in steps of 10 ms."""
    offset = np.linspace(-0.105, 0.105, 43)
    tilts = []
    for mass in (0.051, 0.08, 0.12):
        batch = attempted(offset, mass, friction=friction, preset=preset)
        tilt = batch.info["tilt"]
        assert not batch.info["failed"].any() and (batch.info["lift"] > 0.015).all()
        np.testing.assert_allclose(tilt, tilt[::-1], atol=1e-3)
        assert (np.diff(tilt[21:]) > -5e-4).all() and tilt.max() < 0.12
        near = batch.info["success"][np.abs(offset) < 6e-3]
        assert near.all()
        tilts.append(tilt)
    assert (tilts[0][26:] < tilts[1][26:]).all() and (tilts[1][26:] < tilts[2][26:]).all()


def test_rewards_and_truth() -> None:
    batch = attempted([0.0, 0.08], [0.1, 0.07])
    assert batch.info["success"].tolist() == [True, False]
    np.testing.assert_allclose(batch.info["privileged"], [[0, 0.1], [0.08, 0.07]], atol=1e-9)
    batch.step(np.zeros((2, 1)), np.random.default_rng(0))
    assert batch.reward[0] == 100
    assert batch.reward[1] == pytest.approx(-10 * batch.info["tilt"][1]) and batch.reward[1] < -0.2
    assert batch.terminated.tolist() == [True, False]


@pytest.mark.parametrize("blocks", [7, 11, 13])
def test_oracle_succeeds_within_the_steps_to_the_centre_of_mass(blocks: int) -> None:
    batch, rng = Grasp(48, blocks=blocks, threads=1, preset="fast"), np.random.default_rng(1)
    batch.reset(batch.all, rng, keep_ended=True)
    needed = 1 + np.ceil(np.abs(batch.info["privileged"][:, 0]) / 50e-3 - 1e-9)
    while not batch.terminated.all():
        batch.step(batch.oracle(), rng, active=~batch.terminated)
        assert not batch.truncated.any()
    assert (batch.info["attempts"] <= needed).all()
    assert batch.info["success"].all()


def test_flow_map_has_the_sign_of_the_offset() -> None:
    maps = attempted([0.06, -0.06], 0.08).observation
    # Mirrored bars: columns are reversed and the shear along them changes its sign.
    np.testing.assert_allclose(maps[0, [0, 2]], maps[1, [0, 2]][..., ::-1], atol=0.05)
    np.testing.assert_allclose(maps[0, [1, 3]], -maps[1, [1, 3]][..., ::-1], atol=0.05)
    assert np.abs(maps[0] - maps[1]).max() > 0.5
    np.testing.assert_allclose(np.sqrt((maps.reshape(2, 2, 2, 13, 10) ** 2).sum(2)).max((1, 2, 3)), 1, rtol=1e-5)


def test_results_depend_neither_on_the_batch_nor_on_threads() -> None:
    quiet = FULL_RANDOMIZATION.replace(noise=0.0, pad_drift=0.0)
    many = Grasp(70, threads=2, preset="fast", randomization=quiet)  # more than one rollout
    many.reset(many.all, np.random.default_rng(3), keep_ended=True)
    again = Grasp(70, threads=1, preset="fast", randomization=quiet)
    again.reset(again.all, np.random.default_rng(3), keep_ended=True)
    np.testing.assert_array_equal(many.observation, again.observation)
    before, tilt = again.observation.copy(), again.info["tilt"].copy()
    active = np.arange(70) % 9 == 4
    again.step(np.zeros((70, 1)), np.random.default_rng(0), active=active)
    np.testing.assert_array_equal(again.observation, before)  # the same attempt in another place of the rollout
    np.testing.assert_array_equal(again.info["tilt"], tilt)


def test_load_rolls_to_the_lower_end_and_stays() -> None:
    smooth = QUIET.replace(load_friction=0.0, load_share=0.4, load_travel=0.03)
    batch = attempted([0.05, -0.05, 0.0], 0.1, moving_load=True, randomization=smooth)
    moved = batch._load_at - batch._shell_center
    assert moved[0] < -2e-3 and moved[1] == pytest.approx(-moved[0], rel=1e-2) and abs(moved[2]) < 1e-4
    np.testing.assert_allclose(batch.info["privileged"][:2, 0], [0.05 - 0.4 * moved[0], -0.05 - 0.4 * moved[1]])
    rng = np.random.default_rng(0)
    batch.step(batch.oracle(), rng)
    again = batch._load_at - batch._shell_center
    np.testing.assert_allclose(again[:2], moved[:2], atol=3e-3)
    assert np.abs(again).max() <= 0.031


@pytest.mark.parametrize("force", [10.0, 80.0])
def test_pads_press_with_the_grasp_force(force: float) -> None:
    batch = attempted([0.0], 0.1, randomization=QUIET.replace(grasp_force=force))
    sim, names = batch.sim, list(batch.sim.model.contact_names)
    sim.params[0] = batch._params[0]
    for name, values in batch._lifted.items():
        getattr(sim, name)[0] = values[0]
    pressed = [abs(sim.wrenches()[0, names.index(f"pad_{side}"), 3]) for side in ("left", "right")]
    assert pressed == pytest.approx([force, force], rel=1e-2)


def test_policy_may_choose_the_force() -> None:
    task = GraspTask(force_range=(4.0, 16.0))
    batch = Grasp(3, task=task, threads=1)
    assert batch.action_space.shape == (2,)
    rng = np.random.default_rng(0)
    batch.reset(batch.all, rng, options={"center_of_mass": 0.0, "mass": 0.1})
    np.testing.assert_allclose(batch.info["force"], 10)
    batch.step(np.array([[0, -1], [0, 0], [0, 1]]), rng)
    np.testing.assert_allclose(batch.info["force"], [4, 10, 16])
    np.testing.assert_allclose(batch.reward, 100 - batch.info["force"])
    np.testing.assert_allclose(batch.metrics["force [N]"], [4, 10, 16])
    assert not Grasp(1, threads=1).metrics
    with pytest.raises(UsageError, match="force_range must be 0 < low < high"):
        GraspTask(force_range=(4.0, 81.0))


def test_a_start_beyond_the_workspace_is_refused() -> None:
    batch = Grasp(1, threads=1)
    with pytest.raises(UsageError, match=r"reset: start must be within the workspace of ±0\.11 m"):
        batch.reset(batch.all, np.random.default_rng(0), options={"start": 0.12})


def test_gripper_stays_on_the_bar_and_in_its_workspace() -> None:
    for blocks, limit in ((7, 0.075), (11, 0.11)):
        batch, rng = Grasp(1, blocks=blocks, threads=1, preset="fast"), np.random.default_rng(0)
        batch.reset(batch.all, rng, options={"center_of_mass": -0.05})
        for _ in range(4):
            batch.step(np.ones((1, 1)), rng)
        assert batch.info["position"][0] == pytest.approx(limit)


def test_bad_input_is_named() -> None:
    with pytest.raises(UsageError, match="blocks must be between 5 and 21, got 3"):
        Grasp(1, blocks=3)
    batch = Grasp(1)
    with pytest.raises(UsageError, match=r"center_of_mass must be within ±0\.1075 m"):
        batch.reset(batch.all, np.random.default_rng(0), options={"center_of_mass": 0.2})
    with pytest.raises(UsageError, match="grasp: reset has no option 'com'"):
        batch.reset(batch.all, np.random.default_rng(0), options={"com": 0.2})
    with pytest.raises(UsageError, match="no task 'grap'; did you mean 'grasp'"):
        make_task("grap", 1)
    with pytest.raises(UsageError, match="grasp has no randomization 'ful'; did you mean 'full'"):
        make_task("grasp", 1, randomization="ful")
    assert "grasp" in task_names()


def test_description_of_an_environment_can_be_given_to_gymnasium() -> None:
    env = gymnasium.make("gelflow/Grasp-v0", task=GraspTask(attempts=3), preset="fast")
    env.reset(seed=0, options={"center_of_mass": 0.1})
    assert [env.step(np.zeros(1, np.float32))[3] for _ in range(2)] == [False, True]
