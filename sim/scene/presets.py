"""Presets: named settings of accuracy against speed, the tables `presets.NAME` of a scene.

A preset replaces values of the TOML file, by dotted key. It may set the keys of the solver (time step, integrator,
tolerance, precision) and keys that the file already has in the tables of its elements, such as the number of contact
points where stiffness is per area.
"""

from collections.abc import Collection, Mapping
from typing import Any

from gelflow.errors import UsageError
from gelflow.sim.arguments import shown
from gelflow.toml_tables import TomlTable, set_by_path, suggestion, tables_at_path

PRESET_NAMES = ("fast", "balanced", "accurate")  # presets of every scene of gelflow

Presets = Mapping[str, Mapping[str, Any]]  # preset name -> dotted key -> value


def read_presets(top: TomlTable, *, top_level_keys: Collection[str], element_tables: Collection[str]) -> Presets:
    """The presets of a TOML file.

    Parameters
    ----------
    top: the file
    top_level_keys: keys at the top level that a preset may set even if the file does not
    element_tables: tables at the top level whose keys a preset may set if the file has them

    Raises UsageError, in one line, on a key that the file does not have.
    """
    presets = {name: dict(_flatten(table.data)) for name, table in top.tables("presets").items()}
    elements = {key: value for key, value in top.data.items() if key in element_tables}
    for name, values in presets.items():
        location = f"{top.location}, presets.{name}"
        for dotted_key in values:
            *path, key = dotted_key.split(".")
            if not path and key in top_level_keys:
                continue
            if not path:
                raise UsageError(f"{location}: unknown key {key!r}; {suggestion(key, [*top_level_keys, *elements])}")
            for table in tables_at_path(elements, path, f"{location}: {dotted_key!r}"):
                if key not in table:
                    raise UsageError(f"{location}: {dotted_key!r}: unknown key {key!r}; {suggestion(key, table)}")
    return presets


def apply_preset(data: dict[str, Any], presets: Presets, name: str, location: str) -> None:
    """Write the values of a preset into the tables of a scene. Raises UsageError on an unknown preset."""
    if not isinstance(name, str) or name not in presets:
        raise UsageError(f"{location}: no preset {shown(name)}; {suggestion(name, list(presets))}")
    for dotted_key, value in presets[name].items():
        set_by_path(data, dotted_key, value)


def _flatten(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Pairs of dotted key and value of nested tables.

    TOML parses `points.tip.count = 5` as nested tables and `"points.tip.count" = 5` as a single key; both are equal
    here.
    """
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        children = _flatten(value) if isinstance(value, dict) else [("", value)]
        pairs += [(f"{key}.{path}" if path else key, child) for path, child in children]
    return pairs
