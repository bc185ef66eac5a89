"""The script of the continuous integration runs every check of the Makefile."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STAGES = ("check", "test", "test-slow", "docs", "sanitize")


def test_ci_runs_every_stage_in_order() -> None:
    called = re.findall(r"^make (\S+)$", (ROOT / ".ci" / "run").read_text(), flags=re.MULTILINE)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert tuple(called) == STAGES and set(STAGES) <= set(targets)


def test_ci_stops_at_the_first_failure() -> None:
    text = (ROOT / ".ci" / "run").read_text()
    assert text.startswith("#!/usr/bin/env bash\n") and "\nset -euo pipefail\n" in text
