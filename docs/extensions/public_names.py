"""Sphinx directive `public-names PACKAGE`: documents exactly the names in the package's `__all__`."""

import inspect
from importlib import import_module
from types import ModuleType

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata


def autodoc_directive(value: object) -> str:
    """The autodoc directive for a public object."""
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, BaseException) else "autoclass"
    if inspect.isroutine(value):
        return "autofunction"
    return "automodule" if isinstance(value, ModuleType) else "autodata"


def reference(package_name: str) -> str:
    """reStructuredText: a summary table of the public names, then one autodoc entry each."""
    package = import_module(package_name)
    parent_name = package_name.rpartition(".")[0]
    documented = getattr(import_module(parent_name), "__all__", ()) if parent_name else ()  # on the page of the parent
    names = [name for name in getattr(package, "__all__", ()) if not name.startswith("__") and name not in documented]
    values = {name: getattr(package, name) for name in names}
    modules = [name for name, value in values.items() if isinstance(value, ModuleType)]
    lines = [f".. automodule:: {package_name}", "   :no-members:", ""]
    lines += [".. autosummary::", "   :nosignatures:", ""]
    lines += [f"   {name}" for name in names if name not in modules] + [""]
    for name, value in values.items():
        directive = autodoc_directive(value)
        lines.append(f".. {directive}:: {package_name}.{name}")
        lines += {"autoclass": ["   :members:"], "automodule": ["   :members:"], "autodata": ["   :no-value:"]}.get(
            directive, []
        )
        lines.append("")
    return "\n".join(lines)


class PublicNames(SphinxDirective):
    """`.. public-names:: PACKAGE`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The documentation of the package's public names."""
        return self.parse_text_to_nodes(reference(self.arguments[0]))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True}
