"""Reads and writes lab files."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.real.runner.lab import FORMAT, Lab
from gelflow.toml_tables import TomlTable, read_toml, toml_value

_RENAMED_KEYS = {"clock_pace": "time_sync"}


def load_lab(path: str | Path) -> Lab:
    """Read a lab file. Raises UsageError, in one line that names the file and the key."""
    path = Path(path)
    table = TomlTable(read_toml(path), str(path))
    if (version := table.integer("format")) != FORMAT:
        raise UsageError(f"{path}: lab file format {version}; this gelflow reads format {FORMAT}")
    return _with_files(table.as_dataclass(Lab, renamed=_RENAMED_KEYS), path)


def _with_files(lab: Lab, path: Path) -> Lab:
    """`lab` with absolute paths of calibrations and gels; reads each of them once, so that errors show early."""
    cameras = {}
    for name in ("left", "right"):
        camera = getattr(lab.cameras, name)
        files = {key: getattr(camera, key) for key in ("calibration", "gel")}
        absolute = {key: str((path.parent / file).resolve()) for key, file in files.items() if file}
        camera = dataclasses.replace(camera, **absolute)
        try:
            _ = camera.mount, camera.elastic_gel
        except UsageError as error:
            raise UsageError(f"{path}, cameras.{name}: {error}") from None
        cameras[name] = camera
    return dataclasses.replace(lab, cameras=dataclasses.replace(lab.cameras, **cameras))


def save_lab(lab: Lab, path: str | Path, *, title: str) -> None:
    """Write a lab file with every key, atomically. Raises UsageError when it cannot be written."""
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
                lines.append(f"{field.name} = {toml_value(value)}")
    partial = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise UsageError(f"cannot write {path}: {error.strerror}") from None
