"""Command-line options that several commands share. An option has the same meaning in every command."""

import argparse
import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.part import CUBOID
from gelflow.task import INSERTION, InsertionTask

DEFAULT_RANDOMIZATION = "default"
_LARGEST_INTEGER = 2**31 - 1  # of the core and of array sizes
_PAGE_ADDRESS = {"port": 8080, "host": "127.0.0.1"}  # options of a page and their defaults


def add_json(parser: argparse.ArgumentParser) -> None:
    """`--json`: the result as one JSON object on standard output."""
    parser.add_argument(
        "--json", action="store_true", help="print the result as one JSON object; all other output goes to stderr"
    )


def add_out(parser: argparse.ArgumentParser, text: str, *, default: Path | None = None, folder: bool = False) -> None:
    """`--out`: the file or folder that the command writes."""
    shown = "" if default is None else f" (default {default})"
    parser.add_argument("--out", type=Path, default=default, metavar="DIR" if folder else "FILE", help=text + shown)


def is_taken(file: Path) -> bool:
    """Whether a file, folder or link has this name. Raises OSError for a name that is too long."""
    try:
        file.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def check_new_file(file: Path, *, suffixes: tuple[str, ...] = ()) -> None:
    """Raise UsageError where no new file can be `file`: it exists, its folder does not, or its suffix is another one.

    `suffixes` are in lower case; without them any suffix is allowed.
    """
    if suffixes and file.suffix.lower() not in suffixes:
        raise UsageError(f"--out {file}: the suffix must be one of {', '.join(suffixes)}")
    if is_taken(file):
        raise UsageError(f"{file} exists; name a new file with --out")
    if not file.parent.is_dir():
        raise UsageError(f"{file}: the folder {file.parent} does not exist")


@contextlib.contextmanager
def removed_on_error(*files: Path) -> Iterator[None]:
    """Delete the new files that the context created if it raises: the same command can then be repeated."""
    new = [file for file in files if not os.path.lexists(file)]
    try:
        yield
    except BaseException:
        for file in new:
            with contextlib.suppress(OSError):
                file.unlink()
        raise


def delete_empty(files: Sequence[Path]) -> list[Path]:
    """Delete new files without contents, as a full disk leaves them; the files that remain."""
    for file in files:
        if file.is_file() and not file.stat().st_size:
            file.unlink()
    return [file for file in files if file.is_file()]


def picture_beside(file: Path) -> Path:
    """The new picture beside the new file of `--out`. Raises UsageError where one of them cannot be a new file."""
    check_new_file(file)
    picture = file.with_suffix(".png")
    if file.suffix.lower() == picture.suffix:
        raise UsageError(f"--out {file}: the picture beside the result gets this name; give the result another suffix")
    check_new_file(picture)
    return picture


def add_seed(parser: argparse.ArgumentParser, *, default: int = 0) -> None:
    """`--seed`: determines every random number."""
    parser.add_argument(
        "--seed", type=int, default=default, metavar="N", help="determines every random number (default %(default)s)"
    )


def add_preset(parser: argparse.ArgumentParser) -> None:
    """`--preset`: accuracy of the simulation."""
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help="accuracy of the simulation: fast, balanced, accurate (default: the scene's own settings)",
    )


def add_quick(parser: argparse.ArgumentParser) -> None:
    """`--quick`: a short run."""
    parser.add_argument("--quick", action="store_true", help="a short run: fewer or smaller cases, fewer repeats")


def add_repeats(parser: argparse.ArgumentParser, text: str, *, default: int | None = None) -> None:
    """`--repeats`: number of timed runs."""
    parser.add_argument("--repeats", type=int, default=default, metavar="N", help=text)


def add_checkpoint(parser: argparse.ArgumentParser, *, default: str = "the included policy") -> None:
    """`--checkpoint`: the policy."""
    parser.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help=f"checkpoint of the policy (default: {default})"
    )


def add_part(parser: argparse._ActionsContainer, text: str = "part to insert", *, default: str = "the cuboid") -> None:
    """`--part`: the part; `text` and `default` describe its use."""
    parser.add_argument(
        "--part",
        metavar="PART",
        help=f"{text}: a part file, or the name of a part of gelflow, such as peg (default: {default})",
    )


def add_randomization(
    parser: argparse.ArgumentParser, *, default: str | None = DEFAULT_RANDOMIZATION, text: str = DEFAULT_RANDOMIZATION
) -> None:
    """`--randomization`: the distribution of the physical parameters. `text` describes the default."""
    parser.add_argument(
        "--randomization",
        default=default,
        metavar="NAME",
        help="physical parameters: default, full, which adds deviations of real pads, or another table of the task, "
        f"such as nominal of the insertion (default {text})",
    )


def part_task(part: str | None) -> InsertionTask:
    """The insertion of the part that `--part` names. Raises UsageError when its file is missing or invalid."""
    if part is None:
        return INSERTION
    from gelflow.sim.tasks.parts import load_part

    return load_part(part)


def checkpoint_for(task: InsertionTask, given: Path | None) -> Path:
    """The checkpoint `given` by `--checkpoint`, else the one of the task's part that comes with gelflow.

    Raises UsageError when none comes with gelflow.
    """
    from gelflow.policies.checkpoint import default_checkpoint

    default = default_checkpoint()
    path = given or (default if task.part == CUBOID else default.parent / f"{task.part.name}.safetensors")
    if given is None and not path.exists():
        raise UsageError(
            f"no policy for part {task.part.name!r} comes with gelflow; train one with gelflow train insertion --part, "
            "then give --checkpoint"
        )
    return path


def add_profile(parser: argparse.ArgumentParser) -> None:
    """`--profile`: the sensor."""
    parser.add_argument(
        "--profile",
        default="generic",
        metavar="NAME",
        help="sensor: gelsight-mini, gelslim-3, or a .toml file with image size, crop and print (default %(default)s)",
    )


def picture_size(text: str) -> tuple[int, int]:
    """Width and height [px] of a `--size` such as 640x480. Raises UsageError for another text."""
    size = re.fullmatch(r"(\d+)x(\d+)", text)
    if size is None:
        raise UsageError(f"--size must be width x height in pixels, as 640x480; got {text!r}")
    return int(size[1]), int(size[2])


def check_at_least(args: argparse.Namespace, **limits: int) -> None:
    """Raise UsageError for the first option below its limit, or above 32 bits except a seed; None is skipped."""
    for name, limit in limits.items():
        value = getattr(args, name)
        if value is not None and not value >= limit:
            raise UsageError(f"--{name.replace('_', '-')} must be at least {limit}, got {value}")
        if value is not None and name != "seed" and value > _LARGEST_INTEGER:
            raise UsageError(f"--{name.replace('_', '-')} must be at most {_LARGEST_INTEGER}, got {value}")


def add_page_address(parser: argparse.ArgumentParser, *, of: str = "") -> None:
    """`--port` and `--host`: the address of a page."""
    parser.add_argument(
        "--port",
        type=int,
        default=_PAGE_ADDRESS["port"],
        metavar="P",
        help=f"TCP port{of}; 0: a free one (default %(default)s)",
    )
    parser.add_argument(
        "--host",
        default=_PAGE_ADDRESS["host"],
        metavar="H",
        help=f"address to serve on{of}; other machines reach 0.0.0.0 and need the token in the printed address "
        "(default %(default)s)",
    )


def check_page_address(args: argparse.Namespace, page: str) -> None:
    """Raise UsageError when `--port` or `--host` is given without the option `page` that serves the page."""
    for name, default in _PAGE_ADDRESS.items():
        if getattr(args, name) != default and not getattr(args, page):
            raise UsageError(f"--{name} is for the page of --{page}; add --{page}")


def add_view(parser: argparse.ArgumentParser) -> None:
    """`--view` and its address: a page that shows the run while it happens."""
    parser.add_argument(
        "--view", action="store_true", help="show the run in the browser while it happens, with a stop button"
    )
    add_page_address(parser, of=" of --view")
