"""Measurements of scenes: description, speed, accuracy against speed, and instruction profile."""

from gelflow.measurement import machine


def versions() -> dict[str, str]:
    """Versions stored with every measurement, and the build of the C++ core."""
    from gelflow.sim._core import LEVEL  # deferred: the package can be imported before the core is built

    return {**machine.versions(), "core": LEVEL}
