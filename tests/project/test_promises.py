"""Every promise of the runner has a scenario, a bound, and tests that exist."""

import ast
import math
from pathlib import Path

import pytest

from gelflow.mock_lab.promises.outcome import Promise
from gelflow.mock_lab.promises.table import PROMISES

ROOT = Path(__file__).resolve().parents[2]


def functions(file: str) -> set[str]:
    """Names of the test functions of a file."""
    tree = ast.parse((ROOT / file).read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("promise", PROMISES.values(), ids=lambda promise: promise.name)
def test_every_promise_names_tests_that_exist(promise: Promise) -> None:
    assert promise.tests
    for test in promise.tests:
        file, name = test.split("::")
        assert name in functions(file), test
    assert math.isfinite(promise.bound) and promise.text and promise.measured


def test_the_documentation_states_that_this_is_not_safety_rated() -> None:
    for page in ("docs/guide/robot.md", "docs/guide/arm.md", "README.md"):
        text = " ".join((ROOT / page).read_text().split()).lower()
        assert "not a safety-rated" in text or "no safety-rated" in text, page
