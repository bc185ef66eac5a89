"""Sphinx directives `phase-diagram` and `phase-table`: the phases of a run, from `gelflow.real.runner.phases`."""

from docutils import nodes
from markdown_table import markdown_table
from phase_svg import svg
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from gelflow.real.runner.phases import PHASES


class PhaseDiagram(SphinxDirective):
    """The diagram of the phases."""

    def run(self) -> list[nodes.Node]:
        """The picture, as part of the page."""
        return [nodes.raw("", svg(PHASES), format="html")]


class PhaseTable(SphinxDirective):
    """The table of the phases: what happens, whether the arm may move, and the reaction to contact."""

    def run(self) -> list[nodes.Node]:
        """A table with one row for each phase."""
        rows = [("phase", "what happens", "the arm may move", "reaction to contact")]
        rows += [
            (str(phase), rule.action, "yes" if rule.moves else "no", rule.on_contact) for phase, rule in PHASES.items()
        ]
        return self.parse_text_to_nodes(markdown_table(rows))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directives."""
    app.add_directive("phase-diagram", PhaseDiagram)
    app.add_directive("phase-table", PhaseTable)
    return {"parallel_read_safe": True}
