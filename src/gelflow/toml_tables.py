"""Strict reading of TOML files: errors name the file, the table, the key and the nearest valid key."""

import dataclasses
import difflib
import json
import math
import re
import tomllib
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from gelflow.errors import UsageError

T = TypeVar("T")


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file. Raises UsageError if the file is missing, unreadable or not valid TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise UsageError(f"no such file: {path}") from None
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except RecursionError:
        raise UsageError(f"{path} is not valid TOML: its lists or tables are nested too deeply") from None
    except ValueError as error:  # also text that is not UTF-8, and integers with thousands of digits
        raise UsageError(f"{path} is not valid TOML: {error}") from None


def toml_text(tables: Mapping[str, Any], *, name: str = "") -> str:
    """TOML of nested tables of numbers, strings, booleans and lists, and of lists of tables.

    Raises UsageError for a value that TOML cannot express; see `toml_value`.
    """
    values = {key: value for key, value in tables.items() if not _has_tables(value)}
    lines = [f"{_toml_key(key)} = {toml_value(value)}" for key, value in values.items()]
    for key, value in tables.items():
        if not _has_tables(value):
            continue
        dotted = f"{name}.{_toml_key(key)}" if name else _toml_key(key)
        head, inner = (f"[{dotted}]", [value]) if isinstance(value, dict) else (f"[[{dotted}]]", value)
        for table in inner:
            lines += ["", head, toml_text(table, name=dotted).rstrip("\n")]
    return "\n".join(lines) + "\n"


def toml_value(value: Any) -> str:
    """A number, string, boolean, or list or tuple of these as TOML, in ASCII.

    Raises UsageError for another type, such as None, and for a string with a lone surrogate, which has no UTF-8.
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))  # inf, -inf or nan
    surrogate = isinstance(value, str) and re.search("[\ud800-\udfff]", value)
    if surrogate or not isinstance(value, str | bool | int | float):
        raise UsageError(f"a TOML file cannot contain {value!r}")
    # JSON strings, finite numbers and booleans are valid TOML, except for the escapes of some characters.
    return re.sub("[^ -~]", lambda match: _escaped(match[0]), json.dumps(value, ensure_ascii=False))


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"


def _toml_key(key: str) -> str:
    return key if re.fullmatch("[A-Za-z0-9_-]+", key) else toml_value(key)


def _has_tables(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def suggestion(name: str, valid: Collection[str]) -> str:
    """A hint for an error message about an unknown name: the nearest valid name, or all valid names."""
    close = difflib.get_close_matches(str(name), list(valid), n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else f"valid names: {', '.join(sorted(set(valid))) or 'none'}"


def set_by_path(tables: dict[str, Any], dotted_key: str, value: Any) -> None:
    """Set the key `a.b.c` in nested tables; `*` matches every table at its level.

    Raises UsageError if a table on the path does not exist. The last key is not checked here.
    """
    *path, key = dotted_key.split(".")
    for table in tables_at_path(tables, path, f"override {dotted_key!r}"):
        table[key] = value


def tables_at_path(tables: dict[str, Any], path: Sequence[str], location: str) -> list[dict[str, Any]]:
    """The nested tables at a path of keys; `*` matches every table at its level.

    Raises UsageError, prefixed with `location`, if a table on the path does not exist.
    """
    current = [tables]
    for key in path:
        matches: list[dict[str, Any]] = []
        for table in current:
            children = {name: child for name, child in table.items() if isinstance(child, dict)}
            if key != "*" and key not in children:
                raise UsageError(f"{location}: no table {key!r}; {suggestion(key, children)}")
            matches += children.values() if key == "*" else [children[key]]
        current = matches
    return current


@dataclass(frozen=True)
class TomlTable:
    """A table of a TOML file with type-checked access. Every method raises UsageError on an invalid value."""

    data: Mapping[str, Any]
    location: str  # the file and the dotted name of the table, for error messages

    def check_keys(self, valid: Collection[str], *, renamed: Mapping[str, str] | None = None) -> "TomlTable":
        """Raise UsageError on a key that is not in `valid`; `renamed` maps former keys to present ones."""
        for key in self.data:
            if key in valid:
                continue
            new_key = (renamed or {}).get(key)
            hint = f"it is now called {new_key!r}" if new_key else suggestion(key, valid)
            raise UsageError(f"{self.location}: unknown key {key!r}; {hint}")
        return self

    def table(self, key: str) -> "TomlTable":
        """The subtable `key`; empty if absent."""
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise UsageError(f"{self.location}: {key} must be a table, got {value!r}")
        separator = "." if ", " in self.location else ", "
        return TomlTable(value, f"{self.location}{separator}{key}")

    def tables(self, key: str) -> dict[str, "TomlTable"]:
        """The subtables of the subtable `key`, by name."""
        group = self.table(key)
        return {name: group.table(name) for name in group.data}

    def number(
        self, key: str, default: float | None = None, *, minimum: float = -math.inf, maximum: float = math.inf
    ) -> float:
        """A finite number within bounds. A key without a default is required; this holds for all methods below."""
        value = self._get(key, default)
        if not _is_finite(value) or not minimum <= value <= maximum:
            bound = "" if minimum == -math.inf else f" ≥ {minimum:g}"
            bound += "" if maximum == math.inf else f" ≤ {maximum:g}"
            raise UsageError(f"{self.location}: {key} must be a finite number{bound}, got {value!r}")
        return float(value)

    def integer(self, key: str, default: int | None = None, *, minimum: int | None = 1) -> int:
        """An integer ≥ `minimum`; None: without a bound."""
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or (minimum is not None and value < minimum):
            bound = "" if minimum is None else f" ≥ {minimum}"
            raise UsageError(f"{self.location}: {key} must be an integer{bound}, got {value!r}")
        return value

    def string(
        self,
        key: str,
        default: str | None = None,
        *,
        choices: Collection[str] | None = None,
        renamed: Mapping[str, str] | None = None,
    ) -> str:
        """A string; one of `choices`, if given. `renamed` maps former choices to present ones, for error messages."""
        value = self._get(key, default)
        if not isinstance(value, str):
            raise UsageError(f"{self.location}: {key} must be a string, got {value!r}")
        if "\0" in value:
            raise UsageError(f"{self.location}: {key} must not contain the character NUL, got {value!r}")
        if choices is not None and value not in choices:
            new_value = (renamed or {}).get(value)
            hint = f"it is now called {new_value!r}" if new_value else suggestion(value, choices)
            raise UsageError(f"{self.location}: {key} is {value!r}; {hint}")
        return value

    def boolean(self, key: str, default: bool | None = None) -> bool:
        """True or false."""
        value = self._get(key, default)
        if not isinstance(value, bool):
            raise UsageError(f"{self.location}: {key} must be true or false, got {value!r}")
        return value

    def numbers(self, key: str, count: int, default: Sequence[float] | None = None) -> tuple[float, ...]:
        """A list of `count` finite numbers."""
        value = self._get(key, default)
        if not isinstance(value, list | tuple) or len(value) != count or not all(map(_is_finite, value)):
            raise UsageError(f"{self.location}: {key} must be {count} finite numbers, got {value!r}")
        return tuple(float(v) for v in value)

    def integers(self, key: str, count: int) -> tuple[int, ...]:
        """A list of `count` integers."""
        value = self._get(key, None)
        valid = isinstance(value, list | tuple) and len(value) == count
        if not valid or any(isinstance(v, bool) or not isinstance(v, int) for v in value):
            raise UsageError(f"{self.location}: {key} must be {count} integers, got {value!r}")
        return tuple(value)

    def strings(self, key: str, default: Sequence[str] | None = None) -> tuple[str, ...]:
        """A non-empty list of strings; a single string counts as a list of one."""
        value = self._get(key, default)
        value = [value] if isinstance(value, str) else value
        if not isinstance(value, list | tuple) or not value or any(not isinstance(v, str) for v in value):
            raise UsageError(f"{self.location}: {key} must be a name or a list of names, got {value!r}")
        return tuple(value)

    def lookup(self, items: Mapping[str, T], name: str, kind: str) -> T:
        """The item with a name that this table refers to; `kind` names the items in the error message."""
        if name not in items:
            raise UsageError(f"{self.location}: no {kind} {name!r}; {suggestion(name, list(items))}")
        return items[name]

    def as_dataclass(self, cls: type[T], *, renamed: Mapping[str, str] | None = None) -> T:
        """An instance of a dataclass: one key per field, one subtable per field that is a dataclass.

        Supports fields of type bool, int, float, str and fixed-length tuples of float or of int. Errors of
        `__post_init__` are prefixed with the location. `renamed` is that of `check_keys`, for this table only.
        """
        fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, cls))}
        self.check_keys(fields, renamed=renamed)
        types = typing.get_type_hints(cls)
        values = {}
        for name, field in fields.items():
            if name in self.data:
                values[name] = self._value_of_type(name, types[name])
            elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise UsageError(f"{self.location}: {name} is missing")
        try:
            return cls(**values)
        except UsageError as error:
            raise UsageError(f"{self.location}: {error}") from None

    def _value_of_type(self, key: str, kind: Any) -> Any:
        if dataclasses.is_dataclass(kind):
            return self.table(key).as_dataclass(typing.cast(type, kind))
        if typing.get_origin(kind) is tuple:
            members = typing.get_args(kind)
            return self.integers(key, len(members)) if set(members) == {int} else self.numbers(key, len(members))
        if kind is int or typing.get_origin(kind) is typing.Literal:  # of integers, which __post_init__ checks
            return self.integer(key, minimum=None)
        if kind is float:
            return self.number(key)
        return self.boolean(key) if kind is bool else self.string(key)

    def _get(self, key: str, default: Any) -> Any:
        value = self.data.get(key, default)
        if value is None:
            raise UsageError(f"{self.location}: {key} is missing")
        return value


def _is_finite(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer that is too large for a float
        return False
