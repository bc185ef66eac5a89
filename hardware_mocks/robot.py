"""The mock robot: gripper, arm and two tactile cameras on the wire, with one simulated cell as their plant."""

import contextlib
import fcntl
import json
import math
import os
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.camera.device import MockMjpegCamera
from gelflow.hardware_mocks.egm.controller import MockEgmConfig
from gelflow.hardware_mocks.egm.device import MockEgmArm
from gelflow.hardware_mocks.faults.injector import Devices, FaultInjector
from gelflow.hardware_mocks.faults.plan import FaultPlan
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.process import SimulatedCellProcess
from gelflow.hardware_mocks.simulated_cell.sensor_effects import DeviatingGel
from gelflow.hardware_mocks.wsg.device import MockWsgGripper
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.lens import Lens
from gelflow.real.kinematics import Joints
from gelflow.time_sync import LEFT_CAMERA, RIGHT_CAMERA, TimeSync

Rotation = Literal[0, 90, 180, 270]

# Joint configuration above the hole: elbow up, flange down, wrist away from its singularity.
_NEAR: Joints = (0.0, 0.3, 0.1, 0.0, 1.2, 0.0)


@dataclass(frozen=True)
class MockRobotConfig:
    """Addresses, camera images and plant of the mock robot. Times in robot time.

    Raises UsageError for a port outside 0 to 65535.
    """

    cell: SimulatedCellConfig = field(default_factory=SimulatedCellConfig)
    host: str = "127.0.0.1"
    egm_port: int = 6510  # UDP port to which the arm sends its feedback
    tcp_port: int = 0  # of the gripper, in addition to its pty; 0 takes a free port
    truth_port: int = 0  # of the HTTP server of the ground truth; 0 takes a free port
    faults: FaultPlan = field(default_factory=FaultPlan)
    time_sync: bool = True  # robot time waits for a late simulation; False: it is the scaled wall time, as on a robot
    rotations: tuple[Rotation, Rotation] = (0, 0)  # of the left and right images, clockwise [°]: 0, 90, 180 or 270

    def __post_init__(self) -> None:
        for name, lowest in (("egm_port", 1), ("tcp_port", 0), ("truth_port", 0)):
            if not lowest <= getattr(self, name) <= 65535:
                port, given = name.replace("_", " "), getattr(self, name)
                raise UsageError(f"{port} must be within {lowest} to 65535, got {given}")

    def view(self, finger: int) -> tuple[GelAppearance, Lens]:
        """Appearance of a gel in its camera's ideal image, and the camera's lens; finger 0 is the left one."""
        world, rotation = self.cell.world, self.rotations[finger]
        camera = world.cameras[finger]
        look = camera.appearance(world.markers, seed=finger)
        turned = (look.height, look.width) if rotation in (90, 270) else (look.width, look.height)
        return replace(look, rotation=rotation, width=turned[0], height=turned[1]), camera.lens

    def print_error(self, finger: int) -> NDArray[np.float64]:
        """Positions of the printed markers relative to the regular grid [mm], shape (markers, 2)."""
        markers = self.cell.world.markers
        rng = np.random.default_rng((finger, 0x9F1))
        return rng.normal(0.0, markers.jitter_mm, (markers.rows * markers.cols, 2))


class MockRobot:
    """All mock devices and the simulated cell. Use `with`, or `start` and `stop`.

    Faults are injected through the devices `gripper`, `arm` and `cameras`. `clock` runs at most `factor` times as fast
    as the wall clock, and slower where this computer cannot simulate as fast.
    """

    def __init__(self, factor: float = 1.0, config: MockRobotConfig | None = None) -> None:
        self.config = config = config or MockRobotConfig()
        self._folder = tempfile.TemporaryDirectory(prefix="gelflow-mock-", dir=_memory_folder())
        time_sync = f"{self._folder.name}/time_sync" if config.time_sync else ""
        if time_sync:
            TimeSync.create(time_sync)
        self.clock = clock = ScaledClock(factor, time_sync)
        self.cell = SimulatedCellProcess(clock, config.cell)
        # CommTimeout is 0.4 s in wall time, because the computer's jitter does not scale with the clock.
        timeout = 0.4 * max(1.0, clock.factor)
        lag = config.cell.world.arm.lag
        controller = MockEgmConfig(host=config.host, port=config.egm_port, near=_NEAR, comm_timeout=timeout, lag=lag)
        self.arm = MockEgmArm(self.cell, clock=clock, config=controller)
        self.gripper = MockWsgGripper(self.cell, clock=clock, tcp_port=config.tcp_port, host=config.host)
        self.cameras = tuple(
            MockMjpegCamera(
                _Gel(self.cell, finger, config, clock),
                clock,
                rate=config.cell.world.cameras[finger].rate,
                host=config.host,
                slot=slot,
            )
            for finger, slot in enumerate((LEFT_CAMERA, RIGHT_CAMERA))
        )
        devices = Devices(self.arm, self.gripper, self.cameras, self.cell)
        self.faults = FaultInjector(config.faults, devices, clock, config.cell.task)
        self._truth = _TruthServer((config.host, config.truth_port), self.cell, self.faults)
        self._stack = contextlib.ExitStack()

    @property
    def folder(self) -> Path:
        """A folder that is removed when the robot stops."""
        return Path(self._folder.name)

    @property
    def truth_url(self) -> str:
        """URL of the ground truth: GET returns it, POST ?seed=N selects the next part."""
        host, port = self._truth.server_address[:2]
        return f"http://{host!s}:{port}/truth"

    def start(self) -> Self:
        """Start the simulated cell, then the devices. Raises UsageError when a port is in use."""
        with contextlib.ExitStack() as stack:
            stack.callback(self._folder.cleanup)
            stack.enter_context(_only_sender(self.config.egm_port))
            self.cell.start()
            stack.callback(self.cell.stop)
            self.arm.start()
            stack.callback(self.arm.stop)
            stack.enter_context(self.gripper)
            for camera in self.cameras:
                stack.enter_context(camera)
            if self.config.faults.faults:
                self.faults.start()
                stack.callback(self.faults.stop)
            threading.Thread(target=self._truth.serve_forever, args=(0.05,), name="truth", daemon=True).start()
            stack.callback(self._truth.close)
            self._stack = stack.pop_all()
        return self

    @property
    def running(self) -> bool:
        """Whether both processes of the robot run, those of the simulated cell and of the arm's controller."""
        return self.cell.running and self.arm.running

    def stop(self) -> None:
        """Stop all devices and the cell. Raises errors that occurred inside a mock."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.stop()


@contextlib.contextmanager
def _only_sender(port: int) -> Iterator[None]:
    """Raise UsageError where another mock robot of this user sends to the UDP port `port`.

    A driver takes the first arm that sends to its port for the robot.
    """
    folder = _memory_folder() or tempfile.gettempdir()
    with Path(folder, f"gelflow-egm-{os.getuid()}-{port}.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"another mock robot sends to the UDP port {port}: end it, or name another port with --egm-port"
            ) from None
        yield


def _memory_folder() -> str | None:
    """A folder in memory, None where the system has none.

    Each process of the mock robot writes to the file of the time synchronization many times a second. On a disk such a
    write waits while the disk is busy, for seconds at worst, and with it the arm or all images.
    """
    folder = "/dev/shm"
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


class _Gel:
    """Image source of one camera."""

    def __init__(self, cell: SimulatedCellProcess, finger: int, config: MockRobotConfig, clock: ScaledClock) -> None:
        self._cell, self._finger, self._clock = cell, finger, clock
        appearance, lens = config.view(finger)
        self._renderer = FastGelRenderer(appearance, lens=lens)
        self._printed = config.print_error(finger)
        world = config.cell.world
        self._effects = DeviatingGel(world.sensor_effects, world.markers.grid.positions(), finger)
        self._count = 0

    def __call__(self) -> bytes:
        self._count += 1
        moved = self._effects.apply(self._cell.marker_displacement(self._finger), self._clock.now())
        displacement = self._printed + moved
        return self._renderer.encode(self._renderer.render(displacement, sequence=self._count))


class _TruthServer(ThreadingHTTPServer):
    """Serves the ground truth, which no device provides, to demonstrations and evaluations."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, where: tuple[str, int], cell: SimulatedCellProcess, faults: FaultInjector) -> None:
        self.cell, self.faults = cell, faults
        try:
            super().__init__(where, _TruthHandler)
        except OSError as error:
            raise UsageError(f"cannot serve the ground truth at {where[0]}:{where[1]}: {error.strerror}") from error

    def close(self) -> None:
        self.shutdown()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore clients that disconnect; mocks do not print."""


class _TruthHandler(BaseHTTPRequestHandler):
    server: _TruthServer

    def do_GET(self) -> None:
        self._answer({**self.server.cell.truth(), "faults": self.server.faults.log})

    def do_POST(self) -> None:
        text = parse_qs(urlsplit(self.path).query).get("seed", [""])[0]
        if not text.isdecimal():
            self.send_error(400, "expected ?seed=N with an integer N")
            return
        self.server.cell.next_seed(int(text))
        self._answer({"next_seed": int(text)})

    def log_message(self, format: str, *args: object) -> None:
        """Mocks do not print."""

    def _answer(self, values: dict[str, Any]) -> None:
        data = json.dumps(_finite(values)).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def _finite(value: Any) -> Any:
    """Replace numbers that are not finite (not measured yet) by null, because JSON has none."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
