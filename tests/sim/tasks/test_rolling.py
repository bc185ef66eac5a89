"""The rolling task: a ball that is rolled to its goal, and one that leaves the pad."""

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.tasks.rolling import FULL_RANDOMIZATION, Rolling, RollingTask


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_proportional_control_rolls_every_ball_to_its_goal(friction: str) -> None:
    batch, rng = Rolling(16, friction=friction, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    assert not batch.info["success"].any()
    distance = batch.info["error"]
    assert distance.min() > 5e-3 - 1e-9 and distance.max() < 15e-3 + 1e-9
    active, success = batch.all, np.zeros(16, dtype=bool)
    while active.any():
        error, speed = batch.info["privileged"][:, :2], batch.info["privileged"][:, 2:4]
        batch.step(0.5 * error - 0.3 * speed, rng, active=active)
        success |= batch.info["success"]
        active &= ~(batch.terminated | batch.truncated)
    assert success.all() and batch.terminated.all() and (batch.reward > 9).all()
    assert (batch.info["error"] < 1e-3).all()


def test_ball_that_leaves_the_pad_ends_the_episode() -> None:
    batch, rng = Rolling(1, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng, options={"goal": (-0.01, 0.0)})
    while not (batch.terminated | batch.truncated).any():
        batch.step(np.array([[1.0, 0.0]]), rng)
    assert batch.terminated[0] and not batch.info["success"][0] and batch.reward[0] < -5


def test_ball_is_visible_in_the_marker_forces() -> None:
    """The centre of pressure is at the ball."""
    batch, rng = Rolling(1, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng, options={"goal": (0.015, 0.0)})
    for _ in range(8):
        batch.step(np.array([[0.8, 0.4]]), rng)
    normal = batch.observation[0, 4 + 200 :]
    grid = batch.description.grid
    center = (normal[:, None] * grid.positions()).sum(0) / normal.sum()
    offset = 10 * batch.info["privileged"][0, 4:]  # ball from the pad [mm]
    np.testing.assert_allclose(center, [offset[0], -offset[1]], atol=1.0)  # the lower face looks down: y is mirrored


def test_episodes_repeat_and_bad_options_are_named() -> None:
    runs = []
    for threads in (1, 2):
        batch, rng = Rolling(3, threads=threads, randomization=FULL_RANDOMIZATION), np.random.default_rng(3)
        batch.reset(batch.all, rng)
        for _ in range(3):
            batch.step(rng.uniform(-1, 1, (3, 2)), rng)
        runs.append(batch.observation.copy())
    np.testing.assert_array_equal(runs[0], runs[1])
    with pytest.raises(UsageError, match="rolling: reset has no option 'x'"):
        batch.reset(batch.all, rng, options={"x": 1})


def test_fast_preset_is_adapted_to_the_control_period() -> None:
    with pytest.warns(UserWarning, match="does not divide the control period"):
        batch = Rolling(1, task=RollingTask(), preset="fast", threads=1)
    batch.reset(batch.all, np.random.default_rng(0))
    assert batch.scene.step == pytest.approx(0.025 / 3)


def test_picture_of_the_ball_and_its_goal() -> None:
    batch = Rolling(1, threads=1)
    batch.reset(batch.all, np.random.default_rng(0))
    assert len(np.unique(batch.render(0).reshape(-1, 3), axis=0)) > 50


def test_center_of_the_grid_is_that_of_the_description() -> None:
    task = RollingTask(grid=Grid(rows=3, cols=3, pitch=4.0, center=(3.0, 1.0)))
    (pad,) = Rolling(1, task=task, threads=1).sim.scene.pads
    center = ((pad.positions - pad.pose.position) @ pad.pose.matrix()).mean(0)
    np.testing.assert_allclose(center, [3e-3, 1e-3, 0], atol=1e-12)
