"""What the documents and `gelflow --help` promise is there: commands, make targets, links, pictures."""

import re
from pathlib import Path

import pytest

from gelflow.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = ("README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"usage: gelflow {command}" in capsys.readouterr().out


@pytest.mark.parametrize("document", DOCUMENTS)
def test_a_document_names_what_exists(document: str) -> None:
    text = (ROOT / document).read_text()
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    assert [link for link in links if not ((ROOT / document).parent / link).exists()] == []
    used = set(re.findall(r"`(?:\.venv/bin/)?gelflow ([a-z-]+)", text))
    assert used - set(COMMANDS) == set()
    targets = set(re.findall(r"\bmake ([a-z]+)\b(?=`|    |,| TORCH| PYTHON)", text))
    rules = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert targets - rules == set()
