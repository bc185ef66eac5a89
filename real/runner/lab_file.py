"""Reads and writes lab files. Unknown keys are errors that name the file, the key and the nearest valid ones."""

import dataclasses
import difflib
import json
import math
import tomllib
import typing
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.real.runner.lab import FORMAT, Lab


def load_lab(path: str | Path) -> Lab:
    """Read a lab file. Raises UsageError with one line that names file and key."""
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: cannot read the lab file: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not valid TOML: {error}") from None
    if not isinstance(found := data.get("format"), int) or isinstance(found, bool):
        raise UsageError(f"{path}: the key format is missing; write format = {FORMAT}")
    if found != FORMAT:
        raise UsageError(f"{path}: lab file format {found}; this gelflow reads format {FORMAT}")
    lab = _table(Lab, data, str(path), "")
    assert isinstance(lab, Lab)
    return _with_calibrations(lab, path)


def _with_calibrations(lab: Lab, path: Path) -> Lab:
    """`lab` with full paths of its cameras' calibrations, each of which is read once: an error shows at once."""
    cameras = {}
    for name in ("left", "right"):
        camera = getattr(lab.cameras, name)
        if camera.calibration:
            camera = dataclasses.replace(camera, calibration=str((path.parent / camera.calibration).resolve()))
        try:
            _ = camera.mount
        except UsageError as error:
            raise UsageError(f"{path}: [cameras.{name}] {error}") from None
        cameras[name] = camera
    return dataclasses.replace(lab, cameras=dataclasses.replace(lab.cameras, **cameras))


def save_lab(lab: Lab, path: str | Path, *, title: str) -> None:
    """Write a lab file with every key; it appears whole or not at all. Raises UsageError when it can't be written."""
    path = Path(path)
    lines = [f"# {title}", ""]
    tables: list[tuple[str, Any]] = [("", lab)]
    while tables:
        name, table = tables.pop(0)
        if name:
            lines += ["", f"[{name}]"]
        for field in dataclasses.fields(table):
            value = getattr(table, field.name)
            if dataclasses.is_dataclass(value):
                tables.append((f"{name}.{field.name}" if name else field.name, value))
            else:
                # JSON's texts, numbers, truth values and lists are TOML's too.
                lines.append(f"{field.name} = {json.dumps(value)}")
    partial = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}") from None


def _table(kind: type, data: dict[str, Any], path: str, name: str) -> Any:
    where = f"{path}: [{name}]" if name else f"{path}:"
    fields = {f.name: f for f in dataclasses.fields(kind)}
    types = typing.get_type_hints(kind)
    for key in data:
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=3, cutoff=0.5) or sorted(fields)
            raise UsageError(f"{where} unknown key {key!r}; nearest valid: {', '.join(near)}")
    values = {}
    for key, f in fields.items():
        if key not in data:
            if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
                raise UsageError(f"{where} the key {key!r} is missing")
            continue
        inner = f"{name}.{key}" if name else key
        values[key] = _value(types[key], data[key], path, where, key, inner)
    try:
        return kind(**values)
    except UsageError as error:
        raise UsageError(f"{where} {error}") from None


def _value(kind: Any, value: Any, path: str, where: str, key: str, inner: str) -> Any:
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise UsageError(f"{where} {key!r} must be a table, got {value!r}")
        return _table(typing.cast(type, kind), value, path, inner)
    if typing.get_origin(kind) is tuple:
        length = len(typing.get_args(kind))
        if not isinstance(value, list) or len(value) != length or not all(map(_number, value)):
            raise UsageError(f"{where} {key!r} must be {length} numbers, got {value!r}")
        return tuple(float(v) for v in value)
    if kind is float and _number(value):
        return float(value)
    if kind in (int, str, bool) and type(value) is kind:
        return value
    wanted = {float: "a finite number", int: "a whole number", str: "a text", bool: "true or false"}[kind]
    raise UsageError(f"{where} {key!r} must be {wanted}, got {value!r}")


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
