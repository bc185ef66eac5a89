"""The settings of the wheel builds: pyproject.toml and the workflow agree with what the package supports."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/wheels.yml").read_text())


def test_wheels_are_built_from_the_oldest_supported_python_on() -> None:
    oldest = re.fullmatch(r">=3\.(\d+)", SETTINGS["project"]["requires-python"])
    assert oldest is not None
    tags = [re.fullmatch(r"cp3(\d+)-\*", tag) for tag in SETTINGS["tool"]["cibuildwheel"]["build"]]
    minors = [int(tag[1]) for tag in tags if tag is not None]
    assert len(minors) == len(tags)
    assert minors == list(range(int(oldest[1]), int(oldest[1]) + len(minors)))
    assert len(minors) >= 3


def test_the_workflow_covers_linux_on_both_processors_and_macos() -> None:
    systems = WORKFLOW["jobs"]["wheels"]["strategy"]["matrix"]["os"]
    assert [re.split(r"-\d", name)[0] + ("-arm" if name.endswith("-arm") else "") for name in systems] == [
        "ubuntu",
        "ubuntu-arm",
        "macos",
    ]


def test_the_workflow_pins_cibuildwheel() -> None:
    commands = [step.get("run", "") for step in WORKFLOW["jobs"]["wheels"]["steps"]]
    assert any(re.search(r"pip install cibuildwheel==\d+\.\d+\.\d+$", command) for command in commands)


def test_each_wheel_is_tested_with_a_command_that_exists() -> None:
    from gelflow.cli.main import COMMANDS

    program, command, *_ = SETTINGS["tool"]["cibuildwheel"]["test-command"].split()
    assert program == "gelflow"
    assert command in COMMANDS
