"""Base of the tasks of control: each step of an episode holds the controls for one control period."""

import dataclasses
import math
import warnings
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from gymnasium.spaces import Box

from gelflow.errors import UsageError
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.sensor_model import SensorModel
from gelflow.sim.tasks.task_batch import Array, Mask, SceneOptions, TaskBatch, check_option_names
from gelflow.task import TaskDescription


@dataclass(frozen=True)
class ControlDescription(TaskDescription):
    """Base of the descriptions of tasks of control."""

    control_period: float = 0.025  # [s]
    max_steps: int = 100  # control periods of an episode, after which it is truncated

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.control_period > 0 or self.max_steps < 1:
            given = f"{self.control_period} and {self.max_steps}"
            raise UsageError(f"control_period must be positive and max_steps at least 1, got {given}")

    @property
    def observation_size(self) -> int:
        """Number of values of an observation, a vector."""
        raise NotImplementedError


def adapt_step(scene: Scene, period: float) -> Scene:
    """The scene with a step that divides the control period [s]: its own, or the next smaller one, with a warning."""
    steps = period / scene.step
    if abs(steps - round(steps)) < 1e-6 * steps:
        return scene
    step = period / math.ceil(steps)
    warnings.warn(
        f"scene {scene.name}: its step of {scene.step * 1e3:g} ms does not divide the control period of "
        f"{period * 1e3:g} ms; the task takes steps of {step * 1e3:g} ms",
        stacklevel=3,
    )
    return dataclasses.replace(scene, step=step)


class ControlTask(TaskBatch):
    """A task of control: each `step` simulates one control period.

    Parameters
    ----------
    randomization: distributions of the task's quantities and of the effects of real pads
    scene: name; the step of the scene is adapted to the control period, see `adapt_step`
    actions: number of actions
    overrides: values of the scene file, see `load_scene`
    options: preset and friction of the scene; threads of the simulator, on which results do not depend

    A subclass starts episodes (`_draw`), converts actions to controls (`_controls`), and reads the state after a period
    (`_observe`): observation, reward, `terminated`, `info["success"]`. The episode is truncated after `max_steps` or
    when the simulation fails.
    """

    def __init__(
        self,
        description: ControlDescription,
        num_envs: int,
        randomization: Randomization,
        *,
        scene: str,
        actions: int,
        privileged: int,
        overrides: Mapping[str, Any] | None = None,
        **options: Unpack[SceneOptions],
    ) -> None:
        super().__init__(
            description,
            num_envs,
            observation_space=Box(-np.inf, np.inf, (description.observation_size,), np.float32),
            action_space=Box(-1, 1, (actions,), np.float32),
            privileged=privileged,
        )
        check_option_names(description.name, type(self), options)
        preset, friction = options.get("preset"), options.get("friction")
        loaded = load_scene(scene, preset=preset, friction=friction, overrides=overrides)
        self.scene = adapt_step(loaded, description.control_period)
        self.sim = Simulator(self.scene, num_envs=num_envs, threads=options.get("threads"))
        self.randomization = randomization
        self._sensors = SensorModel([pad.positions for pad in self.scene.pads], num_envs)
        self.frames_per_second = 1 / description.control_period
        self.steps_per_period = round(description.control_period / self.scene.step)
        self._max_steps = description.max_steps
        self.info["steps"] = np.zeros(num_envs, dtype=np.int64)

    @abstractmethod
    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        """Set parameters and state of new episodes in the environments `which`."""

    @abstractmethod
    def _controls(self, actions: Array, rng: np.random.Generator, active: Mask) -> Array:
        """Controls (N, nu) of one control period for actions (N, k) in ±1."""

    @abstractmethod
    def _observe(self, active: Mask, rng: np.random.Generator) -> None:
        """Write the rows `active` of observation, reward, terminated and info from the present state."""

    def _reset(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        self._draw(which, rng, options)
        self.info["steps"][which] = 0
        self.terminated[which] = False
        self._observe(which, rng)
        self.reward[which] = 0
        self._end_episodes(which)

    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        controls = self._controls(actions, rng, active)
        self.sim.step(controls, self.steps_per_period, active=None if active.all() else active)
        self.info["steps"][active] += 1
        self._observe(active, rng)
        self._end_episodes(active)

    def _end_episodes(self, active: Mask) -> None:
        self.info["failed"][active] = (self.sim.status != 0)[active]
        over = self.info["failed"] | (self.info["steps"] >= self._max_steps)
        for result in (self.terminated, self.info["success"]):
            result[active] &= ~self.info["failed"][active]
        self.truncated[active] = (over & ~self.terminated)[active]
