"""Checks of the arguments of a simulator: every refusal is a UsageError in one line."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError
from gelflow.sim import _core

_QUATERNION_OFFSET = {7: 3, 4: 0}  # of the quaternion in the positions of a joint, by their number: free, ball
_MIN_QUATERNION = 1e-6  # length; the core normalizes longer ones


def checked(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function of the core, whose ValueError and TypeError become a UsageError."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except TypeError:  # the message of pybind11 has many lines
        types = ", ".join(type(argument).__name__ for argument in arguments)
        raise UsageError(f"{getattr(function, '__name__', 'core')}: arguments of these types: {types}") from None


def number_array(name: str, value: ArrayLike, dtype: Any) -> NDArray[Any]:
    """`value` as an array of numbers; itself if it is one."""
    try:
        return np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name} must be numeric: {error}") from None


def fill(name: str, target: NDArray[Any], value: ArrayLike) -> None:
    """Assign `value`, broadcast to the shape of `target`."""
    array = number_array(name, value, target.dtype)
    try:
        target[...] = array
    except ValueError:
        raise UsageError(f"{name} must have shape {target.shape}, got {array.shape}") from None


def flags(name: str, mask: ArrayLike, count: int) -> NDArray[np.bool_]:
    """A mask of environments, (N,)."""
    array = np.ascontiguousarray(number_array(name, mask, bool))
    if array.shape != (count,):
        raise UsageError(f"{name} must have shape ({count},), got {array.shape}")
    return array


def quaternion_starts(model: _core.Model) -> tuple[tuple[str, int], ...]:
    """Name of each free or ball joint, and the index in q of the first component of its quaternion."""
    starts = [*model.joint_q, model.nq]
    sizes = np.diff(starts).tolist()
    joints = zip(model.joint_names, starts, sizes, strict=False)  # `starts` has the end as well
    return tuple((name, q + _QUATERNION_OFFSET[size]) for name, q, size in joints if size in _QUATERNION_OFFSET)


def check_state(model: _core.Model, q: NDArray[Any], v: NDArray[Any], active: NDArray[np.uint8]) -> None:
    """Raise UsageError if positions (N, nq) or velocities (N, nv) of an active environment are no state."""
    for name, values in (("q", q), ("v", v)):
        bad = ~np.isfinite(values) & (active[:, None] == 1)
        if bad.any():
            raise UsageError(f"{name}{np.argwhere(bad)[0].tolist()} is not finite")
    for joint, start in quaternion_starts(model):
        length = np.linalg.norm(q[:, start : start + 4], axis=1)
        short = np.flatnonzero((length < _MIN_QUATERNION) & (active == 1))
        if len(short):
            raise UsageError(
                f"environment {short[0]}: the quaternion of joint {joint!r}, q[{start}:{start + 4}], has length "
                f"{length[short[0]]:.3g}; it must have length 1"
            )
