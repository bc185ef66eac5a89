"""Sphinx directive `promise-table`: the promises of the runner, from `gelflow.cli.promises.table`."""

from docutils import nodes
from markdown_table import markdown_table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from gelflow.cli.promises.table import PROMISES


class PromiseTable(SphinxDirective):
    """The table of the promises with their bounds."""

    def run(self) -> list[nodes.Node]:
        """A table with one row for each promise."""
        rows = [("name", "promise", "measured", "at most")]
        rows += [(f"`{p.name}`", p.text, p.measured, f"{p.bound:g} {p.unit}".strip()) for p in PROMISES.values()]
        return self.parse_text_to_nodes(markdown_table(rows))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("promise-table", PromiseTable)
    return {"parallel_read_safe": True}
