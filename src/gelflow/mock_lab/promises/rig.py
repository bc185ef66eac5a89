"""A mock robot in real time and a runner in another process, with the time limits of the example lab file."""

import bisect
import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from gelflow.errors import PeerError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.insertion_progress import PHASES, InsertionProgress
from gelflow.hardware_mocks.simulated_cell.world import World
from gelflow.mock_lab.lab import lab_for
from gelflow.mock_lab.robot_process import free_port
from gelflow.protocols import CameraImage
from gelflow.real.runner.lab import Lab, LimitsSettings
from gelflow.real.runner.lab_file import save_lab
from gelflow.session.reader import SessionReader
from gelflow.task import INSERTION

_POLL = 0.002  # of the progress of the cell [s]
_SAMPLE = 0.004  # of the true state [s]
_START_LIMIT = 90.0  # until the awaited moment of a run [s]
_END_LIMIT = 60.0  # of a run after its fault [s]
# A shell lets its background processes ignore Ctrl-C; the runner keeps what it inherits.
_MAIN = """
import signal, sys
from gelflow.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
sys.exit(main(sys.argv[1:]))
"""


class FalseStop(PeerError):
    """A run ended before the moment that a promise is about, for example because this computer was busy."""


class Sample(NamedTuple):
    """True state of the cell at one time."""

    time: float  # [s]
    height: float  # of the tool above the base [m]
    shear: tuple[float, float]  # mean displacement of the markers of each pad along the finger [mm]


@dataclass(frozen=True)
class Event:
    """One recorded event."""

    time: float  # at which it happened [s]
    name: str
    values: dict[str, Any]


@dataclass(frozen=True)
class Run:
    """A finished run of the runner."""

    at: float  # time of the fault [s]
    exit_code: int
    output: str
    errors: str
    events: tuple[Event, ...]
    images: tuple[tuple[CameraImage, ...], tuple[CameraImage, ...]]  # of both cameras
    part: dict[str, Any]  # ground truth of the part; empty without one

    @property
    def reason(self) -> str:
        """The last line of standard error."""
        return (self.errors.strip().splitlines() or [""])[-1]

    def require_no_false_stop(self) -> None:
        """Raise FalseStop when the run ended by an error."""
        if self.exit_code == 2:
            raise FalseStop(self.reason)

    def first(self, *names: str, after: float = -math.inf) -> Event | None:
        """The first event with one of these names."""
        return next((event for event in self.events if event.name in names and event.time >= after), None)

    def stop(self, after: float) -> float:
        """Time of the first hold or stop of the arm from `after` on [s]; infinite without one."""
        event = self.first("arm hold", "arm stopped", after=after)
        return math.inf if event is None else event.time


def near_seed() -> int:
    """Seed of a part with a small misalignment: it is inserted by the first attempt."""
    return min(range(300), key=lambda seed: np.abs(_misalignment(seed)).max())


def far_seed() -> int:
    """Seed of a part with a large misalignment: it meets the rim in the first descent."""
    return max(range(300), key=lambda seed: np.abs(_misalignment(seed)[:2]).min())


def _misalignment(seed: int) -> Any:
    rng = np.random.default_rng((seed, 0x6E1))
    return INSERTION.draw_misalignment(rng, 1)[0] / np.array(INSERTION.misalignment)


def gripped(progress: InsertionProgress) -> bool:
    """Whether the part is gripped."""
    return progress.phase == PHASES.index("gripped")


def lower_than(height: float) -> Callable[[InsertionProgress], bool]:
    """Whether the gripped part's lower face is below `height` [m]."""
    return lambda progress: gripped(progress) and progress.height < height


in_descent = lower_than(INSERTION.start_height - 0.2e-3)
while_lowering = lower_than(INSERTION.start_height - INSERTION.descent - 2e-3)


class Rig:
    """The mock robot and its lab file. Use `with`."""

    def __init__(self, folder: Path, *, seed: int, world: World | None = None) -> None:
        self.folder = folder
        cell = SimulatedCellConfig(seed=seed, world=world or World())
        self.robot = MockRobot(1.0, MockRobotConfig(cell=cell, egm_port=free_port(socket.SOCK_DGRAM), time_sync=False))
        self.samples: list[Sample] = []
        self._ending = threading.Event()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.robot)
            thread = threading.Thread(target=self._sample, name="true state", daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._ending.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._stack.close()

    @property
    def output(self) -> str:
        """Standard output of the present run so far."""
        path = self.folder / "stdout.txt"
        return path.read_text(errors="replace") if path.exists() else ""

    @property
    def lab(self) -> Lab:
        """The lab file's content: the time limits are those of the example."""
        return replace(lab_for(self.robot, jitter=0.0), limits=LimitsSettings())

    def samples_between(self, first: float, last: float) -> list[Sample]:
        """True states between two times [s]."""
        times = [sample.time for sample in self.samples]
        return self.samples[bisect.bisect_left(times, first) : bisect.bisect_right(times, last)]

    def still_holds_the_part(self) -> bool:
        """Whether the part is gripped and the fingers press on it."""
        part = self.robot.cell.truth()["part"]
        return part is not None and part["phase"] == "gripped" and self.robot.cell.gripper_state()[2] > 5.0

    def _sample(self) -> None:
        cell = self.robot.cell
        while not self._ending.wait(_SAMPLE):
            left, right = (float(cell.marker_displacement(finger)[:, 0].mean()) for finger in (0, 1))
            self.samples.append(Sample(time.monotonic(), float(cell.arm_pose()[0][2]), (left, right)))

    # Runs

    def run(
        self,
        fault: Callable[["RunningRunner"], object] = lambda process: None,
        *,
        when: Callable[[InsertionProgress], bool] | None = None,
        lab: Lab | None = None,
        prelude: str = "",
        options: Sequence[str] = (),
        stdin: int = subprocess.DEVNULL,
        limit: float = _END_LIMIT,
    ) -> Run:
        """Run one insertion; `fault` is called when `when` is true, and the run must end within `limit` [s] then.

        `prelude` is Python code that the runner's process executes first. Raises FalseStop when the run ends before.
        """
        save_lab(lab or self.lab, self.folder / "lab.toml", title="Written by gelflow soak --promises.")
        arguments = ["run", "insertion", "--lab", str(self.folder / "lab.toml"), "--out", str(self.folder / "run")]
        with RunningRunner(
            [sys.executable, "-c", prelude + _MAIN, *arguments, *options], self.folder, stdin
        ) as process:
            end = time.monotonic() + _START_LIMIT
            while when is not None and not when(self.robot.cell.progress()):
                if process.ended or time.monotonic() > end:
                    process.kill()
                    late = f"the run did not reach the awaited moment within {_START_LIMIT:g} s"
                    raise FalseStop(process.last_line or late)
                time.sleep(_POLL)
            at = time.monotonic()
            fault(process)
            exit_code = process.wait(limit if when is not None else _START_LIMIT + limit)
            return self._finished(at, exit_code, process)

    def _finished(self, at: float, exit_code: int, process: "RunningRunner") -> Run:
        events, images = _read(self.folder / "run" / "session.mcap")
        parts = self.robot.cell.truth()["parts"]
        return Run(at, exit_code, process.output, process.errors, events, images, parts[0] if parts else {})


class RunningRunner:
    """The runner's process. Use `with`."""

    def __init__(self, arguments: Sequence[str], folder: Path, stdin: int) -> None:
        self._out, self._err = folder / "stdout.txt", folder / "stderr.txt"
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(arguments, stdin=stdin, stdout=out, stderr=err)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.kill()

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        return self._process.poll() is not None

    @property
    def output(self) -> str:
        """Standard output so far."""
        return self._out.read_text(errors="replace")

    @property
    def errors(self) -> str:
        """Standard error so far."""
        return self._err.read_text(errors="replace")

    @property
    def last_line(self) -> str:
        """Last line of standard error."""
        return (self.errors.strip().splitlines() or [""])[-1]

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        os.kill(self._process.pid, number)

    def wait(self, limit: float) -> int:
        """Exit status; after `limit` [s] the process is killed, and PeerError raised."""
        try:
            return self._process.wait(limit)
        except subprocess.TimeoutExpired:
            self.kill()
            raise PeerError(f"the run did not end within {limit:g} s") from None

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()


def end_after(send: Callable[[signal.Signals], None], seconds: float) -> None:
    """Wait, then end a run by SIGTERM."""
    time.sleep(seconds)
    send(signal.SIGTERM)


def _read(path: Path) -> tuple[tuple[Event, ...], tuple[tuple[CameraImage, ...], tuple[CameraImage, ...]]]:
    """Events and images of a session; nothing when there is none, or it is unfinished."""
    events: list[Event] = []
    images: tuple[list[CameraImage], list[CameraImage]] = ([], [])
    with contextlib.suppress(PeerError, OSError):
        if path.exists():
            with SessionReader(path) as session:
                for record in session.records():
                    if record.topic == "/event":
                        values = record.value["values"]
                        events.append(Event(values.get("at", record.stamp), record.value["name"], values))
                    elif isinstance(record.value, CameraImage):
                        images["right" in record.topic].append(record.value)
    return tuple(sorted(events, key=lambda event: event.time)), (tuple(images[0]), tuple(images[1]))
