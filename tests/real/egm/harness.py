"""Shared helpers of the EGM driver tests: the driver and the mock arm, connected over UDP."""

import contextlib
import dataclasses
import math
import socket
import time
from collections.abc import Callable

import numpy as np

from gelflow.clock import ScaledClock
from gelflow.errors import PeerTimeout
from gelflow.hardware_mocks.egm.controller import MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.plant import KinematicArm
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.driver import EgmArm

START = np.array([0.40, 0.0, 0.30])


DOWN = np.array([0.0, 0.0, 1.0, 0.0])


# Generous limits, because a busy test machine may stall a process for tens of ms; tests of staleness use shorter ones.
CONFIG = EgmConfig(
    workspace_min=(0.35, -0.05, 0.25),
    workspace_max=(0.45, 0.05, 0.35),
    host="127.0.0.1",
    stale=1.0,
    silence=5.0,
    joint_speed=math.radians(30),
)


MOCK = MockEgmConfig(joint_speed=math.radians(30), comm_timeout=2.0)


def near_start(x: float, y: float, z: float) -> np.ndarray:
    """A position near the start [m]."""
    there: np.ndarray = START + np.array([x, y, z])
    return there


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class ArmAndMock:
    """The driver and the mock arm, connected to each other."""

    def __init__(
        self, factor: float = 1.0, *, config: EgmConfig = CONFIG, mock: MockEgmConfig = MOCK, lag: float = 0.004
    ) -> None:
        self.clock = ScaledClock(factor)
        port = free_port()
        self.plant = KinematicArm(self.clock, position=START, quaternion=DOWN, lag=lag)
        self.mock = MockEgmArm(self.plant, clock=self.clock, config=dataclasses.replace(mock, port=port))
        self.arm = EgmArm(dataclasses.replace(config, port=port), clock=self.clock)

    def __enter__(self) -> "ArmAndMock":
        self.mock.start()
        try:
            self.arm.connect(timeout=60)
            self.arm.wait_following(60)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.arm.close()
        self.mock.stop()

    def until(self, done: Callable[[], bool], what: str) -> None:
        """Wait until `done`, with a time-out that allows for a very busy machine."""
        end = time.monotonic() + 20
        while not done():
            assert time.monotonic() < end, f"never: {what}"
            time.sleep(0.005)

    def go(self, position: np.ndarray, within: float = 1e-5) -> None:
        """Renew the target until the robot has reached it."""

        def there() -> bool:
            self.arm.target(position, DOWN, lifetime=0.5)
            return bool(np.linalg.norm(self.arm.state().position - position) < within)

        self.until(there, f"at {position}, is at {self.arm.state().position}")

    def at_rest(self) -> None:
        """Wait until the reference has returned to the robot after a hold: at most 25 cycles."""
        last = self.mock.report.answers
        self.until(lambda: self.mock.report.answers > last + 30, "30 answers")

    def latched(self) -> str:
        def fault() -> str:
            # state() raises PeerTimeout on missing feedback until the process has latched.
            with contextlib.suppress(PeerTimeout):
                return self.arm.state().fault
            return ""

        self.until(lambda: bool(fault()), "latched")
        return fault()
