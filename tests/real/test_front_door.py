"""The public names of gelflow.real and gelflow.hardware_mocks are exported, and importing them loads nothing heavy."""

import importlib
import subprocess
import sys

import pytest

PACKAGES = [
    *("gelflow.real", "gelflow.real.wsg", "gelflow.real.egm", "gelflow.real.camera", "gelflow.real.runner"),
    *("gelflow.hardware_mocks", "gelflow.hardware_mocks.wsg", "gelflow.hardware_mocks.egm"),
    *("gelflow.hardware_mocks.camera", "gelflow.hardware_mocks.simulated_cell"),
    *("gelflow.real.web_services", "gelflow.hardware_mocks.web_services"),
]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_listed_and_importable(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__all__ and set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        value = getattr(module, name)
        assert value.__name__ == name if callable(value) else name.isupper()  # a table has no name of its own


def test_importing_the_packages_loads_no_heavy_library() -> None:
    heavy = "{'torch', 'cv2', 'mujoco', 'matplotlib', 'serial', 'numpy'}"
    code = f"import sys, gelflow.real, gelflow.hardware_mocks; print(sorted({heavy} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert answer.stdout.strip() == "[]"
