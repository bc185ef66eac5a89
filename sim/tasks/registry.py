"""The tasks of gelflow by name: the environments, trainings and evaluations of a task start from its name."""

import importlib
from typing import Any

from gelflow.errors import UsageError
from gelflow.sim.tasks.task_batch import TaskBatch
from gelflow.toml_tables import suggestion

# name → module and class of its batch
_TASKS: dict[str, tuple[str, str]] = {
    "rolling": ("gelflow.sim.tasks.rolling", "Rolling"),
    "pushing": ("gelflow.sim.tasks.pushing", "Pushing"),
    "cap": ("gelflow.sim.tasks.cap_rotation", "CapRotation"),
}


def task_names() -> tuple[str, ...]:
    """Names of all tasks."""
    return tuple(_TASKS)


def make_task(name: str, num_envs: int, **options: Any) -> TaskBatch:
    """A batch of `num_envs` environments of the task `name`.

    `options` are those of the task's class; all tasks have `preset`, `friction`, `randomization` and `threads`. Raises
    UsageError for an unknown name.
    """
    if name not in _TASKS:
        raise UsageError(f"no task {name!r}; {suggestion(name, task_names())}")
    module, cls = _TASKS[name]
    batch = getattr(importlib.import_module(module), cls)(num_envs, **options)
    assert isinstance(batch, TaskBatch)
    return batch
