"""Questions at a terminal."""

import os
import pty
import sys
import threading
import time

import pytest
from rich.console import Console

from gelflow.cli.prompt import read_line


def test_keys_typed_before_a_question_do_not_answer_it(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    os.write(ours, b"\n\ny\n")
    time.sleep(0.1)  # until the terminal has passed them on
    typed = threading.Timer(0.3, os.write, (ours, b"no\n"))
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        typed.start()
        assert read_line(Console(quiet=True), "Open the fingers?") == "no"
    typed.join()
    os.close(ours)


def test_each_line_of_a_pipe_answers_one_question(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, ours = os.pipe()
    os.write(ours, b"y\nno\n")
    os.close(ours)
    with os.fdopen(theirs) as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        assert [read_line(Console(quiet=True), "Move?") for _ in range(2)] == ["y", "no"]
