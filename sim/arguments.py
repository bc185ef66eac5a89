"""Checks of the arguments of a simulator: every refusal is a UsageError in one line."""

from collections.abc import Callable, Container, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gelflow.errors import UsageError

MAX_INTEGER = 2**31 - 1  # of the core


def checked(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function of the core, whose errors become a UsageError, lack of memory included."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except MemoryError:
        name = getattr(function, "__name__", "core")
        raise UsageError(f"{name}: not enough memory; use fewer environments or a smaller model") from None
    except TypeError:  # the message of pybind11 has many lines
        types = ", ".join(type(argument).__name__ for argument in arguments)
        raise UsageError(f"{getattr(function, '__name__', 'core')}: arguments of these types: {types}") from None


def shown(value: Any) -> str:
    """A value in one short line of an error message."""
    if (shape := getattr(value, "shape", None)) and isinstance(shape, tuple):
        return f"{type(value).__name__} of shape {tuple(shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def check_type(name: str, value: Any, kind: Any, expected: str) -> None:
    """Raise UsageError unless `value` is of a type."""
    if not isinstance(value, kind):
        raise UsageError(f"{name} must be {expected}, got {shown(value)}")


def check_optional(**named: tuple[Any, type[Any]]) -> None:
    """Raise UsageError unless each value is None or of its type."""
    for name, (value, kind) in named.items():
        check_type(name, value, (kind, type(None)), f"a {kind.__name__}")


def integers(name: str, values: ArrayLike) -> NDArray[np.int32]:
    """A sequence of integers of 32 bits."""
    array = number_array(name, values, np.int64)
    if array.ndim != 1 or (array.size and not np.issubdtype(np.asarray(values).dtype, np.integer)):
        raise UsageError(f"{name} must be a sequence of integers, got {shown(values)}")
    if wrong := array[(array < -MAX_INTEGER) | (array > MAX_INTEGER)].tolist():
        raise UsageError(f"{name} must be at most {MAX_INTEGER}, got {wrong[0]}")
    return array.astype(np.int32)


def flag(name: str, value: Any) -> bool:
    """A boolean argument."""
    check_type(name, value, bool | np.bool_, "True or False")
    return bool(value)


def integer(name: str, value: Any, *, minimum: int | None = None) -> int:
    """An integer argument."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise UsageError(f"{name} must be an integer, got {shown(value)}")
    if minimum is not None and value < minimum:
        raise UsageError(f"{name} must be at least {minimum}, got {value}")
    if value > MAX_INTEGER:
        raise UsageError(f"{name} must be at most {MAX_INTEGER}, got {value}")
    return int(value)


def near_params(name: Any, params: Iterable[str]) -> list[str]:
    """For an error message: the parameters of the element that `name` names, or the names of all elements."""
    owner = str(name).split(".")[0]
    return [p for p in params if p.split(":")[-1].startswith(owner + ".")] or sorted({p.split(".")[0] for p in params})


def qualified(name: str, params: Container[str], *kinds: str) -> str:
    """The name in `params` of a parameter: with one of the kinds, where elements of several kinds have the name."""
    return next((known for known in (f"{kind}:{name}" for kind in kinds) if known in params), name)


def index_of(kind: str, name: Any, names: Sequence[str]) -> int:
    """The index of `name` in `names`. Raises UsageError for an unknown one."""
    if not isinstance(name, str) or name not in names:
        raise UsageError(f"no {kind} {shown(name)}; there are {', '.join(names)}")
    return list(names).index(name)


def number_array(name: str, value: ArrayLike, dtype: Any) -> NDArray[Any]:
    """`value` as an array of real numbers; itself if it is one."""
    try:
        array = np.asarray(value)
        if np.iscomplexobj(array):
            raise UsageError(f"{name} must be real, got {array.dtype}")
        return np.asarray(value, dtype=dtype)
    except UsageError:
        raise
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise UsageError(f"{name} must be numeric: {' '.join(str(error).split())}") from None


def check_mask(mask: NDArray[Any], count: int) -> None:
    """Raise UsageError unless `mask` is a mask of `count` environments; integers would be indices."""
    if mask.shape != (count,) or mask.dtype != bool:
        raise UsageError(f"a mask of environments must be ({count},) bool, got {mask.shape} {mask.dtype}")


def floating(values: Any) -> Any:
    """An array or tensor; integers and flags as numbers in double precision."""
    if isinstance(values, np.ndarray):
        return values if np.issubdtype(values.dtype, np.floating) else values.astype(float)
    return values if values.dtype.is_floating_point else values.double()


def fill(name: str, target: NDArray[Any], value: ArrayLike) -> None:
    """Assign `value`, broadcast to the shape of `target`."""
    array = number_array(name, value, target.dtype)
    if not target.flags.writeable:
        raise UsageError(f"{name} must be writable")
    try:
        target[...] = array
    except ValueError:
        raise UsageError(f"{name} must have shape {target.shape}, got {array.shape}") from None


def flags(name: str, mask: ArrayLike, count: int) -> NDArray[np.bool_]:
    """A mask of environments, (N,)."""
    values = np.asarray(number_array(name, mask, float))
    if not np.isin(values, (0, 1)).all():  # such as indices
        raise UsageError(f"{name} must be a mask of True and False, got {values[~np.isin(values, (0, 1))][0]:g}")
    array = np.ascontiguousarray(values, dtype=bool)
    if array.shape != (count,):
        raise UsageError(f"{name} must have shape ({count},), got {array.shape}")
    return array
