"""Processor and package versions, which are stored with every measurement."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gelflow import __version__


def cores() -> int:
    """Number of cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_threads() -> int:
    """Threads of a computation that are not given: the cores, but at most the environment variable OMP_NUM_THREADS.

    Ray and other schedulers set it to what a process may use of a machine that it shares.
    """
    limit = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    return min(cores(), int(limit)) if limit.isdigit() and int(limit) else cores()


def processor() -> str:
    """Name of the processor, and number of cores available to this process."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}, {cores()} cores"


def versions() -> dict[str, str]:
    """Versions of gelflow, Python, the operating system, NumPy and MuJoCo."""
    result = {"gelflow": __version__, "python": platform.python_version(), "system": platform.platform()}
    for package in ("numpy", "mujoco"):
        try:
            result[package] = version(package)
        except PackageNotFoundError:  # not installed as a distribution
            result[package] = "unknown"
    return result
