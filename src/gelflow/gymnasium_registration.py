"""Registration of gelflow's environments with Gymnasium.

Gymnasium 1.x has no plug-in entry points: an environment is registered when its package is imported. Importing
Gymnasium takes longer than importing gelflow, so gelflow registers at once where Gymnasium is already imported, and
otherwise as soon as it is.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_TASK_ENVS = ("gelflow.sim.tasks.gymnasium_envs:TaskEnv", "gelflow.sim.tasks.gymnasium_envs:TaskVectorEnv")
# id → entry points of the environment and the vector environment, and their arguments
ENVIRONMENTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "gelflow/Rolling-v0": (*_TASK_ENVS, {"batch": "rolling"}),
    "gelflow/Grasp-v0": (*_TASK_ENVS, {"batch": "grasp"}),
    "gelflow/Pushing-v0": (*_TASK_ENVS, {"batch": "pushing"}),
    "gelflow/CapRotation-v0": (*_TASK_ENVS, {"batch": "cap"}),
    "gelflow/Insertion-v0": (
        "gelflow.sim.tasks.insertion_environments:InsertionEnv",
        "gelflow.sim.tasks.insertion_environments:InsertionVectorEnv",
        {},
    ),
}


def register_environments() -> None:
    """Add the environments to Gymnasium's registry; a second call has no effect."""
    from gymnasium.envs.registration import register, registry  # deferred: slow to import

    for name, (entry_point, vector_entry_point, arguments) in ENVIRONMENTS.items():
        if name not in registry:
            register(id=name, entry_point=entry_point, vector_entry_point=vector_entry_point, kwargs=arguments)


def register_when_imported() -> None:
    """Register now if Gymnasium is imported, otherwise right after its import."""
    if "gymnasium" in sys.modules:
        register_environments()
    else:
        sys.meta_path.insert(0, _GymnasiumFinder())


class _GymnasiumFinder(MetaPathFinder):
    """Import hook that registers the environments after Gymnasium is loaded, and removes itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            register_environments()

        spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec
