"""Output of the commands: text on the terminal, progress bars, JSON."""

import json
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from gelflow.session.records import to_plain


class Output:
    """Standard output of a command: text, or with `--json` one JSON object.

    With `--json` the text goes to standard error.
    """

    def __init__(self, as_json: bool = False, *, width: int | None = None) -> None:
        self.json = as_json
        # Without markup and emoji: square brackets are part of units and file names, and colons of addresses.
        self.console = Console(highlight=False, markup=False, emoji=False, stderr=self.json, width=width)

    def text(self, line: str) -> None:
        """Print one line without line breaks."""
        self.console.print(line, soft_wrap=True)

    def wide_table(self, table: Table) -> None:
        """Print a table of numbers; a narrower terminal breaks its lines, and no number is shortened."""
        needed = self.console.measure(table, options=self.console.options.update(max_width=1000)).maximum
        if needed > self.console.width:
            table.width = needed
        self.console.print(table, crop=False)

    def result(self, values: Mapping[str, Any]) -> None:
        """The result of the command. Printed with `--json` only; NaN and the infinities become strings."""
        if self.json:
            print(json.dumps(to_plain(values), indent=2, allow_nan=False))


def yes_or_no(good: bool) -> Text:
    """A cell of a table of checks: a green "ok" or a red "no"."""
    return Text("ok", style="green") if good else Text("no", style="red")


def progress_bar(*columns: ProgressColumn, count: bool = False, auto_refresh: bool = True) -> Progress:
    """A progress bar on standard error that disappears at the end; invisible unless standard error is a terminal.

    `count` shows the number of finished items; `columns` are added before the remaining time.
    """
    errors = Console(stderr=True, markup=False, emoji=False)
    counter = [MofNCompleteColumn()] if count else []
    shown = [TextColumn("{task.description}", markup=False), BarColumn(), *counter, *columns]
    return Progress(
        *shown,
        TimeRemainingColumn(),
        console=errors,
        transient=True,
        auto_refresh=auto_refresh,
        disable=not errors.is_terminal,
    )
