"""The tasks of gelflow by name: the environments, trainings and evaluations of a task start from its name."""

import importlib
import inspect
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from gelflow.errors import UsageError
from gelflow.sim.arguments import check_type, shown
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.task_batch import TaskBatch, check_option_names
from gelflow.task import INSERTION, InsertionTask, TaskDescription
from gelflow.toml_tables import suggestion

# name → module and class of its batch
_TASKS: dict[str, tuple[str, str]] = {
    "rolling": ("gelflow.sim.tasks.rolling", "Rolling"),
    "grasp": ("gelflow.sim.tasks.grasp", "Grasp"),
    "pushing": ("gelflow.sim.tasks.pushing", "Pushing"),
    "cap": ("gelflow.sim.tasks.cap_rotation", "CapRotation"),
    "insertion": ("gelflow.sim.tasks.insertion_environments", "Insertion"),
}


def task_names() -> tuple[str, ...]:
    """Names of all tasks."""
    return tuple(_TASKS)


def randomizations(name: str) -> dict[str, Randomization]:
    """The randomization tables of the task `name`, by their names. Raises UsageError for an unknown task."""
    tables: dict[str, Randomization] = _module(name).RANDOMIZATIONS
    return tables


def make_task(name: str, num_envs: int, **options: Any) -> TaskBatch:
    """A batch of `num_envs` environments of the task `name`.

    `options` are those of the task's class; all tasks have `task` (the description), `preset`, `friction`,
    `randomization` and `threads`. `randomization` may also be the name of one of the task's tables, such as "full".
    `ranges` replaces ranges of this table, quantity → (low, high); with `samples`, quantity → values (k,), quantities
    are drawn together, for example from the distribution in which a calibration ends. Raises UsageError for an unknown
    name, an invalid range and invalid samples.
    """
    batch_class = getattr(_module(name), _TASKS[name][1])
    description = inspect.signature(batch_class).parameters["task"].default
    check_type("task", options.get("task", description), type(description), f"of type {type(description).__name__}")
    if isinstance(table := options.get("randomization"), str):
        options["randomization"] = _named_randomization(name, table, options.get("task"))
    ranges, samples = (_mapping(key, options.pop(key, None)) for key in ("ranges", "samples"))
    if ranges or samples:
        table = options.get("randomization") or _named_randomization(name, "default", options.get("task"))
        options["randomization"] = table.replace(**ranges).drawn_from(samples)
    if options.get("randomization") is None:
        options.pop("randomization", None)
    else:
        check_type("randomization", options["randomization"], Randomization, "the name of a table or a Randomization")
    check_option_names(name, batch_class, options)
    batch = batch_class(num_envs, **options)
    assert isinstance(batch, TaskBatch)
    return batch


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    """The mapping, empty for None. Raises UsageError for another value."""
    check_type(name, value, Mapping | None, "a mapping of quantities")
    return value or {}


def _named_randomization(name: str, table: str, task: TaskDescription | None) -> Randomization:
    if name == "insertion":
        from gelflow.sim.tasks.insertion_randomization import insertion_randomization  # deferred: loads the simulator

        return insertion_randomization(table, task if isinstance(task, InsertionTask) else INSERTION)
    tables = randomizations(name)
    if table not in tables:
        raise UsageError(f"{name} has no randomization {table!r}; {suggestion(table, tables)}")
    return tables[table]


def _module(name: str) -> ModuleType:
    if not isinstance(name, str) or name not in _TASKS:
        raise UsageError(f"no task {shown(name)}; {suggestion(name, task_names())}")
    return importlib.import_module(_TASKS[name][0])
