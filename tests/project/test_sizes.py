"""Limits that keep the code readable: files per folder, lines per file, lines per function."""

import ast
import re
import subprocess
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FILES_PER_FOLDER, LINES_PER_FILE, LINES_PER_FUNCTION = 15, 400, 60
CODE = (".py", ".pyi", ".cpp", ".hpp")

# Exceptions, each with its reason.
LARGE_FILES = {"sim/_core.pyi": "the types of one compiled module"}
LONG_FUNCTIONS: dict[str, str] = {}


def tracked() -> list[Path]:
    """The files of the repository, new ones included."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [path for path in map(Path, names) if (ROOT / path).is_file() and not (ROOT / path).is_symlink()]


def code() -> list[Path]:
    return [path for path in tracked() if path.suffix in CODE]


def python_functions(path: Path) -> list[tuple[str, int]]:
    """Name and number of lines of each function."""
    nodes = ast.walk(ast.parse((ROOT / path).read_text()))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    return [(node.name, (node.end_lineno or node.lineno) - node.lineno + 1) for node in functions]


def cpp_functions(path: Path) -> list[tuple[str, int]]:
    """Name and number of lines of each function, found by the indentation that clang-format gives."""
    found: list[tuple[str, int]] = []
    opened: list[tuple[int, str, int]] = []  # indentation, head and line number of each open block
    head, indent, start = "", 0, 0
    for number, line in enumerate((ROOT / path).read_text().splitlines()):
        text = line.strip()
        if text.startswith("}"):
            while opened and opened[-1][0] >= len(line) - len(line.lstrip()):
                _, block, first = opened.pop()
                name = re.search(r"([\w:~]+|operator\S+)\(", block)
                if name and not re.match(r"(}|if|for|while|switch|namespace|struct|class|enum|extern)\b", block):
                    found.append((name[1], number - first + 1))
        if not head:
            indent, start = len(line) - len(line.lstrip()), number
        if text.startswith(("#", "//")) or text.endswith((";", "}", ":")):
            head = ""
        elif text.endswith("{"):
            opened.append((indent, f"{head} {text}".strip(), start))
            head = ""
        else:
            head = f"{head} {text}".strip()
    return found


def test_no_folder_holds_too_many_files() -> None:
    leaves = ("tests/", "benchmarks/results", "docs/pictures")
    counts = Counter(path.parent for path in tracked() if not str(path).startswith(leaves))
    scenes = Path("sim/scenes")
    assert {str(folder): n for folder, n in counts.items() if n > FILES_PER_FOLDER and folder != scenes} == {}


def test_no_code_file_is_too_long() -> None:
    lengths = {str(path): len((ROOT / path).read_text().splitlines()) for path in code()}
    assert {name: n for name, n in lengths.items() if n > LINES_PER_FILE and name not in LARGE_FILES} == {}


def test_no_function_is_too_long() -> None:
    long = {
        f"{path}:{name}": lines
        for path in code()
        for name, lines in (python_functions(path) if path.suffix in (".py", ".pyi") else cpp_functions(path))
        if lines > LINES_PER_FUNCTION
    }
    assert {name: n for name, n in long.items() if name not in LONG_FUNCTIONS} == {}
    assert len(LARGE_FILES) + len(LONG_FUNCTIONS) <= 5


def test_the_count_of_lines_sees_functions_of_both_languages() -> None:
    found = {name for path in code() if path.suffix == ".hpp" for name, _ in cpp_functions(path)}
    assert len(found) > 100
    assert {"code", "cpp_functions"} <= {name for name, _ in python_functions(Path(__file__).relative_to(ROOT))}
