"""Presets: how exactly a scene is simulated, chosen with one word.

A scene's TOML file has them as `[presets.NAME]`: values that replace those of the file, by dotted key. Only what the
file has can be replaced, and only what does not change the physics by itself: time step, integrator, Newton's
tolerance, precision, and the parts' own keys, such as the number of contact points where stiffness is per area.
"""

from collections.abc import Collection, Mapping
from typing import Any

from gelflow.errors import UsageError
from gelflow.toml_tables import TomlTable, set_by_path, suggestion, tables_at_path

NAMES = ("fast", "balanced", "accurate")  # of the scenes that come along

Presets = Mapping[str, Mapping[str, Any]]


def read_presets(top: TomlTable, *, free: Collection[str], parts: Collection[str]) -> Presets:
    """The presets of a scene's file: name → dotted key → value.

    Parameters
    ----------
    top: the file
    free: keys at the top that a preset may set even where the file does not
    parts: tables at the top whose keys a preset may set where the file has them

    Raises UsageError, in one line, on a key that the file does not have.
    """
    found = {name: dict(_flat(table.data)) for name, table in top.tables("presets").items()}
    known = {key: value for key, value in top.data.items() if key in parts}
    for name, values in found.items():
        where = f"{top.location}, presets.{name}"
        for dotted in values:
            *way, last = dotted.split(".")
            if not way and last in free:
                continue
            if not way:
                raise UsageError(f"{where}: unknown key {last!r}; {suggestion(last, [*free, *known])}")
            for table in tables_at_path(known, way, f"{where}: {dotted!r}"):
                if last not in table:
                    raise UsageError(f"{where}: {dotted!r}: unknown key {last!r}; {suggestion(last, table)}")
    return found


def with_preset(data: dict[str, Any], presets: Presets, name: str, where: str) -> None:
    """Put a preset's values into a scene's tables. Raises UsageError when there is no such preset."""
    if name not in presets:
        raise UsageError(f"{where}: no preset {name!r}; {suggestion(name, list(presets))}")
    for dotted, value in presets[name].items():
        set_by_path(data, dotted, value)


def _flat(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Nested tables as dotted keys: TOML reads `points.tip.count = 5` as tables, and `"points.tip.count" = 5` not."""
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        inner = _flat(value) if isinstance(value, dict) else [("", value)]
        pairs += [(f"{key}.{rest}" if rest else key, each) for rest, each in inner]
    return pairs
