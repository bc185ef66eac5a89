"""Sphinx directive `public-names PACKAGE`: documents exactly the names in the package's `__all__`.

Signatures show NumPy's type aliases by their names.
"""

import inspect
import re
from importlib import import_module
from types import ModuleType

from docutils import nodes
from numpy.typing import ArrayLike
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata, stringify_annotation

NDARRAY = r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[([^\]]*)\]\]"


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
    parent = import_module(package_name.rpartition(".")[0] or package_name)
    documented = set(getattr(parent, "__all__", ())) if parent is not package else set()  # on the page of the parent
    names = [name for name in package.__all__ if not name.startswith("__") and name not in documented]
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


def name_type_aliases(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Handler of autodoc-process-signature: `ArrayLike` and `NDArray` instead of their definitions."""

    def shorten(text: str | None) -> str | None:
        if text is None:
            return None
        text = text.replace(stringify_annotation(ArrayLike, "smart"), "ArrayLike")
        return re.sub(NDARRAY, r"NDArray[\1]", text)

    return shorten(signature), shorten(returns)


class PublicNames(SphinxDirective):
    """`.. public-names:: PACKAGE`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The documentation of the package's public names."""
        return self.parse_text_to_nodes(reference(self.arguments[0]))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-signature", name_type_aliases)
    return {"parallel_read_safe": True}
