"""The public names of gelflow and gelflow.session."""

import subprocess
import sys

import pytest

import gelflow
import gelflow.session as session


def test_packages_are_attributes_of_gelflow() -> None:
    folders = {"gel", "hardware_mocks", "perception", "policies", "real", "session", "sim", "view"}
    assert set(gelflow.__all__) == folders
    assert set(gelflow.__all__) <= set(dir(gelflow))
    assert gelflow.session.SessionReader is session.SessionReader


def test_public_names_of_session_are_listed_and_resolve() -> None:
    expected = {"SessionReader", "SessionRecorder", "Decision", "describe_session", "recover", "replay"}
    assert expected <= set(session.__all__) <= set(dir(session))
    assert [name for name in session.__all__ if not callable(getattr(session, name)) and name != "SENSORS"] == []


@pytest.mark.parametrize("package", ["gelflow", "gelflow.session"])
def test_importing_a_package_imports_no_dependency(package: str) -> None:
    heavy = ("numpy", "mcap", "torch", "cv2", "mujoco", "matplotlib", "scipy", "gymnasium")
    code = f"import sys, {package}; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
