"""Reads fault plans from TOML, and writes them as tables."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.hardware_mocks.faults.plan import DEVICES, DIRECTIONS, EVENTS, KINDS, Fault, FaultPlan
from gelflow.hardware_mocks.faults.random_plan import random_plan
from gelflow.toml_tables import TomlTable, read_toml

FORMAT = 1
_PARAMETERS = sorted({name for kind in KINDS.values() for name in kind.parameters})
_CHOICES = {"device": DEVICES, "kind": tuple(KINDS), "event": EVENTS, "direction": DIRECTIONS}


def load_fault_plan(path: Path) -> FaultPlan:
    """Read a fault plan from TOML. Raises UsageError that names the file, the fault and the known names."""
    return plan_from_tables(read_toml(path), str(path))


def plan_from_tables(tables: Mapping[str, Any], location: str) -> FaultPlan:
    """A fault plan from the tables of a TOML file at `location`; `[random] seed` adds the faults of `random_plan`."""
    table = TomlTable(tables, location).check_keys(("format", "fault", "random"))
    if table.integer("format", FORMAT) != FORMAT:
        raise UsageError(f"{location}: format must be {FORMAT}, got {tables['format']!r}")
    entries = tables.get("fault", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UsageError(f"{location}: write each fault as a table [[fault]]")
    faults = [_read(TomlTable(entry, f"{location}, fault {i}")) for i, entry in enumerate(entries, start=1)]
    if "random" in tables:
        random = table.table("random").check_keys(("seed",))
        faults += random_plan(random.integer("seed", minimum=0)).faults
    return FaultPlan(tuple(faults))


def _read(table: TomlTable) -> Fault:
    own = [item.name for item in dataclasses.fields(Fault) if item.name not in ("parameters", "rate", "seed")]
    table.check_keys([*own, "seed", "random", *_PARAMETERS])
    data: dict[str, Any] = {
        name: table.string(name, choices=choices)
        for name, choices in _CHOICES.items()
        if name in ("device", "kind") or name in table.data
    }
    for name in ("at", "after", "below", "duration"):
        if name in table.data:
            data[name] = table.number(name)
    for name in ("attempt", "seed"):
        if name in table.data:
            data[name] = table.integer(name, minimum=0)
    if "random" in table.data:
        if "seed" in data:
            raise UsageError(f"{table.location}: the seed of random times is `seed` of the table random")
        random = table.table("random").check_keys(("seed", "rate"))
        data |= {"rate": random.number("rate", minimum=1e-6), "seed": random.integer("seed", 0, minimum=0)}
    parameters = {name: table.number(name) for name in _PARAMETERS if name in table.data}
    try:
        return Fault(**data, parameters=parameters)
    except UsageError as error:
        raise UsageError(f"{table.location}: {error}") from None


def plan_to_tables(plan: FaultPlan) -> dict[str, Any]:
    """As tables that `plan_from_tables` reads."""
    return {"format": FORMAT, "fault": [_fault_table(fault) for fault in plan.faults]}


def _fault_table(fault: Fault) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for item in dataclasses.fields(fault):
        value = getattr(fault, item.name)
        if item.name not in ("parameters", "rate") and (item.default is dataclasses.MISSING or value != item.default):
            table[item.name] = value
    if fault.rate > 0:
        table["random"] = {"rate": fault.rate, "seed": table.pop("seed", 0)}
    return table | dict(fault.parameters)
