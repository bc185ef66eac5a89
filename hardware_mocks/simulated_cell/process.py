"""The simulated world in a helper process, so that neither cameras nor protocols of the mocks delay it.

Values that change with every step pass through shared memory; rare requests pass as messages.
"""

import mmap
import os
import sys
import tempfile
import threading
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import SimulationError
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.helper_process import HelperProcess, Messages, connect_to_parent
from gelflow.observation import Grid
from gelflow.session.records import from_plain, to_plain

Array = NDArray[np.float64]
_START_LIMIT = 30.0  # [s, wall]
_ANSWER_LIMIT = 5.0  # [s, wall]
_GEL_PERIOD = 0.02  # markers are read this often, several times for every frame of a camera [s]


class _Cell:
    """Some numbers in shared memory: one writer, any readers, never half a value."""

    def __init__(self, words: Array, start: int, size: int) -> None:
        self._count = words[start : start + 1]
        self._values = words[start + 1 : start + 1 + size]
        self.end = start + 1 + size

    def write(self, values: Any) -> None:
        self._count[0] += 1  # odd while it is written
        self._values[:] = values
        self._count[0] += 1

    def read(self) -> tuple[int, Array]:
        """How often it was written, and the values."""
        while True:
            before = self._count[0]
            values = self._values.copy()
            if before % 2 == 0 and before == self._count[0]:
                return int(before) // 2, values


class _Shared:
    """The layout of the memory that both processes map."""

    def __init__(self, descriptor: int, grid: Grid) -> None:
        markers = grid.rows * grid.cols
        self.shape = (2, markers, 2)
        self._map = mmap.mmap(descriptor, self.size(grid))
        words = np.frombuffer(self._map, dtype=np.float64)
        self.arm = _Cell(words, 0, 7)  # commanded pose
        self.command = _Cell(words, self.arm.end, 3)  # of the gripper: width, speed, force
        self.fingers = _Cell(words, self.command.end, 3)  # measured: width, speed, force
        self.gels = _Cell(words, self.fingers.end, 4 * markers)

    @staticmethod
    def size(grid: Grid) -> int:
        return 8 * (8 + 4 + 4 + 1 + 4 * grid.rows * grid.cols)


class SimulatedCellProcess:
    """The plants of the mock robot, simulated in another process; `with` or `start` and `stop`."""

    def __init__(self, clock: ScaledClock, config: SimulatedCellConfig | None = None) -> None:
        self.config = SimulatedCellConfig() if config is None else config
        self._clock = clock
        self._shared: _Shared | None = None
        self._helper: HelperProcess | None = None
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        self._tool = self.config.start_tool()

    def start(self) -> Self:
        """Start the process and wait until it simulates. Raises SimulationError when it does not."""
        grid = self.config.grid
        with tempfile.TemporaryFile() as file:
            os.ftruncate(file.fileno(), _Shared.size(grid))
            self._shared = _Shared(file.fileno(), grid)
            self._shared.arm.write([*self._tool[0], *self._tool[1]])
            settings = {"world": to_plain(self.config), "clock": self._clock.settings}
            module = "gelflow.hardware_mocks.simulated_cell.process"
            self._helper = HelperProcess.start(module, settings, descriptors=(file.fileno(),))
        try:
            self._receive(self._helper, _START_LIMIT)
        except SimulationError:
            self._helper.close()
            self._helper = None
            raise
        return self

    def stop(self) -> None:
        """End the process. Raises SimulationError when it had failed before."""
        helper, self._helper = self._helper, None
        if helper is None:
            return
        failed = helper.stop(limit=_ANSWER_LIMIT) != 0
        reason = helper.exit_reason()
        helper.close()
        if failed:
            raise SimulationError(f"the simulated world failed: {reason}")

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.stop()

    # ArmPlant, GripperPlant, GelPlant: see `SimulatedCell`

    def arm_pose(self) -> tuple[Array, Array]:
        with self._lock:
            return self._tool[0].copy(), self._tool[1].copy()

    def command_arm(self, position: Array, quaternion: Array) -> None:
        with self._lock:
            self._tool = np.array(position, dtype=float), np.array(quaternion, dtype=float)
            self._running().arm.write([*self._tool[0], *self._tool[1]])

    def gripper_state(self) -> tuple[float, float, float]:
        if self._shared is None:
            return self.config.start_width, 0.0, 0.0  # the device looks at its fingers before the world is started
        _, (width, speed, force) = self._shared.fingers.read()
        return float(width), float(speed), float(force)

    def command_gripper(self, *, width: float, speed: float, force: float) -> None:
        with self._lock:
            self._running().command.write([width, speed, force])

    def marker_displacement(self, finger: int) -> Array:
        shared = self._running()
        return np.asarray(shared.gels.read()[1].reshape(shared.shape)[finger])

    # What the devices can not know

    def truth(self) -> dict[str, Any]:
        """`SimulatedCell.truth`. Raises SimulationError when the world has failed."""
        return dict(self._ask({"ask": "truth"}))

    def next_seed(self, seed: int) -> None:
        """`SimulatedCell.next_seed`."""
        self._ask({"ask": "next_seed", "seed": seed})

    def _running(self) -> _Shared:
        if self._shared is None:
            raise SimulationError("the simulated world was not started")
        return self._shared

    def _ask(self, question: dict[str, Any]) -> Any:
        with self._asking:
            if self._helper is None:
                raise SimulationError("the simulated world does not run")
            try:
                self._helper.messages.send(question)
            except OSError:
                raise SimulationError(f"the simulated world is gone: {self._helper.exit_reason()}") from None
            return self._receive(self._helper, _ANSWER_LIMIT)

    @staticmethod
    def _receive(helper: HelperProcess, limit: float) -> Any:
        """One message from the process."""
        try:
            values = helper.messages.wait(limit)
        except TimeoutError:
            raise SimulationError(f"the simulated world did not answer within {limit:g} s") from None
        if not values:
            raise SimulationError(f"the simulated world is gone: {helper.exit_reason()}")
        return values[0]


class _Service:
    """The process's side."""

    def __init__(self, world: SimulatedCell, parent: Messages, shared: _Shared) -> None:
        self._world, self._parent, self._shared = world, parent, shared
        self._commands = shared.command.read()[0]
        self._poses = -1
        self._steps = 0
        self._gel_every = max(1, round(_GEL_PERIOD / world.config.step))
        self.ending = threading.Event()

    def pass_on(self) -> None:
        """After each step: commands in, measurements out."""
        shared, world = self._shared, self._world
        poses, pose = shared.arm.read()
        if poses != self._poses:
            self._poses = poses
            world.command_arm(pose[:3], pose[3:])
        commands, (width, speed, force) = shared.command.read()
        if commands != self._commands:
            self._commands = commands
            world.command_gripper(width=float(width), speed=float(speed), force=float(force))
        shared.fingers.write(world.gripper_state())
        if self._steps % self._gel_every == 0:
            shared.gels.write(world.displacements().reshape(-1))
        self._steps += 1

    def answer(self) -> None:
        """A thread: questions of the parent, until it is gone."""
        try:
            while not self._parent.closed:
                for question in self._parent.wait():
                    reply: Any = None
                    if question["ask"] == "truth":
                        reply = self._world.truth()
                    else:
                        self._world.next_seed(int(question["seed"]))
                    self._parent.send(reply)
        except OSError:
            return  # the parent ended in the middle of an answer
        finally:
            self.ending.set()


def main(arguments: list[str]) -> int:
    """Started by `SimulatedCellProcess`, with the shared memory."""
    settings, parent, (memory,) = connect_to_parent(arguments)
    config = from_plain(SimulatedCellConfig, settings["world"], what="configuration of the simulated world")
    world = SimulatedCell(ScaledClock(*settings["clock"]), config)
    service = _Service(world, parent, _Shared(memory, config.grid))
    threading.Thread(target=service.answer, daemon=True).start()
    service.pass_on()
    parent.send(None)
    world.run(service.ending, after_step=service.pass_on)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
