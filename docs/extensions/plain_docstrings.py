"""Docstrings are plain text with Markdown code spans: this extension makes valid reStructuredText of them.

Fields of dataclasses are described by the comment behind them; they are added to the docstring of their class.
"""

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterable, Iterator

from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

BEFORE_NAPOLEON = 400  # priority; napoleon has 500
CODE_SPAN = re.compile(r"(`+)(.+?)\1", re.DOTALL)
UNDERLINE = re.compile(r"^\s*-{3,}\s*$")
LIST_ITEM = re.compile(r"^\s*(?:[-*•]|\d+\.) ")


def escape(text: str) -> str:
    """Plain text as reStructuredText: code spans are kept, characters with a meaning are escaped."""

    def outside(part: str) -> str:
        part = part.replace("\\", "\\\\")
        return re.sub(r"([*|`]|_(?!\w))", r"\\\1", part)

    pieces, start = [], 0
    for match in CODE_SPAN.finditer(text):
        # Backslash-space ends inline markup inside a word, as in `x`².
        pieces += [outside(text[start : match.start()]), f"\\ ``{match.group(2)}``\\ "]
        start = match.end()
    return "".join([*pieces, outside(text[start:])])


def indent_of(line: str) -> int:
    """Number of leading spaces."""
    return len(line) - len(line.lstrip())


def with_literal_blocks(lines: list[str]) -> Iterator[str]:
    """Indented lines, such as equations, become literal blocks; the lines of list items stay."""
    in_block, in_list = False, False
    for line in lines:
        indented = indent_of(line) > 0
        if not line.strip():
            yield ""
            continue
        if LIST_ITEM.match(line) and not in_block:
            if not in_list:
                yield ""
            in_list = True
        elif not indented:
            if in_block or (in_list and not in_block):
                yield ""
            in_block = in_list = False
        elif not in_list and not in_block:
            yield from ("", "::", "")
            in_block = True
        yield line


def to_restructured_text(lines: list[str]) -> list[str]:
    """A docstring as reStructuredText; sections such as "Parameters" are left to napoleon."""
    section = next((i - 1 for i, line in enumerate(lines) if UNDERLINE.match(line) and i), len(lines))
    return escape_outside_blocks(with_literal_blocks(lines[:section])) + escape("\n".join(lines[section:])).split("\n")


def escape_outside_blocks(lines: Iterable[str]) -> list[str]:
    """Escape everything except the contents of literal blocks."""
    result: list[str] = []
    pending: list[str] = []
    in_block = False
    for line in lines:
        if in_block and (not line.strip() or indent_of(line) > 0):
            result.append(line)
            continue
        in_block = False
        if line == "::":
            result += [*escape("\n".join(pending)).split("\n"), line]
            pending, in_block = [], True
        else:
            pending.append(line)
    return result + escape("\n".join(pending)).split("\n")


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
    fields = [node for node in definition.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)]
    return {
        node.target.id: comments.get(node.end_lineno or 0, "") for node in fields if isinstance(node.target, ast.Name)
    }


def process(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Handler of autodoc-process-docstring."""
    lines[:] = to_restructured_text(lines)
    if what in ("class", "exception") and inspect.isclass(obj) and dataclasses.is_dataclass(obj):
        described = {field: text for field, text in field_comments(obj).items() if text}
        if described:
            lines += ["", *(f"- ``{field}``: {escape(text)}" for field, text in described.items()), ""]


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the handler."""
    app.connect("autodoc-process-docstring", process, priority=BEFORE_NAPOLEON)
    return {"parallel_read_safe": True}
