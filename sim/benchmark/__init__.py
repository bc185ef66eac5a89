"""Measurements of the simulator's speed, for `gelflow bench`."""

from gelflow.measurement import machine


def versions() -> dict[str, str]:
    """The versions that every measurement stores, and the build of the C++ core."""
    from gelflow.sim._core import LEVEL  # imported here: the package can be imported before the core is built

    return {**machine.versions(), "core": LEVEL}
