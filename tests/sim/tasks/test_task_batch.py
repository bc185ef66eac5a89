"""Batches of environments and their Gymnasium environments, on tasks without physics or with a single body."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim import load_scene, make_task
from gelflow.sim.tasks.cap_rotation import CapRotationTask
from gelflow.sim.tasks.control_task import ControlDescription, ControlTask, adapt_step
from gelflow.sim.tasks.grasp import GraspTask
from gelflow.sim.tasks.gripper.attempt_task import AttemptTask
from gelflow.sim.tasks.gymnasium_envs import TaskEnv, TaskVectorEnv
from gelflow.sim.tasks.pushing import PushingTask
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.rolling import RollingTask
from gelflow.sim.tasks.task_batch import Array, Mask, check_options, option_rows
from gelflow.task import INSERTION, PUBLISHED_INSERTION, InsertionTask, TaskDescription


@dataclass(frozen=True)
class LineTask(TaskDescription):
    """Find 0 on a line."""

    name: str = "line"
    tolerance: float = 0.2


class Line(AttemptTask):
    """The position is observed; success within the tolerance, at most 4 attempts."""

    def __init__(self, num_envs: int, tolerance: float = 0.2) -> None:
        space = Box(-1, 1, (1,), np.float32)
        task = LineTask(tolerance=tolerance)
        super().__init__(task, num_envs, observation_space=space, action_space=space, privileged=1, attempts=4)
        self.x: Array = np.zeros(num_envs)
        self.tolerance = tolerance
        self.simulated = 0

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        check_options("line", options, {"x": "start"})
        self.x[which] = rng.uniform(-1, 1, which.sum())
        if "x" in options:
            self.x[which] = option_rows("x", options["x"], which)

    def _move(self, actions: Array, active: Mask) -> None:
        self.x[active] = np.clip(self.x + 0.5 * actions[:, 0], -1, 1)[active]

    def _attempt(self, active: Mask, rng: np.random.Generator) -> None:
        self.simulated += int(active.sum())
        self.observation[active] = self.x[active, None]
        self.reward[active] = -np.abs(self.x[active])
        self.info["success"][active] = np.abs(self.x[active]) < self.tolerance
        self.info["privileged"][active] = self.x[active, None]

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        return np.zeros((2, 2, 3), np.uint8)


@dataclass(frozen=True)
class BallTask(ControlDescription):
    """A short task of control."""

    name: str = "ball"
    max_steps: int = 3

    @property
    def observation_size(self) -> int:
        return 3


class Ball(ControlTask):
    """The pad of the rolling scene, pushed along x; success beyond 10 mm."""

    def __init__(self, num_envs: int, preset: str | None = None) -> None:
        super().__init__(
            BallTask(), num_envs, Randomization(), scene="rolling", actions=3, privileged=3, preset=preset, threads=1
        )

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self.sim.reset(which)

    def _controls(self, actions: Array, rng: np.random.Generator, active: Mask) -> Array:
        return 0.2 * actions

    def _observe(self, active: Mask, rng: np.random.Generator) -> None:
        self.observation[active] = self.sim.q[active, :3]
        self.info["success"][active] = self.sim.q[active, 0] > 10e-3

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        return np.zeros((2, 2, 3), np.uint8)


def test_reset_of_some_leaves_the_others() -> None:
    batch, rng = Line(6), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    before, simulated = batch.observation.copy(), batch.simulated
    which = np.array([True, False, False, True, False, False])
    batch.reset(which, rng, keep_ended=True)
    np.testing.assert_array_equal(batch.observation[~which], before[~which])
    assert (batch.observation[which] != before[which]).all()
    assert batch.simulated == simulated + 2
    assert list(batch.info["attempts"]) == [1] * 6 and not batch.reward.any()


def test_episodes_that_end_at_once_are_drawn_again_unless_kept() -> None:
    batch, rng = Line(200), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    assert not batch.terminated.any()
    batch.reset(batch.all, rng, keep_ended=True)
    assert 20 < batch.terminated.sum() < 60
    np.testing.assert_array_equal(batch.terminated, batch.info["success"])
    batch.reset(batch.all, rng, options={"x": 0.1})
    assert batch.terminated.all()
    with pytest.raises(SimulationError, match=r"line: no valid start in 100 rounds: .* 2 succeeded and 0 failed"):
        Line(2, tolerance=2.0).reset(np.ones(2, dtype=bool), rng)


def test_results_of_the_batch_are_masks_of_a_reset() -> None:
    batch, rng = Line(200), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    for _ in range(3):
        batch.step(np.zeros((200, 1)), rng)
    assert batch.truncated.all()
    batch.reset(batch.truncated, rng)
    assert not (batch.terminated | batch.truncated).any()


def test_step_of_active_environments_only() -> None:
    batch, rng = Line(3), np.random.default_rng(0)
    batch.reset(batch.all, rng, options={"x": [0.9, 0.6, -0.9]})
    batch.step(np.full((3, 1), -2.0), rng, active=np.array([True, True, False]))
    np.testing.assert_allclose(batch.observation[:, 0], [0.4, 0.1, -0.9], atol=1e-6)
    assert list(batch.info["attempts"]) == [2, 2, 1]
    assert list(batch.terminated) == [False, True, False]
    for _ in range(2):
        batch.step(np.zeros((3, 1)), rng)
    assert list(batch.truncated) == [True, False, False]


def test_bad_input_is_named() -> None:
    batch, rng = Line(3), np.random.default_rng(0)
    with pytest.raises(UsageError, match=r"actions must have shape \(3, 1\), got \(3,\)"):
        batch.step(np.zeros(3), rng)
    with pytest.raises(UsageError, match="actions must be numeric"):
        TaskEnv(Line(1)).step("left")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="actions must be finite, got nan"):
        batch.step(np.full((3, 1), np.nan), rng)
    with pytest.raises(UsageError, match="line: reset the environments before their first step"):
        batch.step(np.zeros((3, 1)), rng)
    with pytest.raises(UsageError, match=r"must be \(3,\) bool, got \(2,\) bool"):
        batch.reset(np.ones(2, dtype=bool), rng)
    with pytest.raises(UsageError, match="line: reset has no option 'y'; there are 'x': start"):
        batch.reset(batch.all, rng, options={"y": 1})
    with pytest.raises(UsageError, match=r"x must be finite, of shape \(\) or \(3,\), got \[1.0, 2.0\]"):
        batch.reset(batch.all, rng, options={"x": [1, 2]})
    with pytest.raises(UsageError, match="num_envs must be at least 1"):
        Line(0)


def test_single_environment_follows_gymnasium() -> None:
    env = TaskEnv(Line(1), render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not having a spec.*")
        check_env(env)
    env.reset(seed=1, options={"x": 0.9})
    observation, reward, terminated, truncated, info = env.step(np.array([-1], np.float32))
    assert observation == pytest.approx(0.4) and reward == pytest.approx(-0.4)
    assert (terminated, truncated, info["attempts"]) == (False, False, 2)
    with pytest.raises(UsageError, match="render_mode must be None or one of rgb_array, got 'human'"):
        TaskEnv(Line(1), render_mode="human")


def test_vector_environment_resets_in_the_same_step() -> None:
    envs = TaskVectorEnv(Line(2))
    envs.reset(seed=0, options={"x": [0.6, -0.9]})
    observation, reward, terminated, truncated, info = envs.step(np.array([[-1], [0]], np.float32))
    assert list(terminated) == [True, False] and not truncated.any()
    assert reward == pytest.approx([-0.1, -0.9])
    assert info["final_obs"][0] == pytest.approx(0.1) and info["final_obs"][1] is None
    assert list(info["_final_obs"]) == [True, False]
    final = info["final_info"]
    assert final["attempts"][0] == 2 and final["success"][0] and list(final["_success"]) == [True, False]
    assert list(info["attempts"]) == [1, 2] and info["_attempts"].all()
    assert abs(observation[0, 0]) > 0.2 and observation in envs.observation_space


def test_control_step_divides_the_period() -> None:
    with pytest.warns(UserWarning, match="step of 10 ms does not divide the control period of 25 ms; .* 8.33333 ms"):
        assert adapt_step(load_scene("insertion", preset="fast"), 0.025).step == pytest.approx(0.025 / 3)
    assert adapt_step(load_scene("insertion"), 0.025).step == 5e-3


def test_control_task_steps_and_ends() -> None:
    batch, rng = Ball(2), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    push = np.tile([1.0, 0, 0], (2, 1))
    batch.step(push, rng)
    held = batch.sim.q[1].copy()
    batch.step(push, rng, active=np.array([True, False]))
    np.testing.assert_array_equal(batch.sim.q[1], held)
    assert batch.sim.q[0, 0] > held[0] and list(batch.info["steps"]) == [2, 1]
    batch.step(push, rng)
    assert list(batch.truncated) == [True, False]
    batch.reset(np.array([True, False]), rng)
    assert batch.sim.q[0, 0] == 0 and list(batch.info["steps"]) == [0, 2]


def test_descriptions_of_tasks() -> None:
    task = LineTask(tolerance=0.5)
    assert LineTask.from_json(task.to_json()) == task
    assert task.digest() != LineTask().digest()
    with pytest.raises(UsageError, match="task description is of 'line', expected 'insertion'"):
        InsertionTask.from_json({"name": "line"})
    assert INSERTION.digest() == "cceede46a985d44f"
    assert PUBLISHED_INSERTION.digest() == "028d8d8be55f0e5f"


@pytest.mark.parametrize("name", ["insertion", "grasp", "pushing", "cap", "rolling"])
def test_no_environment_may_be_chosen(name: str) -> None:
    task, rng, none = make_task(name, 2), np.random.default_rng(0), np.zeros(2, dtype=bool)
    task.reset(task.all, rng)
    before = task.observation.copy()
    task.reset(none, rng)
    task.step(np.zeros((2, *task.action_space.shape)), rng, active=none)
    np.testing.assert_array_equal(task.observation, before)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GraspTask(attempts=0), "sensors must be 2 and attempts at least 1, got 2 and 0"),
        (lambda: GraspTask(sensors=1), "sensors must be 2 and attempts at least 1, got 1 and 10"),
        (lambda: GraspTask(close_time=-1), "close_time, lift_time and hold_time must not be negative"),
        (lambda: GraspTask(grid=3), "grid must be a Grid, got 3"),  # type: ignore[arg-type]
        (lambda: PushingTask(control_period=0), "control_period must be positive and max_steps at least 1, got 0 and"),
        (lambda: PushingTask(max_steps=0), "control_period must be positive and max_steps at least 1"),
        (lambda: PushingTask(max_steps=1.5), "max_steps must be an integer, got 1.5"),  # type: ignore[arg-type]
        (lambda: PushingTask(control_period=np.nan), "control_period must be a finite number, got nan"),
        (lambda: PushingTask(goal_x=("a", 1)), "goal_x must be a tuple of finite numbers, got"),  # type: ignore[arg-type]
        (lambda: InsertionTask(descent=np.inf), "descent must be a finite number, got inf"),
        (lambda: InsertionTask(attempts=0), "attempts must be above 0, got 0"),
        (lambda: InsertionTask(workspace=(0.01, 0.01)), "workspace must be a tuple of 3 numbers"),  # type: ignore[arg-type]
        (lambda: InsertionTask(misalignment=(0.01, -0.01, 0.1)), "misalignment must not be negative, got"),
        (lambda: InsertionTask(frame_depths=()), "frame_depths must have at least one depth"),
        (lambda: PushingTask(goal_x=(0.2,)), "goal_x must be a tuple of 2 numbers"),  # type: ignore[arg-type]
        (lambda: PushingTask(goal_x=(0.3, 0.1)), r"goal_x must be \(low, high\), got \(0.3, 0.1\)"),
        (lambda: PushingTask(position_tolerance=0), "position_tolerance must be above 0, got 0"),
        (lambda: GraspTask(force_range=(1.0,)), r"force_range must be \(low, high\), got \(1.0,\)"),  # type: ignore[arg-type]
        (lambda: RollingTask(goal_distance=(0.02, 0.01)), r"goal_distance must be \(low, high\)"),
        (lambda: CapRotationTask(goal_angle=0), "goal_angle must be above 0, got 0"),
        (lambda: make_task("grasp", 2, blocks="7"), "blocks must be an integer, got '7'"),
    ],
)
def test_impossible_descriptions_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()
