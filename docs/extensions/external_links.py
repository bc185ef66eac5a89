"""Lists the external links of all pages in external_links.txt, without fetching them."""

from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata


def write_links(app: Sphinx, error: Exception | None) -> None:
    """Handler of build-finished."""
    if error is not None:
        return
    pages: dict[str, set[str]] = {}
    for page in app.env.found_docs:
        for node in app.env.get_doctree(page).findall(nodes.reference):
            address = node.get("refuri", "")
            if address.startswith(("http:", "https:")):
                pages.setdefault(address, set()).add(page)
    lines = [f"{address}  ({', '.join(sorted(pages[address]))})\n" for address in sorted(pages)]
    Path(app.outdir, "external_links.txt").write_text("".join(lines))


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the handler."""
    app.connect("build-finished", write_links)
    return {"parallel_read_safe": True}
