"""Grid files: a task, fixed options, lists of options, whose combinations are all trained, and seeds."""

import hashlib
import itertools
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.sweep.curves import check_column
from gelflow.policies.sweep.engines.slurm import SlurmSettings
from gelflow.policies.sweep.run import GELFLOW, Run
from gelflow.toml_tables import TomlTable, read_toml

_KEYS = ("task", "seeds", "options", "grid", "cpus", "curve", "slurm")
_FILE_NAME = r"[^\w.+=,-]"  # characters that names of files should not have
_LONGEST_NAME = 100  # characters; file systems permit 255 bytes with all suffixes


@dataclass(frozen=True)
class CommandOptions:
    """The options of `gelflow train` that a grid file may have."""

    names: Mapping[str, str]  # without the leading dashes → the value that the option sets, which may have two names
    flags: Collection[str]  # of these, the ones without a value
    reserved: Mapping[str, str]  # options that the sweep itself gives, with the reason
    check: Callable[[Sequence[str]], None]  # raises UsageError for arguments that the command refuses
    curve_columns: Callable[[Sequence[str]], Sequence[str]]  # of the learning curve of a run with these arguments


@dataclass(frozen=True)
class Grid:
    """The content of a grid file."""

    path: Path
    task: str
    seeds: tuple[int, ...]
    options: dict[str, Any]
    grid: dict[str, list[Any]]
    cpus: int
    curve: str | None  # column of the learning curves that is drawn; None: chosen by what they hold
    slurm: SlurmSettings
    flags: Collection[str]

    def runs(self, folder: Path, *, program: tuple[str, ...] = GELFLOW) -> list[Run]:
        """One run per combination and seed; `folder` is that of the sweep.

        Paths in options are relative to the folder of the grid file.
        """
        folder = folder.resolve()
        found = []
        for combination in itertools.product(*self.grid.values()):
            values = dict(zip(self.grid, combination, strict=True))
            fixed = [word for key, value in {**self.options, **values}.items() for word in self._words(key, value)]
            for seed in self.seeds:
                name = run_name({**values, "seed": seed})
                out = ["--seed", str(seed), "--out", str(folder / "runs" / name), "--json"]
                arguments = ("train", self.task, *fixed, *out)
                home = self.path.resolve().parent
                found.append(Run(name, folder, home, arguments, values, seed, self.cpus, program))
        return found

    def _words(self, key: str, value: Any) -> list[str]:
        """An option as words of a command line."""
        if key in self.flags:
            return [f"--{key}"] if value else []
        return [f"--{key}", *map(str, value if isinstance(value, list) else [value])]


def run_name(values: Mapping[str, Any]) -> str:
    """The name of a run from its values: readable, a valid file name, and different for different values."""
    text = ",".join(f"{key}={value}" for key, value in values.items())
    name = re.sub(_FILE_NAME, "_", text)[:_LONGEST_NAME]
    return name if name == text else f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def read_grid(path: Path, command: CommandOptions) -> Grid:
    """Read a grid file and check the arguments of all its runs.

    Raises UsageError that names the file, the key and the nearest valid keys.
    """
    table = TomlTable(read_toml(path), str(path)).check_keys(_KEYS)
    options, grid = table.table("options"), table.table("grid")
    for part in (options, grid):
        for key in part.data:
            if key in command.reserved:
                raise UsageError(f"{part.location}: {key!r} does not belong here; {command.reserved[key]}")
        part.check_keys(command.names)
    _check_once(path, options, grid, command.names)
    for part, values in [(options, [*options.data.items()]), (grid, _members(grid))]:
        for key, value in values:
            _check_value(part, key, value, flag=key in command.flags)
    read = Grid(
        path=path,
        task=table.string("task"),
        seeds=_seeds(table),
        options=dict(options.data),
        grid=dict(grid.data),
        cpus=table.integer("cpus", 1),
        curve=table.string("curve") if "curve" in table.data else None,
        slurm=SlurmSettings.from_table(table.table("slurm")),
        flags=command.flags,
    )
    for run in read.runs(Path("sweep")):
        try:
            command.check(run.arguments[1:])
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None
        if read.curve is not None:
            check_column(read.curve, command.curve_columns(run.arguments[1:]), f"{path}: ")
    return read


def _check_once(path: Path, options: TomlTable, grid: TomlTable, names: Mapping[str, str]) -> None:
    """Raises UsageError for an option that is given twice, in both tables or by two names."""
    used: dict[str, str] = {}
    for key in (*options.data, *grid.data):
        first = used.setdefault(names[key], key)
        if key in options.data and key in grid.data:
            raise UsageError(f"{path}: {key!r} is in [options] and in [grid]; keep one of them")
        if first != key:
            raise UsageError(f"{path}: {first!r} and {key!r} are one option; keep one of them")


def _seeds(table: TomlTable) -> tuple[int, ...]:
    seeds = table.data.get("seeds", [0])
    valid = isinstance(seeds, list) and seeds and all(type(seed) is int and seed >= 0 for seed in seeds)
    if not valid or len(set(seeds)) < len(seeds):
        raise UsageError(f"{table.location}: seeds must be a list of different integers ≥ 0, got {seeds!r}")
    return tuple(seeds)


def _members(grid: TomlTable) -> list[tuple[str, Any]]:
    """Each value of each list of `[grid]`."""
    for key, values in grid.data.items():
        if not isinstance(values, list) or not values:
            raise UsageError(f"{grid.location}: {key} must be a list of values to combine, got {values!r}")
        if any(value in values[:i] for i, value in enumerate(values)):
            raise UsageError(f"{grid.location}: {key} contains a value twice, got {values!r}")
    return [(key, value) for key, values in grid.data.items() for value in values]


def _check_value(table: TomlTable, key: str, value: Any, *, flag: bool) -> None:
    """Raise UsageError for a value that cannot be written on a command line."""
    if isinstance(value, bool) != flag:
        expected = "true or false" if flag else "a number, a text, or a list of them"
        raise UsageError(f"{table.location}: {key} must be {expected}, got {value!r}")
    members = value if isinstance(value, list) else [value]
    if not all(isinstance(member, int | float | str) for member in members):
        raise UsageError(f"{table.location}: {key} must be a number, a text, or a list of them, got {value!r}")
