"""Project layout: linked folders, import rules, contents of a wheel, pinned versions."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import importlinter
import pytest

import gelflow

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("sim", "perception", "policies", "real", "hardware_mocks")
TOOLS = Path(sys.executable).parent


def project() -> dict[str, object]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_is_linked_into_the_package(folder: str) -> None:
    link = ROOT / "src" / "gelflow" / folder
    assert link.is_symlink()
    assert not link.readlink().is_absolute()
    assert link.resolve() == ROOT / folder
    assert (ROOT / folder / "__init__.py").is_file()


def test_the_tests_import_this_source_tree() -> None:
    assert Path(gelflow.__file__).resolve() == ROOT / "src" / "gelflow" / "__init__.py"


@pytest.mark.parametrize("folder", FOLDERS)
@pytest.mark.parametrize("form", ["import {0}", "import {0}.thing as thing", "from {0} import thing"])
def test_a_bare_import_is_a_lint_error(folder: str, form: str) -> None:
    source = form.format(folder) + "\n"
    command = [str(TOOLS / "ruff"), "check", "--select=TID", "--output-format=concise", "--stdin-filename=tests/x.py"]
    result = subprocess.run([*command, "-"], input=source, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 1
    assert f"TID251 `{folder}` is banned: write gelflow.{folder}" in result.stdout


@pytest.fixture(scope="module")
def skeleton(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Empty modules with the names of the package, and the project's import rules: only imports of a test can fail."""
    top = tmp_path_factory.mktemp("skeleton")
    shutil.copy(ROOT / "pyproject.toml", top)
    for folder in (*FOLDERS, "src/gelflow"):
        for module in (ROOT / folder).rglob("*.py"):  # does not follow the links in src/gelflow
            target = top / module.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.touch()
    for name in FOLDERS:
        (top / "src" / "gelflow" / name).symlink_to(f"../../{name}")
    return top


ALLOWED = [
    ("sim", "gelflow.task"),
    ("policies", "gelflow.sim"),
    ("real", "gelflow.perception"),
    ("hardware_mocks", "gelflow.sim"),
    ("hardware_mocks", "gelflow.real.wsg.codec"),
    ("hardware_mocks", "gelflow.perception.synthetic.fast_renderer"),
    ("src/gelflow/cli", "gelflow.real.wsg.driver"),
    ("src/gelflow/cli", "gelflow.policies"),
    ("src/gelflow/cli", "gelflow.hardware_mocks"),
    ("src/gelflow/cli", "gelflow.view"),
    ("src/gelflow/cli", "gelflow.mock_lab"),
    ("src/gelflow/mock_lab", "gelflow.real.wsg.driver"),
    ("src/gelflow/mock_lab", "gelflow.hardware_mocks"),
    ("src/gelflow/view", "gelflow.sim"),
]
REFUSED = [
    ("src/gelflow/session", "gelflow.sim"),
    ("src/gelflow/session", "gelflow.perception"),
    ("sim", "gelflow.policies"),
    ("sim", "gelflow.perception"),
    ("perception", "gelflow.sim"),
    ("policies", "gelflow.real.wsg.driver"),
    ("policies", "gelflow.perception"),
    ("real", "gelflow.sim"),
    ("real", "gelflow.policies"),
    ("real", "gelflow.hardware_mocks"),
    ("hardware_mocks", "gelflow.real.wsg.driver"),
    ("hardware_mocks", "gelflow.perception"),
    ("hardware_mocks", "gelflow.perception.tracker"),
    ("src/gelflow/mock_lab", "gelflow.policies"),
    ("src/gelflow/mock_lab", "gelflow.cli"),
    ("real", "gelflow.mock_lab"),
    ("sim", "gelflow.cli"),
    ("sim", "gelflow.view"),
    ("sim/scene", "gelflow.sim.simulator"),
    ("sim/tasks", "gelflow.sim.benchmark"),
    ("real/wsg", "gelflow.real.runner.lab"),
    ("real/egm", "gelflow.real.wsg.driver"),
    ("hardware_mocks/wsg", "gelflow.hardware_mocks.simulated_cell"),
]


def lint_imports(skeleton: Path, edges: list[tuple[str, str]]) -> subprocess.CompletedProcess[str]:
    for folder in {folder for folder, _ in edges}:
        lines = [f"import {target}\n" for source, target in edges if source == folder]
        (skeleton / folder / "edge.py").write_text("".join(lines))
    # -S disables the import hook of the editable install, which would import this tree.
    code = (
        f"import sys; sys.path[:0] = ['src', {str(Path(importlinter.__file__).parents[1])!r}]; "
        "from importlinter.cli import lint_imports; "
        "sys.exit(lint_imports(config_filename='pyproject.toml', no_cache=True))"
    )
    command = [sys.executable, "-S", "-c", code]
    result = subprocess.run(command, cwd=skeleton, capture_output=True, text=True)
    for folder in {folder for folder, _ in edges}:
        (skeleton / folder / "edge.py").unlink()
    return result


def test_permitted_imports_pass(skeleton: Path) -> None:
    result = lint_imports(skeleton, ALLOWED)
    assert result.returncode == 0, result.stdout + result.stderr


def test_other_imports_fail(skeleton: Path) -> None:
    result = lint_imports(skeleton, REFUSED)
    assert result.returncode == 1, result.stdout + result.stderr
    for folder, target in REFUSED:
        source = folder.removeprefix("src/gelflow/").replace("/", ".")
        assert f"gelflow.{source}.edge -> {target} " in result.stdout


def test_a_wheel_contains_data_and_no_c_sources(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    skip = shutil.ignore_patterns(
        ".git", ".venv", "build", "dist", "out", "sessions", "runs", "__pycache__", ".*_cache"
    )
    shutil.copytree(ROOT, tree, symlinks=True, ignore=skip)
    (tree / "sim" / "_core.stale.so").touch()  # leftovers of development must not be packaged
    command = [sys.executable, "-m", "pip", "wheel", "--no-index", "--no-deps", "--no-build-isolation", "-q"]
    subprocess.run(
        [*command, "--config-settings=wheel.cmake=false", "-w", tmp_path, tree], check=True, capture_output=True
    )
    (wheel,) = tmp_path.glob("gelflow-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = {name.removeprefix("gelflow/") for name in archive.namelist()}
    wanted = {str(p.relative_to(ROOT)) for f in FOLDERS for p in (ROOT / f).rglob("*") if p.is_file()}
    wanted |= {str(p.relative_to(ROOT / "src/gelflow")) for p in (ROOT / "src/gelflow").rglob("*") if p.is_file()}
    wanted = {name for name in wanted if "csrc" not in name and "__pycache__" not in name and not name.endswith(".so")}
    assert "py.typed" in held
    assert wanted - held == set()
    assert [name for name in held if "csrc" in name or name.endswith((".so", ".pyc"))] == []


def test_every_dependency_is_pinned_by_version_only() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*", line)] == []
    pinned = {re.sub(r"[-_.]+", "-", line.split("==")[0]).lower() for line in lines}
    table = project()
    settings, build = table["project"], table["build-system"]
    assert isinstance(settings, dict) and isinstance(build, dict)
    extras = settings["optional-dependencies"].values()
    wanted = [*settings["dependencies"], *(text for extra in extras for text in extra), *build["requires"]]
    names = {re.sub(r"[-_.]+", "-", re.split(r"[<>=!~ ]", text)[0]).lower() for text in wanted}
    assert names - pinned == set()


def test_help_imports_no_heavy_package() -> None:
    code = (
        "import sys; from gelflow.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'torch', 'cv2', 'mujoco', 'matplotlib', 'scipy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"
