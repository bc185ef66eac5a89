"""The state of an unfinished training run: one file in its folder, from which the run continues after a kill."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import replace_file

STATE = "training_state.safetensors"
_KEY = "gelflow_state"
_FORMAT = 1


def save_state(folder: Path, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any]) -> None:
    """Writes arrays and facts (JSON data) atomically: a kill leaves the former state."""
    header = json.dumps({"format": _FORMAT, **facts})
    stored = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    replace_file(folder / STATE, safetensors.numpy.save(stored, metadata={_KEY: header}))


def load_state(folder: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
    """The arrays and facts of an unfinished run in `folder`; None if there is none. Raises UsageError if damaged."""
    path = folder / STATE
    if not path.is_file():
        return None
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            facts = json.loads(file.metadata()[_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
    except (safetensors.SafetensorError, OSError, TypeError, KeyError, ValueError) as error:
        raise UsageError(f"{path} is damaged; delete it to start the training again") from error
    if facts.pop("format") != _FORMAT:
        raise UsageError(f"{path} was written by another version of gelflow; delete it to start the training again")
    return arrays, facts


def finish_state(folder: Path) -> None:
    """Removes the state of a finished run."""
    (folder / STATE).unlink(missing_ok=True)


def check_same_run(folder: Path, stored: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Raises UsageError when the unfinished run in `folder` was started with other values; names them."""
    names = [name for name in {**stored, **given} if stored.get(name) != given.get(name)]
    if names:
        text = ", ".join(f"{name} {stored.get(name)!r} (here {given.get(name)!r})" for name in names)
        raise UsageError(
            f"{folder} holds an unfinished training with {text}; continue that one, or choose another folder"
        )
