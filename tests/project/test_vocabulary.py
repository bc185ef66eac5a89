"""The field's own terms: identifiers and phrases that were replaced by a standard term do not come back."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = (".py", ".pyi", ".cpp", ".hpp", ".md", ".toml", ".xml", ".ipynb")

# Pattern → the term to use. Patterns ignore case unless they contain a capital letter.
REPLACED = {
    r"near[_ ]points?": "broad phase, candidate points",
    r"(for_)?touching_points|Touching": "contact points, ContactPack",
    r"\bfelt\b|\bfeels?\b": "contact force, tactile force",
    r"pair_columns": "contact Jacobian",
    r"\bLanes\b": "SimdPack",
    r"arc_lever|arc_moments": "arc correction",
    r"_transposed\b": "_vjp",
    r"softness|from_softer": "continuation factor",
    r"Found::|\bMover\b": "CacheState, MotionExecutor",
    r"\bnewborn|nursery": "reset pool",
    r"\btwins?\b": "converged reference",
    r"left[_ ]out\b": "not modelled, omitted",
    r"\bbow\b|\bbent\b": "curvature, Hessian",
    r"\bjudges?\b|StartRefused": "metrics, TrackerInitError",
    r"\bsays? of\b|\b(is|are) told\b|\bbut for\b|\blooks? out\b|\bat hand\b": "a plain clause",
    r"\b(ca|do|does|is|are|was|wo|did)n't\b": "the words in full",
    r"(^ *# |// |\"\"\")(What|Who|Whose|Whoever|Whatever) ": "a sentence that starts with its subject",
}


def texts() -> list[tuple[str, str]]:
    """Name and content of each tracked text file, the changelog and this list excepted."""
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    skip = ("CHANGELOG.md", "docs/reference/module_moves.md", str(Path(__file__).relative_to(ROOT)))
    files = [name for name in names if name.endswith(SUFFIXES) and name not in skip and (ROOT / name).is_file()]
    return [(name, (ROOT / name).read_text()) for name in files if not (ROOT / name).is_symlink()]


@pytest.mark.parametrize("pattern", REPLACED)
def test_replaced_words_do_not_come_back(pattern: str) -> None:
    flags = re.MULTILINE | (0 if re.search("[A-Z]", pattern) else re.IGNORECASE)
    found = [
        f"{name}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]!r}"
        for name, text in texts()
        for match in re.finditer(pattern, text, flags)
    ]
    assert found == [], f"use instead: {REPLACED[pattern]}"
