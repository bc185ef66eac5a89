"""The simulated cell in a helper process, so that neither cameras nor protocols of the mocks delay it.

Values that change with every step pass through shared memory; rare requests pass as messages.
"""

import mmap
import os
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gelflow.clock import ScaledClock
from gelflow.errors import GelflowError, SimulationError, UsageError
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.insertion_progress import InsertionProgress
from gelflow.helper_process import HelperProcess, Messages, connect_to_parent, memory_file
from gelflow.observation import Grid
from gelflow.session.records import from_plain, to_plain

Array = NDArray[np.float64]
_START_LIMIT = 30.0  # [s, wall]
_ANSWER_LIMIT = 5.0  # [s, wall]
_GEL_PERIOD = 0.008  # period of marker readings, several per camera image [s]


class _SharedBlock:
    """Numbers in shared memory with one writer and any number of readers; readers never see a partial update."""

    def __init__(self, words: Array, start: int, size: int) -> None:
        self._count = words[start : start + 1]
        self._values = words[start + 1 : start + 1 + size]
        self.end = start + 1 + size

    def write(self, values: Any) -> None:
        """Update the values. Single writer only."""
        self._count[0] += 1  # odd during the update
        self._values[:] = values
        self._count[0] += 1

    def read(self) -> tuple[int, Array]:
        """The number of updates and the values."""
        while True:
            before = self._count[0]
            values = self._values.copy()
            if before % 2 == 0 and before == self._count[0]:
                return int(before) // 2, values


class _Shared:
    """Layout of the memory that both processes map."""

    def __init__(self, descriptor: int, grid: Grid) -> None:
        markers = grid.rows * grid.cols
        self.shape = (2, markers, 2)
        self._map = mmap.mmap(descriptor, self.size(grid))
        words = np.frombuffer(self._map, dtype=np.float64)
        self.arm = _SharedBlock(words, 0, 7)  # commanded pose
        self.command = _SharedBlock(words, self.arm.end, 3)  # of the gripper: width [m], speed [m/s], force [N]
        self.fingers = _SharedBlock(words, self.command.end, 3)  # measured: width, speed, force
        self.gels = _SharedBlock(words, self.fingers.end, 4 * markers)
        self.progress = _SharedBlock(words, self.gels.end, InsertionProgress.WORDS)

    @staticmethod
    def size(grid: Grid) -> int:
        """Size of the memory [bytes]."""
        return 8 * (8 + 4 + 4 + 1 + 4 * grid.rows * grid.cols + 1 + InsertionProgress.WORDS)


class SimulatedCellProcess:
    """`SimulatedCell` in a helper process, with the same plant methods. Use `with`, or `start` and `stop`."""

    def __init__(self, clock: ScaledClock, config: SimulatedCellConfig | None = None) -> None:
        self.config = SimulatedCellConfig() if config is None else config
        self._clock = clock
        self._shared: _Shared | None = None
        self._helper: HelperProcess | None = None
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        self._asked = 0  # number of questions so far
        self._tool = self.config.start_tool()

    def start(self) -> Self:
        """Start the process and wait until it simulates. Raises SimulationError when it does not."""
        grid = self.config.grid
        memory = memory_file(_Shared.size(grid))
        try:
            self._shared = _Shared(memory, grid)
            self._shared.arm.write([*self._tool[0], *self._tool[1]])
            settings = {"cell": to_plain(self.config), "clock": self._clock.settings}
            module = "gelflow.hardware_mocks.simulated_cell.process"
            self._helper = HelperProcess.start(module, settings, descriptors=(memory,))
        finally:
            os.close(memory)
        try:
            self._receive(self._helper, self._asked, _START_LIMIT)
        except SimulationError:
            self._helper.close()
            self._helper = None
            raise
        return self

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._helper is not None and self._helper.running

    def stop(self) -> None:
        """End the process. Raises SimulationError when it had failed before."""
        helper, self._helper = self._helper, None
        if helper is None:
            return
        failed = helper.stop(limit=_ANSWER_LIMIT) != 0
        reason = helper.exit_reason()
        helper.close()
        if failed:
            raise SimulationError(f"the simulated cell failed: {reason}")

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
            return self.config.start_width, 0.0, 0.0  # the mock gripper reads its state before the simulation starts
        _, (width, speed, force) = self._shared.fingers.read()
        return float(width), float(speed), float(force)

    def command_gripper(self, *, width: float, speed: float, force: float) -> None:
        with self._lock:
            self._running().command.write([width, speed, force])

    def marker_displacement(self, finger: int) -> Array:
        shared = self._running()
        return np.asarray(shared.gels.read()[1].reshape(shared.shape)[finger])

    # Ground truth, not available to the devices

    def truth(self) -> dict[str, Any]:
        """See `SimulatedCell.truth`. Raises SimulationError when the simulation has failed."""
        return dict(self._ask({"ask": "truth"}))

    def next_seed(self, seed: int) -> None:
        """See `SimulatedCell.next_seed`."""
        self._ask({"ask": "next_seed", "seed": seed})

    def progress(self) -> InsertionProgress:
        """See `SimulatedCell.progress`."""
        return InsertionProgress.from_words(self._running().progress.read()[1].tolist())

    def change_world(self, *, gel_stiffness: float, pad_friction: float) -> None:
        """See `SimulatedCell.change_world`. Raises UsageError when a value of the world leaves its limits."""
        self._ask({"ask": "change_world", "gel_stiffness": gel_stiffness, "pad_friction": pad_friction})

    def _running(self) -> _Shared:
        if self._shared is None:
            raise SimulationError("the simulated cell was not started")
        return self._shared

    def _ask(self, question: dict[str, Any]) -> Any:
        with self._asking:
            if self._helper is None:
                raise SimulationError("the simulated cell is not running")
            self._asked += 1
            try:
                self._helper.messages.send({**question, "number": self._asked})
            except OSError:
                raise SimulationError(f"the simulated cell has ended: {self._helper.exit_reason()}") from None
            return self._receive(self._helper, self._asked, _ANSWER_LIMIT)

    @staticmethod
    def _receive(helper: HelperProcess, number: int, limit: float) -> Any:
        """The answer to the question with this number; late answers to earlier questions are skipped."""
        end = time.monotonic() + limit
        while True:
            try:
                answers = helper.messages.wait(max(end - time.monotonic(), 0.0))
            except TimeoutError:
                raise SimulationError(f"the simulated cell did not answer within {limit:g} s") from None
            if not answers:
                raise SimulationError(f"the simulated cell has ended: {helper.exit_reason()}")
            for answer in answers:
                if answer["number"] == number:
                    if "error" in answer:
                        raise UsageError(answer["error"])
                    return answer["value"]


_ANSWERS: dict[str, Callable[..., Any]] = {
    "truth": SimulatedCell.truth,
    "next_seed": SimulatedCell.next_seed,
    "change_world": SimulatedCell.change_world,
}


class _Service:
    """Serves the parent inside the helper process."""

    def __init__(self, cell: SimulatedCell, parent: Messages, shared: _Shared) -> None:
        self._cell, self._parent, self._shared = cell, parent, shared
        self._commands = shared.command.read()[0]
        self._poses = -1
        self._steps = 0
        self._gel_every = max(1, round(_GEL_PERIOD / cell.config.step))
        self.ending = threading.Event()
        self.failure: Exception | None = None

    def exchange(self) -> None:
        """After each step: read commands, write measurements."""
        shared, cell = self._shared, self._cell
        poses, pose = shared.arm.read()
        if poses != self._poses:
            self._poses = poses
            cell.command_arm(pose[:3], pose[3:])
        commands, (width, speed, force) = shared.command.read()
        if commands != self._commands:
            self._commands = commands
            cell.command_gripper(width=float(width), speed=float(speed), force=float(force))
        shared.fingers.write(cell.gripper_state())
        shared.progress.write(cell.progress().to_words())
        if self._steps % self._gel_every == 0:
            shared.gels.write(cell.displacements().reshape(-1))
        self._steps += 1

    def answer(self) -> None:
        """Answer requests of the parent until it ends; runs in a thread."""
        try:
            while not self._parent.closed:
                for question in self._parent.wait():
                    self._answer(**question)
        except OSError:
            return  # the parent ended during an answer
        except Exception as error:  # noqa: BLE001 - `main` raises it
            self.failure = error
        finally:
            self.ending.set()

    def _answer(self, ask: str, number: int, **values: Any) -> None:
        answer: dict[str, Any] = {"number": number}
        try:
            answer["value"] = _ANSWERS[ask](self._cell, **values)
        except GelflowError as error:
            answer["error"] = str(error)
        self._parent.send(answer)


def main(arguments: list[str]) -> int:
    """Entry point; `SimulatedCellProcess` passes the descriptor of the shared memory."""
    settings, parent, (memory,) = connect_to_parent(arguments)
    config = from_plain(SimulatedCellConfig, settings["cell"], what="configuration of the simulated cell")
    cell = SimulatedCell(ScaledClock(*settings["clock"]), config)
    service = _Service(cell, parent, _Shared(memory, config.grid))
    threading.Thread(target=service.answer, daemon=True).start()
    service.exchange()
    parent.send({"number": 0, "value": None})
    cell.run(service.ending, after_step=service.exchange)
    if service.failure is not None:
        raise service.failure
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
