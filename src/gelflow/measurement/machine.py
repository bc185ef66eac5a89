"""The machine and the package versions that are stored with every measurement."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gelflow import __version__


def cores() -> int:
    """How many of this machine's cores are ours."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """Name of this machine's processor, and how many of its cores are ours."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {cores()} cores"


def versions() -> dict[str, str]:
    """Versions of gelflow, Python, the operating system, NumPy and MuJoCo."""
    found = {"gelflow": __version__, "python": platform.python_version(), "system": platform.platform()}
    for package in ("numpy", "mujoco"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # run from a tree that was not installed with pip
            found[package] = "unknown"
    return found
