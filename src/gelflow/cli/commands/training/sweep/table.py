"""The table of results that `gelflow sweep` prints."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from gelflow.policies.sweep.results import option_columns

if TYPE_CHECKING:
    from gelflow.policies.sweep.results import Configuration, Range


_FIRST = ("success", "reward")  # of the results, where not all fit


def summary_table(found: Sequence["Configuration"], console: Console) -> Table:
    """Options, complete runs and results of the configurations, with as many results as fit the console."""
    names = list(dict.fromkeys(name for configuration in found for name in configuration.results))
    names.sort(key=lambda name: name.split(".")[-1] not in _FIRST)
    view = _table(found, [])
    for count in range(len(names), 0, -1):
        wider = _table(found, names[:count])
        if Measurement.get(console, console.options.update(max_width=10_000), wider).maximum <= console.width:
            return wider
    return view


def _table(found: Sequence["Configuration"], names: Sequence[str]) -> Table:
    """The table with the results `names`."""
    title = "median (smallest to largest) over the seeds"
    view = Table(title=title if names else None, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for option in option_columns(found[0].values):
        view.add_column(option, overflow="ellipsis", no_wrap=True)
    view.add_column("complete", justify="right", no_wrap=True)
    last_parts = [name.split(".")[-1] for name in names]
    for name, last in zip(names, last_parts, strict=True):
        view.add_column(last if last_parts.count(last) == 1 else name, justify="right", no_wrap=True)
    for configuration in found:
        cells = [_range(configuration.results.get(name)) for name in names]
        complete = f"{configuration.complete} of {configuration.runs}"
        view.add_row(*map(str, configuration.values.values()), complete, *cells)
    return view


def _range(value: "Range | None") -> str:
    if value is None:
        return ""
    return f"{value.median:.4g}" + ("" if value.low == value.high else f" ({value.low:.4g} to {value.high:.4g})")
