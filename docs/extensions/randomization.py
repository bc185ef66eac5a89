"""Sphinx directive `randomization-table`: the randomization tables of a task, from `gelflow.sim.tasks`."""

from docutils import nodes
from markdown_table import markdown_table
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from gelflow.sim.tasks.randomization import Distribution
from gelflow.sim.tasks.registry import randomizations


def _text(distribution: Distribution) -> str:
    values = list(vars(distribution).values())
    kind = {"LogUniform": " (log)", "Normal": " (normal: mean, std)"}.get(type(distribution).__name__, "")
    if len(set(values)) == 1:
        return f"{values[0]:g}"
    return " … ".join(f"{value:g}" for value in values) + kind


class RandomizationTable(SphinxDirective):
    """The quantities of a task with their distributions in each of its tables; the argument is the task's name."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """A table with one row for each quantity and one column for each randomization table."""
        tables = randomizations(self.arguments[0])
        rows = [("quantity", "unit", *(f'"{name}"' for name in tables), "meaning")]
        for name, quantity in next(iter(tables.values())).quantities.items():
            law = f" ({quantity.friction} law)" if quantity.friction else ""
            cells = (_text(table[name].distribution) for table in tables.values())
            rows.append((f"`{name}`", quantity.unit, *cells, quantity.meaning + law))
        return self.parse_text_to_nodes(markdown_table(rows))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("randomization-table", RandomizationTable)
    return {"parallel_read_safe": True}
