"""Gymnasium environments of a task: one environment, and a vector environment for training."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.tasks.task_batch import Mask, TaskBatch

Observation = NDArray[np.float32]


def _batch(batch: TaskBatch | str, num_envs: int | None, options: dict[str, Any]) -> TaskBatch:
    """The given batch, or a new batch of the task with this name."""
    if isinstance(batch, str):
        return make_task(batch, 1 if num_envs is None else num_envs, **options)
    if options:
        raise UsageError(f"a batch is given: options such as {next(iter(options))!r} have no effect")
    if num_envs not in (None, batch.num_envs):
        raise UsageError(f"the batch has {batch.num_envs} environments, expected {num_envs}")
    return batch


def _check_render_mode(mode: str | None, modes: list[str]) -> None:
    if mode is not None and mode not in modes:
        raise UsageError(f"render_mode must be None or one of {', '.join(modes)}, got {mode!r}")


class TaskEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One environment of a task.

    Parameters
    ----------
    batch: name of a task, or a batch of one environment
    render_mode: None or "rgb_array"
    options: of the task's batch, such as `preset` (only with a name)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (declared like this by gymnasium.Env)

    def __init__(self, batch: TaskBatch | str, *, render_mode: str | None = None, **options: Any) -> None:
        _check_render_mode(render_mode, self.metadata["render_modes"])
        self.batch = _batch(batch, 1, options)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.batch.frames_per_second}
        spaces: tuple[Any, Any] = self.batch.observation_space, self.batch.action_space
        self.observation_space, self.action_space = spaces

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; `options` are those of the task.

        Raises UsageError for unknown options, SimulationError when no valid start is found.
        """
        super().reset(seed=seed)
        self.batch.reset(self.batch.all, self.np_random, options=options)
        return self.batch.observation[0].copy(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step with `action` in ±1."""
        batch = self.batch
        batch.step(np.asarray(action)[None], self.np_random)
        ended = bool(batch.terminated[0]), bool(batch.truncated[0])
        return batch.observation[0].copy(), float(batch.reward[0]), *ended, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """A picture (height, width, 3) in render mode "rgb_array", otherwise None."""
        return None if self.render_mode is None else self.batch.render(0)

    def _info(self) -> dict[str, Any]:
        return {key: values[0].copy() for key, values in self.batch.info.items()}


class TaskVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """`num_envs` environments of a task in one simulation batch.

    A finished environment starts its next episode within the same step (AutoresetMode.SAME_STEP): the observation is
    that of the new episode, and `infos["final_obs"]` and `infos["final_info"]` hold the last ones of the finished
    episode. All environments share one random generator.

    Parameters
    ----------
    batch: name of a task, or a batch
    num_envs: number of environments (only with a name)
    render_mode: None or "rgb_array"
    options: of the task's batch, such as `preset` (only with a name)
    """

    def __init__(
        self, batch: TaskBatch | str, num_envs: int | None = None, *, render_mode: str | None = None, **options: Any
    ) -> None:
        _check_render_mode(render_mode, TaskEnv.metadata["render_modes"])
        self.batch = _batch(batch, num_envs, options)
        self.metadata = {
            **TaskEnv.metadata,
            "render_fps": self.batch.frames_per_second,
            "autoreset_mode": AutoresetMode.SAME_STEP,
        }
        self.render_mode = render_mode
        self.num_envs = self.batch.num_envs
        self.single_observation_space, self.single_action_space = self.batch.observation_space, self.batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes in all environments; `options` are those of the task."""
        if isinstance(seed, list):
            raise UsageError("seed must be a single number: all environments share one random generator")
        super().reset(seed=seed)
        self.batch.reset(self.batch.all, self.np_random, options=options)
        return self.batch.observation.copy(), self._info(self.batch.all)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One step of every environment with `actions` (num_envs, k) in ±1."""
        batch = self.batch
        batch.step(actions, self.np_random)
        reward, terminated, truncated = batch.reward.copy(), batch.terminated.copy(), batch.truncated.copy()
        done = terminated | truncated
        ended: dict[str, Any] = {}
        if done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(done):
                final[row] = batch.observation[row].copy()
            ended = {"final_obs": final, "_final_obs": done, "final_info": self._info(done), "_final_info": done.copy()}
            batch.reset(done, self.np_random)
        return batch.observation.copy(), reward, terminated, truncated, {**self._info(batch.all), **ended}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture (height, width, 3) of each environment in render mode "rgb_array", otherwise None."""
        return None if self.render_mode is None else tuple(self.batch.render(row) for row in range(self.num_envs))

    def _info(self, rows: Mask) -> dict[str, Any]:
        """Copies of the info with Gymnasium's masks of valid entries, for the environments `rows`."""
        info = {key: values.copy() for key, values in self.batch.info.items()}
        return {**info, **{f"_{key}": rows.copy() for key in info}}
