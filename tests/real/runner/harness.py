"""Shared helpers of the insertion-runner tests."""

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.observation import FlowMap
from gelflow.policies.checkpoint import save_checkpoint
from gelflow.policies.networks.polynomial_mlp import PolynomialMLP
from gelflow.real.runner.run_plan import RunPlan
from gelflow.session.reader import SessionReader
from gelflow.task import INSERTION

FACTOR = 4.0


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class OraclePolicy:
    """A policy that reads the ground truth and corrects the misalignment."""

    def __init__(self, robot: MockRobot, *, answer: Callable[[], None] = lambda: None) -> None:
        self._robot, self._answer = robot, answer
        self._planar_pose = np.zeros(3)
        self.seen: list[FlowMap] = []

    def reset(self) -> None:
        self._planar_pose = np.zeros(3)

    def act(self, observation: FlowMap) -> NDArray[np.float64]:
        self.seen.append(observation)
        self._answer()
        x, y, yaw = self._robot.cell.truth()["part"]["misalignment"]
        back, here = -yaw, -self._planar_pose[2]
        wanted = np.array([-np.cos(back) * x + np.sin(back) * y, -np.sin(back) * x - np.cos(back) * y, -yaw])
        dx, dy, turn = wanted - self._planar_pose
        local = [np.cos(here) * dx - np.sin(here) * dy, np.sin(here) * dx + np.cos(here) * dy, turn]
        correction = np.array(local)
        self._planar_pose = INSERTION.corrected(self._planar_pose, correction)
        return correction


def untrained_checkpoint(folder: Path) -> Path:
    """The file of an untrained policy."""
    rng = np.random.default_rng(0)
    architecture = PolynomialMLP(hidden=(8, 8))
    shapes = architecture.tensor_shapes(INSERTION)
    tensors = {name: 0.1 * rng.standard_normal(shape) for name, shape in shapes.items()}
    path = folder / "untrained.safetensors"
    save_checkpoint(path, task=INSERTION, architecture=architecture, tensors=tensors, training={"command": "none"})
    return path


def mean_displacement(robot: MockRobot) -> NDArray[np.float64]:
    """Present mean displacement of each pad's markers along the finger [mm]."""
    return np.array([robot.cell.marker_displacement(finger)[:, 0].mean() for finger in (0, 1)])


def plan_for(robot: MockRobot, folder: Path, policy: Any, **changes: Any) -> RunPlan:
    lab = changes.pop("lab", None) or lab_for(robot)
    return RunPlan(lab=lab, policy=policy, task=robot.config.cell.task, session=folder / "session.mcap", **changes)


def events(path: Path) -> list[tuple[str, Any]]:
    with SessionReader(path) as session:
        return [(record.value["name"], record.value["values"]) for record in session.records(["/event"])]


class BackgroundRun:
    """Work in a thread; a call waits for its end and gives its result or raises its exception."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._outcome: list[Any] = []
        self._work = work
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def __call__(self) -> Any:
        self._thread.join(120)
        assert self.ended, "the run did not end"
        if isinstance(self._outcome[0], BaseException):
            raise self._outcome[0]
        return self._outcome[0]

    def _run(self) -> None:
        try:
            self._outcome.append(self._work())
        except BaseException as error:  # noqa: BLE001 - raised in the test's thread
            self._outcome.append(error)


def wait_for(condition: Callable[[], bool], seconds: float = 120.0, *, during: BackgroundRun | None = None) -> None:
    """Wait until `condition` holds; a run that ends before is an error, its own if it has one."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition was not met in time"
        if during is not None and during.ended:
            raise AssertionError(f"the run ended before the condition was met, with {during()!r}")
        time.sleep(0.01)


def moving(robot: MockRobot) -> bool:
    """Whether a part is held and being lowered."""
    part = robot.cell.truth()["part"]
    return part is not None and part["phase"] == "gripped" and part["height"] < 0.0315
