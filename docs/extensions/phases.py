"""Sphinx directive `phase-diagram`: the phases of a run, from `gelflow.real.runner.phases`."""

from docutils import nodes
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


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("phase-diagram", PhaseDiagram)
    return {"parallel_read_safe": True}
