"""Converts docstrings to reStructuredText.

Docstrings are plain text with Markdown code spans and NumPy-style section headings. The comments behind the fields of a
dataclass are added to the docstring of the class.
"""

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize

from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

CODE_SPAN = re.compile(r"(`+)(.+?)\1", re.DOTALL)
UNDERLINE = re.compile(r"-{3,}")
LIST_ITEM = re.compile(r"(?:[-*•]|\d+\.) ")
ENTRY = re.compile(r"(\*{0,2}\w+(?:, \w+)*) ?: (.*)")


def escape(text: str) -> str:
    """Keep code spans and escape all other characters that have a meaning in reStructuredText."""

    def outside(part: str) -> str:
        return re.sub(r"([*|`]|_(?!\w))", r"\\\1", part.replace("\\", "\\\\"))

    pieces, start = [], 0
    for match in CODE_SPAN.finditer(text):
        # Backslash-space ends inline markup inside a word, as in `x`².
        pieces += [outside(text[start : match.start()]), f"\\ ``{match.group(2)}``\\ "]
        start = match.end()
    return "".join([*pieces, outside(text[start:])])


def is_section(block: list[str]) -> bool:
    """Whether the block starts with a heading and its underline."""
    return len(block) > 1 and UNDERLINE.fullmatch(block[1]) is not None


def blocks(lines: list[str]) -> list[list[str]]:
    """Split at blank lines, and where the indentation changes between unindented text and an indented block."""
    result: list[list[str]] = [[]]
    for line in lines:
        if not line.strip():
            result.append([])
            continue
        block = result[-1]
        splits = LIST_ITEM.match(line) or line.startswith(" ") != block[0].startswith(" ") if block else False
        if splits and not is_section([*block, line]) and not LIST_ITEM.match(block[0]):
            result.append([])
        result[-1].append(line)
    return [block for block in result if block]


def entries(block: list[str], directive: str) -> list[str]:
    """A block of a section, one field or list item per entry."""
    result: list[str] = []
    for line in block:
        if match := ENTRY.fullmatch(line):
            result.append(directive.format(match.group(1)) + escape(match.group(2)))
        elif result:
            result.append("  " + escape(line.strip()))
        else:
            result.append("- " + escape(line))
    return result


def to_restructured_text(lines: list[str]) -> list[str]:
    """The docstring `lines` as reStructuredText."""
    result: list[str] = []
    for block in blocks(lines):
        if is_section(block):
            heading, body = block[0], block[2:]
            if heading != "Parameters":
                result += [f".. rubric:: {heading}", ""]
            result += entries(body, ":param {}: " if heading == "Parameters" else "- ``{}``: ")
        elif block[0].startswith(" "):  # an equation or a table
            result += ["::", "", *block]
        else:
            result += escape("\n".join(block)).split("\n")
        result.append("")
    return result


def field_comments(cls: type) -> dict[str, str]:
    """The comment behind each field in the source of a dataclass."""
    source = textwrap.dedent(inspect.getsource(cls))
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.ClassDef)
    comments = {
        token.start[0]: token.string.lstrip("#: ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    return {
        node.target.id: comments[node.end_lineno]
        for node in definition.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.end_lineno in comments
    }


def process(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Handler of autodoc-process-docstring."""
    lines[:] = to_restructured_text(lines)
    if what in ("class", "exception") and inspect.isclass(obj) and dataclasses.is_dataclass(obj):
        lines += [*(f"- ``{field}``: {escape(text)}" for field, text in field_comments(obj).items()), ""]


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the handler."""
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}
