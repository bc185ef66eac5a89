"""Strict reading of TOML tables: an unknown key is an error that names the file, the key and the nearest valid one."""

import difflib
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises UsageError when it is missing, no text, or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"no such scene file: {path}") from None
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path} is not valid TOML: {error}") from None


def nearest(word: str, known: Collection[str]) -> str:
    """A hint for a name that was not found: the nearest known one, or all of them."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(sorted(known)) or 'none'}"


def set_path(tables: dict[str, Any], dotted: str, value: Any) -> None:
    """Set `a.b.c` in nested tables; a `*` stands for every table at its place.

    Raises UsageError when a table on the way does not exist. The last key is checked by whoever reads the table.
    """
    *way, last = dotted.split(".")
    for table in tables_at(tables, way, f"override {dotted!r}"):
        table[last] = value


def tables_at(tables: dict[str, Any], way: Sequence[str], where: str) -> list[dict[str, Any]]:
    """The nested tables that a way of keys leads to; a `*` stands for every table at its place.

    Raises UsageError, which begins with `where`, when one does not exist.
    """
    at = [tables]
    for key in way:
        found: list[dict[str, Any]] = []
        for table in at:
            children = {name: child for name, child in table.items() if isinstance(child, dict)}
            if key != "*" and key not in children:
                raise UsageError(f"{where}: no table {key!r}; {nearest(key, children)}")
            found += children.values() if key == "*" else [children[key]]
        at = found
    return at


@dataclass(frozen=True)
class Table:
    """One TOML table that is being read; `where` tells file and place in messages."""

    data: Mapping[str, Any]
    where: str

    def only(self, known: Collection[str]) -> "Table":
        """Raise UsageError on a key that is not among `known`."""
        for key in self.data:
            if key not in known:
                raise UsageError(f"{self.where}: unknown key {key!r}; {nearest(key, known)}")
        return self

    def table(self, key: str) -> "Table":
        """A table inside this one; empty when absent."""
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise UsageError(f"{self.where}: {key} must be a table, got {value!r}")
        return Table(value, f"{self.where}, {key}" if ", " not in self.where else f"{self.where}.{key}")

    def tables(self, key: str) -> dict[str, "Table"]:
        """The named tables inside table `key`."""
        group = self.table(key)
        return {name: group.table(name) for name in group.data}

    def number(self, key: str, default: float | None = None, *, least: float = float("-inf")) -> float:
        """A finite number of at least `least`; `default` when absent, an error when there is none."""
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value < float("inf"):
            bound = "" if least == float("-inf") else f" ≥ {least:g}"
            raise UsageError(f"{self.where}: {key} must be a number{bound}, got {value!r}")
        return float(value)

    def integer(self, key: str, default: int | None = None, *, least: int = 1) -> int:
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise UsageError(f"{self.where}: {key} must be a whole number ≥ {least}, got {value!r}")
        return value

    def word(self, key: str, default: str | None = None, *, among: Collection[str] | None = None) -> str:
        """A string, one of `among` where that is given."""
        value = self._get(key, default)
        if not isinstance(value, str):
            raise UsageError(f"{self.where}: {key} must be a string, got {value!r}")
        if among is not None and value not in among:
            raise UsageError(f"{self.where}: {key} is {value!r}; {nearest(value, among)}")
        return value

    def numbers(self, key: str, count: int, default: Sequence[float] | None = None) -> tuple[float, ...]:
        value = self._get(key, default)
        wrong = not isinstance(value, list | tuple) or len(value) != count
        if wrong or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
            raise UsageError(f"{self.where}: {key} must be {count} numbers, got {value!r}")
        return tuple(float(v) for v in value)

    def flag(self, key: str, default: bool | None = None) -> bool:
        value = self._get(key, default)
        if not isinstance(value, bool):
            raise UsageError(f"{self.where}: {key} must be true or false, got {value!r}")
        return value

    def words(self, key: str, default: Sequence[str] | None = None) -> tuple[str, ...]:
        """A list of strings; a single string counts as a list of one."""
        value = self._get(key, default)
        value = [value] if isinstance(value, str) else value
        if not isinstance(value, list | tuple) or not value or any(not isinstance(v, str) for v in value):
            raise UsageError(f"{self.where}: {key} must be a name or a list of names, got {value!r}")
        return tuple(value)

    def _get(self, key: str, default: Any) -> Any:
        value = self.data.get(key, default)
        if value is None:
            raise UsageError(f"{self.where}: {key} is missing")
        return value
