"""The interface of an algorithm: a learner improves a policy on a task, update by update."""

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import Checkpoint
from gelflow.policies.networks.base import Architecture
from gelflow.policies.training.state import RunState
from gelflow.sim.tasks.task_batch import TaskBatch


class Stopwatch:
    """Seconds spent in each share of a run, such as "simulation" and "learning"."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"simulation": 0.0, "learning": 0.0}

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Adds the duration of the block to `seconds[name]`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


class Learner(ABC):
    """An algorithm that improves a policy on a task, update by update.

    A subclass lists the numbers of an update in `columns` and adds the environment steps of each update to `steps`.
    It puts its work into blocks of `clock.timed("simulation")` and `clock.timed("learning")`.
    """

    columns: tuple[str, ...] = ()

    def __init__(self, task: TaskBatch, architecture: Architecture) -> None:
        self.task = task
        self.architecture = architecture
        self.steps = 0
        self.clock = Stopwatch()

    @abstractmethod
    def update(self) -> dict[str, float]:
        """One iteration of the algorithm; returns the numbers of `columns`."""

    @abstractmethod
    def tensors(self) -> dict[str, NDArray[Any]]:
        """The tensors of the present policy, as `Architecture.network` takes them."""

    @abstractmethod
    def state(self) -> RunState:
        """Everything that determines the next updates, except the episodes, which are restarted."""

    @abstractmethod
    def load(self, state: RunState) -> None:
        """Restores `state`."""

    def start_from(self, checkpoint: Checkpoint) -> None:
        """Takes the weights of a policy, before the first update. Raises UsageError where it cannot."""
        raise UsageError(f"{type(self).__name__} cannot start from the weights of a policy")

    @abstractmethod
    def restart_episodes(self) -> None:
        """Starts new episodes in all environments.

        The run calls it after each save: the state need not contain the simulation, and a resumed run still continues
        as an uninterrupted one does, bit for bit.
        """
