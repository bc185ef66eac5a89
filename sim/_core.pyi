"""Types of the C++ core; the classes are documented where gelflow.sim.Simulator uses them."""

from typing import Any

class ModelSpec:
    gravity: Any
    step: float
    tolerance: float
    max_iterations: int
    max_halvings: int
    polish: int  # Newton iterations after it has converged
    integrator: str
    def __getattr__(self, name: str) -> Any: ...

class Model:
    def __init__(self, spec: ModelSpec) -> None: ...
    def __getattr__(self, name: str) -> Any: ...

class Batch:
    def __init__(self, model: Model, environments: int, threads: int) -> None: ...
    def __getattr__(self, name: str) -> Any: ...

class BatchFloat:
    def __init__(self, model: Model, environments: int, threads: int) -> None: ...
    def __getattr__(self, name: str) -> Any: ...

def directional_rollout(*args: Any) -> dict[str, Any]: ...

LEVEL: str  # the build that was chosen: base or v3
