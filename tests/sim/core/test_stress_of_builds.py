"""The stress tests pass with each build of the core; the other tests run with the fastest one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gelflow.sim._core import LEVEL

TESTS = Path(__file__).with_name("test_stress.py")
SELECTED = "finite or huge_values or spin or heavy_block or very_short or substeps"


@pytest.mark.skipif(LEVEL != "v3", reason="the tests run with this build already")
def test_base_build_passes_the_stress_tests() -> None:
    environment = {**os.environ, "GELFLOW_CORE": "base"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:xdist", str(TESTS), "-k", SELECTED]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=280, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout
