"""Gymnasium environments of the insertion task: `gelflow/Insertion-v0`, single and vectorized.

An episode is one part. `reset` samples the part and makes a first attempt; each `step` corrects the gripper's pose by
the action and makes another attempt. A part that is inserted by the first attempt is sampled again.

Action: correction (x, y, yaw) in ±1, scaled by the task, in the gripper's frame; the pose is limited to the workspace.
Observation: normalized flow map of the attempt, float32, shape (frames * sensors * 2, rows, cols), in ±1.
Reward: `InsertionTask.reward` of the pose after the correction.
Terminated: the part is inserted. Truncated: all attempts of the task (including the first) are used, or the simulation
failed (`info["failed"]`).
Info: number of `attempts`, `inserted`, `failed`, gripper `pose` in the hole's frame, `height` of the highest corner of
the lower face above the hole's floor [m], `divisor` of the flow map [N].
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim.scene import Scene
from gelflow.sim.tasks.insertion import AttemptResult, InsertionAttempts, insertion_scene
from gelflow.sim.tasks.randomization import Randomization
from gelflow.task import INSERTION, InsertionTask

Observation = NDArray[np.float32]

# Rounds of sampling until a first attempt does not insert the part; one is nearly always enough.
_MAX_RESET_ROUNDS = 100
_NO_START = f"no valid start in {_MAX_RESET_ROUNDS} rounds: every part was inserted at the first attempt, or failed"


def _spaces(task: InsertionTask) -> tuple[Any, Any]:
    return Box(-1, 1, task.observation_shape, np.float32), Box(-1, 1, (3,), np.float32)


def _scene(task: InsertionTask, scene: Scene | None, preset: str | None) -> Scene:
    """The given scene, or the task's scene with a preset."""
    if scene is None:
        return insertion_scene(task, preset=preset)
    if preset is not None:
        raise UsageError(f"scene and preset exclude each other; got preset {preset!r} and a scene")
    return scene


def _misalignment(options: dict[str, Any] | None, count: int) -> NDArray[np.float64] | None:
    """The misalignment in the options of `reset`, shape (count, 3), or None."""
    if not options:
        return None
    if unknown := set(options) - {"misalignment"}:
        raise UsageError(f"reset: unknown option {sorted(unknown)[0]!r}; there is 'misalignment': (x, y, yaw) [m, rad]")
    given = np.asarray(options["misalignment"], dtype=float)
    if given.shape not in ((3,), (count, 3)) or not np.isfinite(given).all():
        raise UsageError(f"reset: misalignment must be 3 finite numbers, or ({count}, 3), got {given.tolist()}")
    return np.array(np.broadcast_to(given, (count, 3)))


def _info(result: AttemptResult, attempts: InsertionAttempts, tries: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    return {
        "attempts": tries.copy(),
        "inserted": result.inserted.copy(),
        "failed": result.failed.copy(),
        "pose": attempts.pose.copy(),
        "height": result.height,
        "divisor": result.divisor,
    }


class InsertionEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """The insertion task with one gripper.

    Parameters
    ----------
    task: task description
    scene: scene to simulate; None takes `insertion_scene(task, preset=preset)`
    preset: accuracy preset of the task's scene
    randomization: distribution of the physical parameters; None: the default of the task's part
    threads: of the simulator

    `reset(options={"misalignment": (x, y, yaw)})` starts at the given gripper pose [m, m, rad]; this start is kept even
    if the first attempt inserts the part (`info["inserted"]`).
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (declared like this by gymnasium.Env)

    def __init__(
        self,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        preset: str | None = None,
        randomization: Randomization | None = None,
        threads: int | None = 1,
    ) -> None:
        self.task = task
        scene = _scene(task, scene, preset)
        self.observation_space, self.action_space = _spaces(task)
        self._attempts = InsertionAttempts(1, task=task, scene=scene, randomization=randomization, threads=threads)
        self._tries = np.zeros(1, dtype=np.int64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new part; returns the observation and info of its first attempt.

        Raises UsageError for unknown options, SimulationError when no valid start is found.
        """
        super().reset(seed=seed)
        given = _misalignment(options, 1)
        for _ in range(_MAX_RESET_ROUNDS):
            self._attempts.draw(self.np_random, misalignment=given)
            result = self._attempts.attempt(self.np_random)
            if given is not None or not (result.inserted | result.failed)[0]:
                break
        else:
            raise SimulationError(_NO_START)
        self._tries[:] = 1
        return result.image[0], self._first(result)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Correct the pose by `action`, shape (3,) in ±1, and make an attempt."""
        attempts = self._attempts
        attempts.pose = self.task.corrected(attempts.pose, self.task.correction(np.asarray(action, dtype=float))[None])
        result = attempts.attempt(self.np_random)
        self._tries += 1
        inserted = bool(result.inserted[0])
        over = bool(result.failed[0] or self._tries[0] >= self.task.attempts)
        return result.image[0], float(attempts.reward()[0]), inserted, over and not inserted, self._first(result)

    def _first(self, result: AttemptResult) -> dict[str, Any]:
        return {key: values[0] for key, values in _info(result, self._attempts, self._tries).items()}


class InsertionVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """The insertion task with `num_envs` grippers in one simulation batch, on all cores; used for training.

    Parameters are those of `InsertionEnv`. A finished environment starts its next part within the same step
    (AutoresetMode.SAME_STEP): the observation is that of the new part's first attempt, and `infos["final_obs"]` and
    `infos["final_info"]` hold the last ones of the finished part. A reset pool simulates the first attempts of
    `num_envs` parts at a time, so that the reset of one environment does not need a batch of its own.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        preset: str | None = None,
        randomization: Randomization | None = None,
        threads: int | None = None,
    ) -> None:
        self.task = task
        scene = _scene(task, scene, preset)
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = _spaces(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._attempts = InsertionAttempts(
            num_envs, task=task, scene=scene, randomization=randomization, threads=threads
        )
        self._reset_pool = InsertionAttempts(
            num_envs, task=task, scene=self._attempts.scene, randomization=randomization, threads=threads
        )
        self._pool_result: AttemptResult | None = None
        self._pool_rows: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._tries = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new parts in all environments; returns the observations and infos of their first attempts.

        All environments share one generator and one seed. `options={"misalignment": …}`, of shape (3,) or
        (num_envs, 3), sets the starts; these are kept even if the first attempt inserts the part.
        """
        if isinstance(seed, list):
            raise UsageError("seed must be a single number: all environments share one random generator")
        super().reset(seed=seed)
        given = _misalignment(options, self.num_envs)
        self._tries[:] = 1
        if given is not None:
            self._attempts.draw(self.np_random, misalignment=given)
            result = self._attempts.attempt(self.np_random)
            return result.image, self._masked(_info(result, self._attempts, self._tries))
        self._pool_rows = self._pool_rows[:0]  # discards samples of an earlier seed
        images = np.empty(self.observation_space.shape or (), np.float32)
        info = self._replace(np.ones(self.num_envs, dtype=bool), images, {})
        return images, self._masked(info)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Correct the poses by `actions`, shape (num_envs, 3) in ±1, and make an attempt in every environment."""
        attempts = self._attempts
        wanted = np.asarray(actions, dtype=float)
        if wanted.shape != (self.num_envs, 3):
            raise UsageError(f"actions must have shape ({self.num_envs}, 3), got {wanted.shape}")
        attempts.pose = self.task.corrected(attempts.pose, self.task.correction(wanted))
        result = attempts.attempt(self.np_random)
        self._tries += 1
        reward = attempts.reward()
        terminated = result.inserted
        truncated = ~terminated & (result.failed | (self._tries >= self.task.attempts))
        done = terminated | truncated
        images, info = result.image, _info(result, attempts, self._tries)
        if not done.any():
            return images, reward, terminated, truncated, self._masked(info)
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(done):
            final[row] = images[row].copy()
        final_info = self._masked({key: values.copy() for key, values in info.items()}, done)
        ended = {"final_obs": final, "_final_obs": done, "final_info": final_info, "_final_info": done.copy()}
        return images, reward, terminated, truncated, {**self._masked(self._replace(done, images, info)), **ended}

    def _masked(self, info: dict[str, NDArray[Any]], rows: NDArray[np.bool_] | None = None) -> dict[str, Any]:
        """Info with Gymnasium's masks of valid entries, for the environments `rows` or for all."""
        mask = np.ones(self.num_envs, dtype=bool) if rows is None else rows
        return {**info, **{f"_{key}": mask.copy() for key in info}}

    def _replace(
        self, rows: NDArray[np.bool_], images: Observation, info: dict[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        """Start new parts in the environments `rows`; writes their observations to `images`, returns updated info."""
        wanted = np.flatnonzero(rows)
        for _ in range(_MAX_RESET_ROUNDS):
            if not len(wanted):
                return info
            if not len(self._pool_rows):
                self._prepare()
            assert self._pool_result is not None
            count = min(len(wanted), len(self._pool_rows))
            into, these = wanted[:count], self._pool_rows[:count]
            wanted, self._pool_rows = wanted[count:], self._pool_rows[count:]
            self._attempts.copy_parts(into, self._reset_pool, these)
            self._tries[into] = 1
            images[into] = self._pool_result.image[these]
            pool_info = _info(self._pool_result, self._reset_pool, np.ones(self.num_envs, dtype=np.int64))
            info = {key: info.get(key, values.copy()) for key, values in pool_info.items()}
            for key, values in pool_info.items():
                info[key][into] = values[these]
        if len(wanted):
            raise SimulationError(_NO_START)
        return info

    def _prepare(self) -> None:
        """Sample the parts of the reset pool and simulate their first attempts; valid ones are not inserted by them."""
        self._reset_pool.draw(self.np_random)
        self._pool_result = self._reset_pool.attempt(self.np_random)
        self._pool_rows = np.flatnonzero(~self._pool_result.inserted & ~self._pool_result.failed)
