"""The insertion task as Gymnasium environments: `gelflow/Insertion-v0`, one part or many side by side.

An episode is one part. `reset` draws it and makes a first attempt; every `step` corrects the gripper's pose by the
action and makes another. Starts that happen to go in at the first attempt are drawn again: there is nothing to correct.

Action: (x, y, yaw) in ±1, scaled by the task, in the gripper's frame; the pose stays inside the task's workspace.
Observation: the normalized flow map of the attempt, float32, (frames * sensors * 2, rows, cols), in ±1.
Reward: −1e4 ‖position error [m]‖² − 20 (yaw error [rad])² after the correction, nothing else.
Terminated: the part is in the hole. Truncated: the task's attempts, the first one included, are used up, or the
simulator could not go on (`info["failed"]`).
Info: `attempts` so far, `inserted`, `failed`, `pose` of the gripper in the hole's frame, `height` of the lower face's
highest corner above the hole's floor [m], `divisor` of the flow map [N].
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim.scene.scene import Scene
from gelflow.sim.tasks.insertion import AttemptResult, InsertionAttempts, insertion_scene
from gelflow.sim.tasks.randomization import DEFAULT_RANDOMIZATION, Randomization
from gelflow.task import INSERTION, InsertionTask

Observation = NDArray[np.float32]

_MAX_RESET_ROUNDS = 100  # rounds of drawing until a start does not go in at once; one nearly always does


def _spaces(task: InsertionTask) -> tuple[Any, Any]:
    return Box(-1, 1, task.observation_shape, np.float32), Box(-1, 1, (3,), np.float32)


def _scene(task: InsertionTask, scene: Scene | None, preset: str | None) -> Scene:
    """The scene that an environment was given, or the task's under a preset."""
    if scene is None:
        return insertion_scene(task, preset=preset)
    if preset is not None:
        raise UsageError(f"give a scene or a preset of the task's scene, not both; got preset {preset!r} and a scene")
    return scene


def _misalignment(options: dict[str, Any] | None, count: int) -> NDArray[np.float64] | None:
    """The start that `reset` was asked for, shape (count, 3), or None."""
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
    """One part at a time.

    `reset(options={"misalignment": (x, y, yaw)})` starts from a given pose [m, m, rad]; such a start is not drawn
    again, and `info["inserted"]` says when it went in at the first attempt.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as gymnasium has it)

    def __init__(
        self,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        preset: str | None = None,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
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
        """A new part; returns the flow map of its first attempt."""
        super().reset(seed=seed)
        given = _misalignment(options, 1)
        for _ in range(_MAX_RESET_ROUNDS):
            self._attempts.draw(self.np_random, misalignment=given)
            result = self._attempts.attempt(self.np_random)
            if given is not None or not (result.inserted | result.failed)[0]:
                break
        else:
            raise SimulationError(f"{_MAX_RESET_ROUNDS} starts in a row went in at once, or failed")
        self._tries[:] = 1
        return result.image[0], self._first(result)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Correct the pose by `action` (±1, shape (3,)) and attempt again."""
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
    """Many parts side by side, on all cores; what training uses.

    A finished environment goes on with the next part within the same step (AutoresetMode.SAME_STEP): its observation
    is that of the new part's first attempt, `infos["final_obs"]` and `infos["final_info"]` hold the old one's last.
    New parts come from a nursery that prepares `num_envs` of them at a time, so that a single finished environment
    does not make the others wait.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        preset: str | None = None,
        randomization: Randomization = DEFAULT_RANDOMIZATION,
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
        """New parts everywhere; returns the flow maps of their first attempts.

        One seed serves all environments. With `options={"misalignment": …}`, of shape (3,) or (num_envs, 3), starts
        are as given and none is drawn again.
        """
        if isinstance(seed, list):
            raise UsageError("the environments draw from one generator: give one seed, not one for each")
        super().reset(seed=seed)
        given = _misalignment(options, self.num_envs)
        self._tries[:] = 1
        if given is not None:
            self._attempts.draw(self.np_random, misalignment=given)
            result = self._attempts.attempt(self.np_random)
            return result.image, self._masked(_info(result, self._attempts, self._tries))
        self._pool_rows = self._pool_rows[:0]  # what a former seed drew is forgotten
        images = np.empty(self.observation_space.shape or (), np.float32)
        info = self._replace(np.ones(self.num_envs, dtype=bool), images, {})
        return images, self._masked(info)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Correct every pose by its action (±1, shape (num_envs, 3)) and attempt again."""
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
        """Gymnasium's way to say for which environments an entry holds."""
        mask = np.ones(self.num_envs, dtype=bool) if rows is None else rows
        return {**info, **{f"_{key}": mask.copy() for key in info}}

    def _replace(
        self, rows: NDArray[np.bool_], images: Observation, info: dict[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        """Put new parts where `rows`, their flow maps into `images`; returns `info` with their entries."""
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
            raise SimulationError(f"{_MAX_RESET_ROUNDS} rounds of starts went in at once, or failed")
        return info

    def _prepare(self) -> None:
        """Draw parts in the nursery and make their first attempts; those that are not in at once are ready."""
        self._reset_pool.draw(self.np_random)
        self._pool_result = self._reset_pool.attempt(self.np_random)
        self._pool_rows = np.flatnonzero(~self._pool_result.inserted & ~self._pool_result.failed)
