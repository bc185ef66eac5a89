"""The insertion task as a batch, and its Gymnasium environments: `gelflow/Insertion-v0`, single and vectorized.

An episode is one part. `reset` samples the part and makes a first attempt; each `step` corrects the gripper's pose by
the action and makes another attempt. A part that is inserted by the first attempt is sampled again.

Action: correction (x, y, yaw) in ±1, scaled by the task, in the gripper's frame; the pose is limited to the workspace.
Observation: normalized flow map of the attempt, float32, shape (frames * sensors * 2, rows, cols), in ±1; for
comparisons shear forces in parts of 30 mN, or zeros (`observation` of the task).
Reward: `InsertionTask.reward` of the pose after the correction.
Terminated: the part is inserted. Truncated: all attempts of the task (including the first) are used, or the simulation
failed (`info["failed"]`).
Info: number of `attempts`, `inserted` (also `success`), `failed`, gripper `pose` in the hole's frame (also
`privileged`), `height` of the highest corner of the lower face above the hole's floor at the end of the descent [m],
`divisor` of the flow map [N].
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.scene import Scene
from gelflow.sim.tasks.gripper.attempt_task import AttemptTask
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.gymnasium_envs import TaskEnv, TaskVectorEnv
from gelflow.sim.tasks.insertion import InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import (
    RANDOMIZATIONS as RANDOMIZATIONS,  # found by the registry beside `Insertion`
)
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.task_batch import Array, Mask, check_options, option_rows
from gelflow.task import INSERTION, InsertionTask

_FORCE_RANGE = 0.03  # shear force of a marker that is 1 in the observation "forces" [N]
_RESET_OPTIONS = {"misalignment": "x, y, yaw of the gripper [m, m, rad]"}


class Insertion(AttemptTask):
    """A batch of grippers, each with a part above its hole; see the module.

    Parameters
    ----------
    num_envs: number of environments
    task: task description
    scene: scene to simulate; None takes `insertion_scene(task, preset=preset, friction=friction)`
    preset, friction: of the task's scene
    randomization: distribution of the physical parameters; None: the default, with the grasp height of the task's part
    noise: on the flow maps; None: none beyond the sensor effects of the randomization
    threads: of the simulator

    `reset` with the option "misalignment": (x, y, yaw), or one for each environment, starts at the given gripper pose
    [m, m, rad]; this start is kept even if the first attempt inserts the part.
    """

    description: InsertionTask
    length_unit = "corrections"

    def __init__(
        self,
        num_envs: int,
        *,
        task: InsertionTask = INSERTION,
        scene: Scene | None = None,
        preset: str | None = None,
        friction: str | None = None,
        randomization: Randomization | None = None,
        noise: FlowMapNoise | None = None,
        threads: int | None = None,
    ) -> None:
        super().__init__(
            task,
            num_envs,
            observation_space=Box(-1, 1, task.observation_shape, np.float32),
            action_space=Box(-1, 1, (3,), np.float32),
            privileged=3,
            attempts=task.attempts,
        )
        if scene is None:
            scene = insertion_scene(task, preset=preset, friction=friction or "elastic")
        elif preset is not None or friction is not None:
            raise UsageError(
                f"scene and preset exclude each other, as scene and friction; got preset {preset!r}, friction "
                f"{friction!r} and a scene"
            )
        self.attempts = InsertionAttempts(
            num_envs, task=task, scene=scene, randomization=randomization, threads=threads
        )
        self._noise = noise
        self._part_noise: Array = np.zeros((num_envs, 1 + 2 * task.sensors))
        self.info |= {
            "inserted": self.info["success"],
            "pose": self.info["privileged"],
            "height": np.zeros(num_envs),
            "divisor": np.zeros(num_envs),
        }

    def oracle(self) -> Array:
        """Actions to the nearest pose in which the part fits."""
        task = self.description
        return np.asarray(np.clip(task.centring_correction(self.attempts.pose) / task.action_scale, -1, 1))

    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """The part of environment `index` at the end of its last attempt, and the pads."""
        from gelflow.sim.drawing.renderer import render  # deferred: a policy in training draws nothing

        sim = self.attempts.show_end(index)
        x, y, yaw = self.attempts.pose[index]
        title = f"attempt {self.info['attempts'][index]} at {x * 1e3:.1f} mm, {y * 1e3:.1f} mm, {np.degrees(yaw):.1f}°"
        return render(sim, 0, title=title + (": inserted" if self.info["success"][index] else ""))

    def _draw(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        check_options(self.description.name, options, _RESET_OPTIONS)
        given = options.get("misalignment")
        misalignment = None if given is None else option_rows("misalignment", given, which, (3,))
        limits = np.asarray(self.description.workspace)
        if misalignment is not None and (np.abs(misalignment) > limits + 1e-9).any():
            raise UsageError(f"reset: misalignment must be within the workspace ±{limits.tolist()} [m, m, rad]")
        self.attempts.draw(rng, which=which, misalignment=misalignment)
        start = dict(zip(("x", "y", "yaw"), self.attempts.pose[which].T, strict=True))
        if self._noise is not None:
            self._part_noise[which] = self._noise.sample(int(which.sum()), self.description.sensors, rng)
        self._record(which, self.attempts.drawn | start, self.attempts.randomization, x="m", y="m", yaw="rad")

    def _move(self, actions: Array, active: Mask) -> None:
        task, pose = self.description, self.attempts.pose
        pose[active] = task.corrected(pose, task.correction(actions))[active]

    def _attempt(self, active: Mask, rng: np.random.Generator) -> None:
        result = self.attempts.attempt(rng, which=active)
        image = result.image
        if self._noise is not None:
            image = self._noise.apply(image, self._part_noise[active], rng)
        if self.description.observation == "forces":
            image = np.clip(image * (result.divisor / _FORCE_RANGE)[:, None, None, None], -1, 1)
        self.observation[active] = 0 if self.description.observation == "nothing" else image
        for name in ("divisor", "height", "inserted", "failed"):
            self.info[name][active] = getattr(result, name)
        self.info["pose"][active] = self.attempts.pose[active]
        self.reward[active] = self.attempts.reward()[active]


class InsertionEnv(TaskEnv):
    """The insertion task with one gripper; options are those of `make_task`."""

    batch: Insertion

    def __init__(self, *, render_mode: str | None = None, threads: int | None = 1, **options: Any) -> None:
        super().__init__("insertion", render_mode=render_mode, threads=threads, **options)


class InsertionVectorEnv(TaskVectorEnv):
    """The insertion task with `num_envs` grippers in one simulation batch, on all cores; options as `make_task`."""

    batch: Insertion

    def __init__(self, num_envs: int, *, render_mode: str | None = None, **options: Any) -> None:
        super().__init__("insertion", num_envs, render_mode=render_mode, **options)
