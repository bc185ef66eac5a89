"""The public names of gelflow.perception and gelflow.perception.synthetic."""

import subprocess
import sys

import pytest

import gelflow.perception as gp
import gelflow.perception.synthetic as synthetic


@pytest.mark.parametrize(
    ("package", "expected"),
    [
        (
            gp,
            {
                "MarkerTracker",
                "TrackingResult",
                "TrackerInitError",
                "CameraCalibration",
                "load_calibration",
                "CameraMount",
            },
        ),
        (synthetic, {"FastGelRenderer", "AccurateGelRenderer", "GelSequence", "make_appearance"}),
    ],
)
def test_every_public_name_is_listed_and_resolves(package: object, expected: set[str]) -> None:
    names = set(package.__all__)  # type: ignore[attr-defined]
    assert expected <= names <= set(dir(package))
    assert [name for name in names if not hasattr(package, name)] == []


@pytest.mark.parametrize("package", ["gelflow.perception", "gelflow.perception.synthetic"])
def test_importing_the_package_imports_no_heavy_dependency(package: str) -> None:
    native = ("gelflow.perception._tracker", "gelflow.perception.force._contact_fit")
    heavy = ("torch", "cv2", "mujoco", "matplotlib", "scipy", *native)
    code = f"import sys, {package}; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
