"""The documents agree with the project: commands parse, code compiles, imports, links and paths resolve."""

import argparse
import ast
import importlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from gelflow.cli.main import COMMANDS, command_module, main

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = ("README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")))
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?:    .*\n|\n(?=    ))+")
TOP_FOLDERS = r"(?:src|sim|perception|policies|real|hardware_mocks|tests|benchmarks|examples|docs)"


def fenced(document: str, language: str) -> list[str]:
    """Contents of the fenced blocks of a language."""
    return [body for name, body in FENCE.findall((ROOT / document).read_text()) if name == language]


def code_spans(document: str) -> list[str]:
    """Inline code outside blocks, with line breaks as spaces."""
    text = INDENTED.sub("\n", FENCE.sub("\n", (ROOT / document).read_text()))
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]


def shell_lines(document: str) -> Iterator[list[str]]:
    """Words of every shell command in a block; a backslash continues a line, # starts a comment."""
    text = (ROOT / document).read_text()
    blocks = [*INDENTED.findall(FENCE.sub("\n", text)), *fenced(document, ""), *fenced(document, "sh")]
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        if re.match(r"\s*(?:\.venv/bin/)?(?:gelflow|python|make|pip) ", line):
            yield shlex.split(line.strip().removeprefix(".venv/bin/"), comments=True)


def command_parser(command: str) -> argparse.ArgumentParser:
    """The argument parser of a sub-command."""
    parser = argparse.ArgumentParser(prog=f"gelflow {command}")
    command_module(command).configure(parser)
    return parser


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"usage: gelflow {command}" in capsys.readouterr().out


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_in_blocks_parse(document: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    rules = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for program, *arguments in shell_lines(document):
        if program == "gelflow":
            assert arguments[0] in COMMANDS
            command_parser(arguments[0]).parse_args(arguments[1:])  # exits when an argument is wrong
        elif program == "make":
            assert {argument for argument in arguments if "=" not in argument} <= rules


@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_in_sentences_exist(document: str) -> None:
    rules = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for span in code_spans(document):
        words = span.removeprefix(".venv/bin/").split()
        if words[0] == "make" and len(words) > 1:
            assert words[1] in rules
        if words[0] == "gelflow" and len(words) > 1 and words[1] != "COMMAND":
            assert words[1] in COMMANDS
            known = {option for action in command_parser(words[1])._actions for option in action.option_strings}
            assert {word.split("=")[0] for word in words if word.startswith("--")} <= known


@pytest.mark.parametrize("document", DOCUMENTS)
def test_python_blocks_compile_and_their_imports_resolve(document: str) -> None:
    for block in fenced(document, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    importlib.import_module(alias.name)
            elif isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module or "")
                assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@pytest.mark.parametrize("document", DOCUMENTS)
def test_toml_blocks_parse(document: str) -> None:
    for block in fenced(document, "toml"):
        for part in re.split(r"\n(?=gel = )", block):  # alternatives for one key
            tomllib.loads(part)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_dotted_names_exist(document: str) -> None:
    schemas = (ROOT / "src" / "gelflow" / "session" / "channels.py").read_text()  # of recorded messages
    for name in set(re.findall(r"`(gelflow(?:\.\w+)+)", (ROOT / document).read_text())):
        if f'"{name}"' in schemas:
            continue
        words = name.split(".")
        for length in range(len(words), 0, -1):
            try:
                value = importlib.import_module(".".join(words[:length]))
            except ModuleNotFoundError:
                continue
            break
        for word in words[length:]:
            assert hasattr(value, word), name
            value = getattr(value, word)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_resolve(document: str) -> None:
    path = ROOT / document
    text = FENCE.sub("\n", path.read_text())
    for link, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", text):
        target = path.parent / link if link else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_named_paths_exist(document: str) -> None:
    text = (ROOT / document).read_text()
    paths = set(re.findall(rf"(?<![\w/.-]){TOP_FOLDERS}/[\w./-]*\w", text))
    written = {"benchmarks/results/tradeoff_SCENE.json"}
    assert [path for path in sorted(paths - written) if not (ROOT / path).exists()] == []


def test_every_page_is_part_of_the_site() -> None:
    index = {folder: (ROOT / folder / "index.md").read_text() for folder in ("docs", "docs/reference/api")}
    for path in (ROOT / "docs").rglob("*.[mr][ds]*"):
        page = path.relative_to(ROOT)
        folder = "docs/reference/api" if page.match("docs/reference/api/gelflow*") else "docs"
        name = str(page.relative_to(folder).with_suffix("")) if page.suffix == ".md" else page.name.removesuffix(".rst")
        assert page == Path("docs/index.md") or re.search(rf"^{re.escape(name)}$", index[folder], re.MULTILINE), page


def test_new_imports_of_moved_names_resolve() -> None:
    page = (ROOT / "docs" / "reference" / "module_moves.md").read_text()
    rows = re.findall(r"^\| `from \S+ import [^`]+` \| `from (\S+) import ([^`]+)` \|$", page, re.MULTILINE)
    assert len(rows) >= 20
    for module, names in rows:
        assert [name for name in names.split(", ") if not hasattr(importlib.import_module(module), name)] == [], module
