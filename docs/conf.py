"""Sphinx configuration: `make docs` builds the pages and the API reference into build/docs."""

import sys
from pathlib import Path

import gelflow

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "gelflow"
author = "the gelflow authors"
version = release = gelflow.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "external_links",
    "phases",
    "plain_docstrings",
    "public_names",
]
exclude_patterns = ["extensions", "**/.ipynb_checkpoints"]
root_doc = "index"
default_role = "code"  # a single backtick marks code, as in Markdown

myst_heading_anchors = 3  # links to headings, page.md#heading, are checked

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autosummary_generate = False
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"gelflow {release}"
html_show_copyright = False
