"""The scripts and notebooks in examples/ run unchanged and print the expected output."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
LAST_LINE = {
    "film_of_an_insertion.py": r"insertion\.gif: \d attempts, inserted True",
    "fit_friction.py": r"iteration 6: mu = 0\.500\d, loss .* mm²",
    "gymnasium_loop.py": r"attempt \d+: reward -?\d+\.\d+, inserted (True|False)",
    "images_to_policy.py": r"correction: -?\d\.\d\d mm, -?\d\.\d\d mm, -?\d\.\d°",
    "mock_gripper.py": r"width 25\.0 mm, force 20\.0 N, holding",
    "own_scene.py": r" \[  0\.    0\.    0\.    0\.    0\.    0\.    0\. \]\]",
    "randomize_parameters.py": r"mu 0\.3\d, mass .* g: the box moved .* mm",
    "read_pad.py": r"box at +\d+\.\d+ mm, normal force +1\.\d+ N",
    "read_session.py": r"/left/image: image 8, \d+ bytes",
    "rollout_gradient.py": r"loss .* N², gradient by the first push .* N",
    "track_images.py": r"000008\.jpg: 100% measured, largest displacement 11\.\d+ px",
}


def run(arguments: list[str], folder: Path | None = None) -> str:
    """Standard output of a Python process without a display, in a working folder."""
    environment = os.environ | {"MPLBACKEND": "Agg"}
    result = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=120, cwd=folder
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_every_script_has_an_expected_output() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(LAST_LINE)


@pytest.mark.parametrize("script", LAST_LINE)
def test_script_runs(script: str, tmp_path: Path) -> None:
    last = run([str(EXAMPLES / script)], tmp_path).splitlines()[-1]
    assert re.fullmatch(LAST_LINE[script], last), last


def test_the_python_block_of_the_readme_runs() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    assert run(["-c", block + "assert u.grad.abs().max() > 0"]) == "torch.Size([2, 1, 130, 3])\n"


@pytest.mark.parametrize("notebook", sorted(path.name for path in EXAMPLES.glob("*.ipynb")))
def test_notebook_runs_and_contains_its_pictures(notebook: str) -> None:
    cells = [cell for cell in json.loads((EXAMPLES / notebook).read_text())["cells"] if cell["cell_type"] == "code"]
    sources = ["".join(cell["source"]) for cell in cells]
    run(["-c", "\n".join(sources)])
    for cell, source in zip(cells, sources, strict=True):
        pictures = [output for output in cell["outputs"] if "image/png" in output.get("data", {})]
        assert len(pictures) == source.count("plt.show()")


def test_the_examples_page_lists_every_example() -> None:
    page = (ROOT / "docs" / "guide" / "examples.md").read_text()
    listed = set(re.findall(r"\]\(\.\./\.\./examples/([\w.]+)\)", page))
    assert listed == {path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")}
