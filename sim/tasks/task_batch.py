"""A batch of environments of one task, stepped together; base of the attempt tasks and the control tasks."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, TypedDict

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import SimulationError, UsageError
from gelflow.sim.arguments import check_mask, integer, number_array
from gelflow.sim.tasks.randomization import Randomization
from gelflow.task import TaskDescription
from gelflow.toml_tables import suggestion

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Rounds of sampling until an episode does not end at once; one or two are nearly always enough.
_MAX_RESET_ROUNDS = 100


class SceneOptions(TypedDict, total=False):
    """Options that the batches of all tasks have; None or missing: the default."""

    preset: str | None  # of the task's scene
    friction: str | None  # law of the task's scene
    threads: int | None  # of the simulator; by default all available cores. Results do not depend on it.


class TaskBatch(ABC):
    """`num_envs` environments of one task in one simulation batch.

    Parameters
    ----------
    description: of the task; checkpoints contain it
    num_envs: number of environments N
    observation_space, action_space: of ONE environment; actions are in ±1
    privileged: number p of true quantities in `info["privileged"]`

    Attributes
    ----------
    The following hold the results of the last `reset` or `step`; both overwrite them in place.
    observation: (N, …) float32
    reward: (N,); 0 after `reset`
    terminated, truncated: (N,) bool; true after `reset` only where the episode ended at once, see `reset`
    info: arrays with first axis N: "success" and "failed" (bool; failed: the simulation stopped), "privileged" (N, p)
        (the true quantities that an oracle or a teacher may use), and those of the task
    quantities: randomized quantities of the present episodes, name → (N,), and `quantity_units`, their units
    metrics: results of the present episodes beyond success, name and unit → (N,); evaluations report their means
    """

    length_unit: ClassVar[str] = "steps"  # what reports count: "steps", "attempts", or "corrections" between attempts

    def __init__(
        self,
        description: TaskDescription,
        num_envs: int,
        *,
        observation_space: Box,
        action_space: Box,
        privileged: int,
    ) -> None:
        num_envs = integer("num_envs", num_envs, minimum=1)
        self.description = description
        self.num_envs = num_envs
        self.frames_per_second = 1.0  # of a video with one picture a step
        self.observation_space = observation_space
        self.action_space = action_space
        self.observation: NDArray[np.float32] = np.zeros((num_envs, *observation_space.shape), np.float32)
        self.reward: Array = np.zeros(num_envs)
        self.terminated: Mask = np.zeros(num_envs, dtype=bool)
        self.truncated: Mask = np.zeros(num_envs, dtype=bool)
        self.info: dict[str, NDArray[Any]] = {
            "success": np.zeros(num_envs, dtype=bool),
            "failed": np.zeros(num_envs, dtype=bool),
            "privileged": np.zeros((num_envs, privileged)),
        }
        self._started: Mask = np.zeros(num_envs, dtype=bool)  # environments with a first reset
        self.quantities: dict[str, Array] = {}
        self.quantity_units: dict[str, str] = {}
        self.metrics: dict[str, Array] = {}

    @property
    def all(self) -> Mask:
        """A mask of all environments."""
        return np.ones(self.num_envs, dtype=bool)

    def reset(
        self,
        which: ArrayLike,
        rng: np.random.Generator,
        *,
        options: Mapping[str, Any] | None = None,
        keep_ended: bool = False,
    ) -> None:
        """Start new episodes in the environments `which` (N,); the others keep their state and cost nothing.

        An episode that ends at once, because its first attempt succeeds or its simulation fails, is drawn again unless
        `keep_ended` is set (an evaluation counts it) or `options` fix the start. Raises UsageError for unknown options
        and wrong values, which change nothing, SimulationError when every draw ends at once.
        """
        rows = self._mask(which)
        if not rows.any():
            return
        before = rng.bit_generator.state
        try:
            self._reset(rows, rng, options or {})
        except UsageError:
            rng.bit_generator.state = before
            raise
        self._started |= rows
        if options or keep_ended:
            return
        for left in reversed(range(_MAX_RESET_ROUNDS + 1)):
            ended = rows & (self.terminated | self.truncated)
            if not ended.any():
                return
            if left:
                self._reset(ended, rng, {})
        succeeded = int((ended & self.info["success"]).sum())
        raise SimulationError(
            f"{self.description.name}: no valid start in {_MAX_RESET_ROUNDS} rounds: every episode ended at once; in "
            f"the last round {succeeded} succeeded and {int(ended.sum()) - succeeded} failed"
        )

    def step(self, actions: ArrayLike, rng: np.random.Generator, *, active: ArrayLike | None = None) -> None:
        """One attempt or one control period with `actions` (N, k), which are clipped to ±1.

        Environments that are not `active` (N,) keep their state and results, and cost nothing; None steps all. Raises
        UsageError when an action has the wrong shape or is no finite number, and before the first `reset`.
        """
        wanted = number_array("actions", actions, float)
        shape = (self.num_envs, *self.action_space.shape)
        if wanted.shape != shape:
            raise UsageError(f"actions must have shape {shape}, got {wanted.shape}")
        if not np.isfinite(wanted).all():
            raise UsageError(f"actions must be finite, got {wanted[~np.isfinite(wanted)][0]}")
        rows = self.all if active is None else self._mask(active)
        if not self._started[rows].all():
            raise UsageError(f"{self.description.name}: reset the environments before their first step")
        if not rows.any():
            return
        self._step(np.clip(wanted, -1, 1), rng, rows)

    def _record(self, which: Mask, drawn: Mapping[str, Array], table: Randomization, **units: str) -> None:
        """Keep quantities (n,) of new episodes in `which` for reports; `units` are those that `table` does not have."""
        for name, values in drawn.items():
            self.quantities.setdefault(name, np.zeros(self.num_envs))[which] = values
            self.quantity_units[name] = units[name] if name in units else table[name].unit

    @abstractmethod
    def _reset(self, which: Mask, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        """Start new episodes in `which` and write their results; `options` hold for all environments in `which`."""

    @abstractmethod
    def _step(self, actions: Array, rng: np.random.Generator, active: Mask) -> None:
        """Step the environments `active` with actions (N, k) in ±1 and write their results."""

    def oracle(self) -> Array:
        """Actions (N, k) of an oracle that knows the true state. Raises UsageError when the task has none."""
        raise UsageError(f"{self.description.name}: the task has no oracle")

    @abstractmethod
    def render(self, index: int = 0) -> NDArray[np.uint8]:
        """A picture of environment `index`, scene and pads; shape (height, width, 3)."""

    def _mask(self, which: ArrayLike) -> Mask:
        mask = np.array(which)  # a copy: `which` may be a result of the batch, which changes
        check_mask(mask, self.num_envs)
        return mask


def check_option_names(task: str, batch_class: type[TaskBatch], options: Mapping[str, Any]) -> None:
    """Raises UsageError for a name in `options` that is none of the class's options, all of which have a default.

    Every class takes the `SceneOptions`.
    """
    parameters = inspect.signature(batch_class).parameters.values()
    valid = {given.name for given in parameters if given.default is not given.empty} | {*SceneOptions.__annotations__}
    for name in options:
        if name not in valid:
            raise UsageError(f"{task} has no option {name!r}; {suggestion(name, valid)}")


def check_options(task: str, options: Mapping[str, Any], known: Mapping[str, str]) -> None:
    """Raises UsageError when `options` of `reset` has a key that is not in `known` (name → meaning)."""
    for name in options:
        if name not in known:
            there = ", ".join(f"{key!r}: {meaning}" for key, meaning in known.items()) or "none"
            raise UsageError(f"{task}: reset has no option {name!r}; there are {there}")


def option_rows(name: str, value: Any, which: Mask, shape: tuple[int, ...] = ()) -> Array:
    """Values of an option for the environments `which`: (n, *shape), n the number of environments in `which`.

    `value` is one value of `shape`, or one for each environment of the batch, (N, *shape). Raises UsageError otherwise.
    """
    given = number_array(f"reset: {name}", value, float)
    full = (len(which), *shape)
    if given.shape not in (shape, full) or not np.isfinite(given).all():
        raise UsageError(f"reset: {name} must be finite, of shape {shape} or {full}, got {given.tolist()}")
    return np.array(np.broadcast_to(given, full)[which])
