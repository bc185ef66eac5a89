"""The state arrays of a simulator: views of the memory of the core, which only their elements can change."""

from typing import Any

from gelflow.errors import UsageError

STATE_ARRAYS = ("q", "v", "params", "anchors", "anchored", "history", "status", "iterations", "halved")


class StateArrays:
    """Base of an object whose state arrays are set once. Another array under their name raises UsageError."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in STATE_ARRAYS and self.__dict__.get(name, value) is not value:
            raise UsageError(f"{name} is a view of the simulator's state; write its elements: sim.{name}[:] = …")
        super().__setattr__(name, value)
